"""Solutions in netCDF: xarray opens them by itself, damaged files never reach the HDF5 library."""

from __future__ import annotations

import io
import os
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

import rankone as ro
from rankone.solution.solution import Solution, load
from rankone.solution.storage.netcdf import sealed
from rankone.support.errors import StorageError
from rankone.trajectories.system.verdict import Remedy
from tests.solution.evaluation.functions import decay, oscillator, two_unknowns

xarray = pytest.importorskip("xarray")
SOLUTION = two_unknowns(2).solution
UNITS = (("t", "seconds"), ("y0", "1/s"), ("x", "m"))
MEASURED = Solution(SOLUTION.outcome, replace(SOLUTION.metadata, units=UNITS))


def test_xarray_opens_it_by_itself(tmp_path: Path) -> None:
    path = MEASURED.save(tmp_path / "u.nc")
    with xarray.open_dataset(path, engine="h5netcdf") as data:
        assert data.state.values.tolist() == ["x", "y"]
        assert data.parameter.values.tolist() == ["x0", "y0"]
        np.testing.assert_array_equal(data.lower.sel(parameter=["y0", "x0"]), [2.0, -1.0])
        np.testing.assert_array_equal(data.error, list(MEASURED.errors.values()))
        np.testing.assert_array_equal(data.slab_end, [1.0, 1.5, 3.0])
        assert data.state_unit.values.tolist() == ["m", ""]
        assert data.parameter_unit.values.tolist() == ["", "1/s"]
        assert data.attrs["time_unit"] == "seconds"
        assert data.attrs["title"] == "Solution of x, y"
        assert data.attrs["equations"] == "dx/dt = ..."
        assert data.attrs["rtol"] == 1e-6
        assert data.attrs["error"] == MEASURED.error
        assert data.attrs["success"] == 1
        for i, slab in enumerate(MEASURED.outcome.slabs):
            for j, core in enumerate(slab.cores):
                np.testing.assert_array_equal(data[f"core_{i}_{j}"], core)
        assert data.core_1_0.dims == ("state", "time_mode_1", "rank_1_0_1")
        assert data.core_1_1.dims == ("rank_1_0_1", "mode_1_1", "rank_1_1_2")
        assert data.core_1_2.dims == ("rank_1_1_2", "mode_1_2", "one")


@pytest.mark.parametrize("solution", [decay().solution, oscillator().solution, SOLUTION.at(1.2)])
def test_xarray_opens_all_kinds(solution: Solution, tmp_path: Path) -> None:
    path = solution.save(tmp_path / "u.nc")
    with xarray.open_dataset(path, engine="h5netcdf") as data:
        assert data.state.values.tolist() == list(solution.states)
        assert data.attrs["timeless"] == int(solution.metadata.timeless)
    assert load(path).metadata == solution.metadata


def test_both_kinds_hold_the_same(tmp_path: Path) -> None:
    one, other = (load(MEASURED.save(tmp_path / name)) for name in ("u.npz", "u.nc"))
    times = np.linspace(0, 3, 40)
    values = one.grid(t=times, x0=[-0.4, 0.3], y0=[2.1, 2.2])
    np.testing.assert_array_equal(values, other.grid(t=times, x0=[-0.4, 0.3], y0=[2.1, 2.2]))
    assert one.metadata == other.metadata
    assert other.metadata.units == UNITS


def test_the_same_solution_gives_the_same_bytes(tmp_path: Path) -> None:
    one, other = (SOLUTION.save(tmp_path / name).read_bytes() for name in ("a.nc", "b.nc"))
    assert one == other


def test_the_content_says_what_a_file_is(tmp_path: Path) -> None:
    path = SOLUTION.save(tmp_path / "u.nc").rename(tmp_path / "renamed.npz")
    assert load(path).unknowns == ("x", "y")


def test_long_and_odd_texts(tmp_path: Path) -> None:
    """An attribute of HDF5 has less than 64 KiB, and no text has null characters."""
    metadata = replace(
        SOLUTION.metadata, equations=("µ" * 100_000,), states=("a\\", "µ"), source="x" * 10**6
    )
    outcome = replace(SOLUTION.outcome, notes=(Remedy("a\0b"),))
    path = Solution(outcome, metadata).save(tmp_path / "u.nc")
    assert load(path).metadata == metadata
    with xarray.open_dataset(path, engine="h5netcdf") as data:
        assert data.state.values.tolist() == ["a\\", "µ"]
        assert data.attrs["comment"].endswith("; a?b")


