"""Values with labels."""

import functools
import sys

import numpy as np
import pytest

import rankone as ro
from tests.problems import EXAMPLES

xarray = pytest.importorskip("xarray")


@functools.cache
def solution():
    return ro.solve(EXAMPLES["lotka_volterra"].problem, 1e-4)


def test_a_grid_with_labels():
    times, x0 = np.linspace(0, 6, 7), [9.0, 10.0, 11.0]
    data = solution().to_xarray(t=times, x0=x0, y0=5.0)
    assert set(data.data_vars) == {"x", "y"}
    assert dict(data.sizes) == {"t": 7, "x0": 3}
    assert float(data.y0) == 5.0
    np.testing.assert_array_equal(data.x, solution().grid(t=times, x0=x0, y0=5.0)[0, :, :, 0])
    assert data.x.attrs["error"] == solution().errors["x"]
    assert data.attrs["rtol"] == 1e-4
    found = float(data.y.interp(t=3.0, x0=10.0))
    assert found == pytest.approx(float(solution()["y"](t=3.0, x0=10.0, y0=5.0)))


def test_times_are_chosen_and_symbols_understood():
    x0, y0 = EXAMPLES["lotka_volterra"].problem.parameters
    data = solution().to_xarray({x0: 10.0, y0: [4.0, 5.0]})
    assert dict(data.sizes) == {"t": 101, "y0": 2}


def test_a_table():
    table = solution().to_dataframe(t=[0.0, 1.0], x0=[9.0, 10.0], y0=5.0)
    assert table.index.names == ["t", "x0"]
    value = solution()["x"](t=1.0, x0=9.0, y0=5.0)
    assert table.loc[(1.0, 9.0), "x"] == pytest.approx(value, rel=1e-12)


def test_a_table_of_one_point():
    assert len(solution().to_dataframe(t=1.0, x0=9.0, y0=5.0)) == 1


def test_what_is_missing_is_said(monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(ro.RankoneError, match=r"need xarray, .*; remedy: pip install xarray"):
        solution().to_xarray(x0=9.0, y0=5.0)


def test_bad_coordinates():
    with pytest.raises(ro.RankoneError, match="no value for `y0`"):
        solution().to_xarray(x0=9.0)
