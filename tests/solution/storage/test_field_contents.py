"""Files of fields: round trips, single precision, damaged and foreign files."""

import json
from dataclasses import replace
from zipfile import ZipFile

import numpy as np
import pytest

import rankone as ro
from rankone.solution.solution import load
from rankone.solvers.outcome import Role
from rankone.support.files import npz, write_files
from rankone.trajectories.system.verdict import Status
from tests.solution.fields.small_fields import small_fields

AT = {"t": 0.4, "k": 1.3, "s": 0.7}


@pytest.fixture(scope="module")
def solution():
    return small_fields()


def arrays_of(path):
    with np.load(path) as file:
        return dict(file)


def rewrite(path, arrays):
    write_files({path: npz(arrays)}, True, ro.StorageError)


def test_round_trip(solution, tmp_path):
    again = ro.load(solution.save(tmp_path / "u.npz"))
    assert isinstance(again, ro.FieldSolution)
    assert (again(**AT) == solution(**AT)).all()
    assert again.errors == solution.errors
    assert (again.status, again.message) == (solution.status, solution.message)
    assert again.modes.unknowns == solution.modes.unknowns
    assert again.modes.trajectories == 12
    assert repr(again) == repr(solution)


def test_plain_solutions_are_loaded_as_before(solution, tmp_path):
    path = solution.coefficients.save(tmp_path / "a.npz")
    assert isinstance(ro.load(path), ro.Solution)


def test_unchecked_fields(solution, tmp_path):
    unchecked = replace(solution, modes=replace(solution.modes, errors=()), status=None, message="")
    again = ro.load(unchecked.save(tmp_path / "u.npz"))
    assert np.isnan(again.error)
    assert not again.success


def test_single_precision_adds_to_the_errors(solution, tmp_path):
    path = solution.save(tmp_path / "u.npz", modes="float32")
    assert arrays_of(path)["modes_0"].dtype == np.float32
    again = ro.load(path)
    assert again.success
    moved = np.abs(again(**AT) - solution(**AT))[:-1].max() / solution.modes.scales[0]
    assert 0.0 < moved <= again.errors["u"] - solution.errors["u"] < 1e-6
    close = replace(solution, modes=replace(solution.modes, errors=(solution.rtol, 0.0)))
    again = ro.load(close.save(tmp_path / "close.npz", modes="float32"))
    assert not again.success
    with pytest.raises(ro.OptionError, match="is neither"):
        solution.save(tmp_path / "half.npz", modes="float16")


def test_fields_without_values(solution, tmp_path):
    """A solve may end before there are any modes."""
    empty = tuple(own[:, :0] for own in solution.modes.modes[:1]) + solution.modes.modes[1:]
    nothing = replace(solution.coefficients.outcome, slabs=(), status=Status.WORK_LIMIT)
    metadata = replace(solution.coefficients.metadata, states=("w",), roles=(Role.UNKNOWN,))
    modes = replace(solution.modes, modes=empty, errors=())
    fields = ro.FieldSolution(
        ro.Solution(replace(nothing, measured=None), metadata), modes, "spent", Status.WORK_LIMIT
    )
    assert not fields.success
    with pytest.raises(ro.EvaluationError, match="nothing was solved"):
        fields["u"](**AT)
    with pytest.raises(ro.EvaluationError, match="nothing was solved"):
        fields.output({"w": fields["w"]})
    with pytest.raises(ro.StorageError, match="nothing to save: spent"):
        fields.save(tmp_path / "u.npz")
    assert "no: spent" in repr(fields)


def test_targets_are_checked(solution, tmp_path):
    path = solution.save(tmp_path / "u.npz")
    with pytest.raises(ro.StorageError, match="exists"):
        solution.save(path)
    solution.save(path, overwrite=True)
    with pytest.raises(ro.StorageError, match="npz"):
        solution.save(tmp_path / "u.nc")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("modes_0", np.ones((3, 4))),
        ("modes_0", np.full((60, 4), np.nan)),
        ("modes_0", np.ones((60, 3))),
        ("modes_0", np.ones((60, 4))),
        ("coefficients_digest", np.array("0")),
        ("coefficients_core_0_0", np.zeros((5, 2, 2))),
        ("digest", np.array("0")),
    ],
)
def test_damaged_arrays_are_refused(solution, tmp_path, name, content):
    path = solution.save(tmp_path / "u.npz")
    rewrite(path, arrays_of(path) | {name: content})
    with pytest.raises(ro.StorageError, match="damaged"):
        ro.load(path)


@pytest.mark.parametrize("name", ["modes_1", "digest", "coefficients_header", "header"])
def test_missing_arrays_are_refused(solution, tmp_path, name):
    path = solution.save(tmp_path / "u.npz")
    arrays = arrays_of(path)
    del arrays[name]
    rewrite(path, arrays)
    with pytest.raises(ro.StorageError):
        ro.load(path)


@pytest.mark.parametrize(
    "changes",
    [
        {"scales": [1.0]},
        {"scales": [-1.0, 1.0]},
        {"errors": [1e-6]},
        {"errors": [1.0, 1.0]},
        {"unknowns": []},
        {"status": "FINE"},
        {"format_version": "1"},
        {"trajectories": "many"},
    ],
)
def test_headers_that_do_not_fit_are_refused(solution, tmp_path, changes):
    path = solution.save(tmp_path / "u.npz")
    arrays = arrays_of(path)
    header = json.loads(str(arrays["header"])) | changes
    rewrite(path, arrays | {"header": np.array(json.dumps(header))})
    with pytest.raises(ro.StorageError, match="damaged"):
        ro.load(path)


def test_newer_versions_are_refused(solution, tmp_path):
    path = solution.save(tmp_path / "u.npz")
    arrays = arrays_of(path)
    header = json.loads(str(arrays["header"])) | {"format_version": 2}
    rewrite(path, arrays | {"header": np.array(json.dumps(header))})
    with pytest.raises(ro.StorageError, match="version 2 of the format of fields"):
        ro.load(path)


def test_fields_are_no_plain_solution(solution, tmp_path):
    with pytest.raises(ro.StorageError, match="holds fields"):
        load(solution.save(tmp_path / "u.npz"))


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "u.npz"
    with ZipFile(path, "w") as archive:
        archive.writestr("a.txt", "text")
    with pytest.raises(ro.StorageError):
        ro.load(path)
    with pytest.raises(ro.StorageError, match="no file"):
        ro.load(tmp_path / "none.npz")