def test_an_interrupt_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    old = tmp_path / "old.nc"
    old.write_text("precious")
    for step in ("os.fsync", "h5netcdf.File.create_variable"):
        with monkeypatch.context() as patch:
            patch.setattr(step, interrupted)
            for path in (tmp_path / "new.nc", old):
                with pytest.raises(KeyboardInterrupt):
                    SOLUTION.save(path, overwrite=True)
        assert os.listdir(tmp_path) == ["old.nc"]
    assert old.read_text() == "precious"


@pytest.mark.parametrize("module", ["h5netcdf", "h5py"])
def test_what_is_missing_is_said(
    module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = SOLUTION.save(tmp_path / "u.nc")
    monkeypatch.setitem(sys.modules, module, None)
    wanted = rf"needs {module}, which is not installed; remedy: pip install h5netcdf h5py"
    with pytest.raises(StorageError, match=wanted):
        SOLUTION.save(tmp_path / "new.nc")
    assert os.listdir(tmp_path) == ["u.nc"]
    if module == "h5py":
        with pytest.raises(StorageError, match=wanted):
            load(path)
    else:
        assert load(path).success
    assert load(SOLUTION.save(tmp_path / "u.npz")).success


def test_places_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"cannot be written: there is no directory `.*missing`"):
        SOLUTION.save(tmp_path / "missing" / "u.nc")
    with pytest.raises(StorageError, match=r"end the name in \.npz, or in \.nc"):
        SOLUTION.save(tmp_path / "u.h5")


def test_flipped_bytes_are_noticed(tmp_path: Path) -> None:
    """Wherever they are: the HDF5 library may never come back from some of them."""
    path = SOLUTION.save(tmp_path / "u.nc")
    content = path.read_bytes()
    for place in np.random.default_rng(0).integers(0, len(content), 400).tolist():
        flipped = bytearray(content)
        flipped[place] ^= 0xFF
        path.write_bytes(flipped)
        with pytest.raises(StorageError):
            load(path)


def test_what_other_programs_wrote_is_refused(tmp_path: Path) -> None:
    path = SOLUTION.save(tmp_path / "u.nc")
    with xarray.open_dataset(path, engine="h5netcdf") as data:
        data.load().to_netcdf(tmp_path / "again.nc", engine="h5netcdf")
    with pytest.raises(StorageError, match=r"again\.nc` is damaged .*it was changed after"):
        load(tmp_path / "again.nc")
    xarray.Dataset({"u": 1.0}).to_netcdf(tmp_path / "other.nc", engine="h5netcdf")
    with pytest.raises(StorageError, match=r"other\.nc` is not a rankone solution"):
        load(tmp_path / "other.nc")


def test_only_what_lies_in_the_file_is_read(tmp_path: Path) -> None:
    """Links to other files and cores larger than the file are refused, whatever the checksum."""
    path, other = SOLUTION.save(tmp_path / "u.nc"), SOLUTION.save(tmp_path / "other.nc")

    def with_core(make: object) -> None:
        content = io.BytesIO(other.read_bytes())
        with h5py.File(content, "r+") as file:
            del file["core_0_0"]
            make(file)  # type: ignore[operator]
        path.write_bytes(sealed(content.getvalue()))
        with pytest.raises(StorageError, match=r"u\.nc` is damaged .*core_0_0"):
            load(path)

    with_core(lambda f: f.__setitem__("core_0_0", h5py.ExternalLink(str(other), "core_0_0")))
    with_core(lambda f: f.__setitem__("core_0_0", h5py.SoftLink("/core_1_0")))
    with_core(lambda f: f.create_group("core_0_0"))
    with_core(lambda f: f.create_dataset("core_0_0", (2, 10**9, 3), "f8", chunks=(2, 1000, 3)))


def test_solved_and_saved(tmp_path: Path) -> None:
    problem = ro.Problem.from_strings({"u": "-k*u"}, {"u": 1}, {"k": (1, 2)}, (0, 1))
    solution = ro.solve(problem, rtol=1e-4)
    again = ro.load(solution.save(tmp_path / "u.nc"))
    assert again.history == solution.history
    assert again(t=0.3, k=1.1).tolist() == solution(t=0.3, k=1.1).tolist()
