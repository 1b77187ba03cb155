"""Fields with labels."""

from dataclasses import replace

import numpy as np
import pytest

import rankone as ro
from rankone.solution.fields.field_solution import FieldSolution
from rankone.trajectories.fields.field_system import Unknown
from tests.solution.fields.small_fields import coefficients, small_fields

xarray = pytest.importorskip("xarray")
POINT = {"t": [0.1, 0.6], "k": 1.3, "s": [0.7, 1.0, 1.2]}


@pytest.fixture(scope="module")
def solution():
    return small_fields()


def test_one_variable_for_each_unknown(solution):
    data = solution.to_xarray(**POINT)
    assert data["u"].dims == ("entry", "t", "s")
    assert data["w"].dims == ("t", "s")
    assert float(data["k"]) == 1.3
    expected = solution["u"].grid(**POINT)[:, :, 0]
    assert data["u"].values == pytest.approx(expected, rel=1e-12)
    assert data["w"].values == pytest.approx(solution["w"].grid(**POINT)[:, 0], rel=1e-12)
    assert data["u"].attrs["error"] == 2e-5
    assert data.attrs["success"] == 1


def test_entries_on_a_grid(solution):
    x, y = np.linspace(0.0, 1.0, 6), np.linspace(0.0, 2.0, 10)
    data = solution.to_xarray(**POINT, coordinates={"x": x, "y": y})
    assert data["u"].dims == ("x", "y", "t", "s")
    at = data["u"].isel(x=2, y=3, t=1, s=0)
    assert float(at) == pytest.approx(solution["u"][23](t=0.6, k=1.3, s=0.7), rel=1e-12)
    assert data["w"].dims == ("t", "s")
    assert data["y"].values == pytest.approx(y)


def test_fields_of_several_sizes():
    v = np.sqrt(5) * np.linalg.qr(np.random.default_rng(0).standard_normal((5, 1)))[0]
    first = small_fields().modes
    unknowns = (Unknown("u", 0, 60), Unknown("w", 60, 5))
    solved = coefficients()
    states = (*solved.states[:4], "w_0")
    renamed = ro.Solution(solved.outcome, replace(solved.metadata, states=states))
    modes = replace(first, unknowns=unknowns, modes=(first.modes[0], v))
    data = FieldSolution(renamed, modes).to_xarray(t=0.5, k=1.0, s=1.0)
    assert data["u"].dims == ("u_entry",)
    assert data["w"].dims == ("w_entry",)


@pytest.mark.parametrize("pairs", [False, True])
def test_entries_of_a_mesh_have_places(solution, pairs):
    x, y = np.random.default_rng(1).random((2, 60))
    written = {"x": ("entry", x), "y": ("entry", y)} if pairs else {"x": x, "y": y}
    data = solution.to_xarray(**POINT, coordinates=written)
    assert data["u"].dims[0] == data["x"].dims[0] == data["y"].dims[0] == "entry"
    assert (data["y"] == y).all()


def test_grids_that_do_not_fit_are_refused(solution):
    with pytest.raises(ro.OptionError, match="along `entry` has the shape"):
        solution.to_xarray(**POINT, coordinates={"x": ("entry", np.zeros(6))})
    with pytest.raises(ro.OptionError, match="has 6 points, and the fields have 60"):
        solution.to_xarray(**POINT, coordinates={"x": np.arange(6.0)})
    with pytest.raises(ro.OptionError, match="`k` is a name"):
        solution.to_xarray(**POINT, coordinates={"k": np.arange(60.0)})
    with pytest.raises(ro.OptionError, match="has the shape"):
        solution.to_xarray(**POINT, coordinates={"x": np.zeros((6, 10))})
