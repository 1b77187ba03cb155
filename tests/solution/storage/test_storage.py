"""Saving and loading: exact round trips, damaged and foreign files, interrupts."""

from __future__ import annotations

import io
import json
import math
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import IO, Any
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile

import h5py
import numpy as np
import pytest

import rankone as ro
from rankone.solution.solution import Solution, load
from rankone.solution.storage.contents import digest_of
from rankone.solution.storage.netcdf import sealed
from rankone.solvers.reduced.field_causes import (
    FieldError,
    FieldsEnd,
    ReducedEnds,
    SlowModes,
    TooFewTrajectories,
)
from rankone.support.errors import StorageError
from rankone.support.files import Tagged, write_files
from rankone.tensors import ChebyshevBasis
from rankone.tensors.train import Train
from rankone.trajectories.system.verdict import (
    AccurateUnknowns,
    Budget,
    Cause,
    DerivativeOf,
    EarlyEnd,
    FailedPieces,
    HiddenRate,
    LessAccurateOutput,
    MeasuredError,
    MemoryNeeded,
    MovingFeatures,
    NarrowBox,
    Note,
    NothingInterpolated,
    NumericallyZero,
    OrderSearchLimit,
    OtherEngines,
    OutputError,
    PartOfSolution,
    ReferenceLimit,
    Remedy,
    SeveralOrders,
    SharedUnit,
    Status,
    SteadyBranch,
    SteepParameter,
    StoppedAt,
    SwitchesNotHeld,
    SwitchingTerm,
    TinyUnknowns,
    TrajectoryStops,
    UncertainPart,
    UndecidedOrder,
    UndecidedShare,
    UnknownOutputError,
    UnsettledTerms,
    Verdict,
    WorstPiece,
)
from tests.problems import REFERENCE
from tests.solution.evaluation.functions import Known, decay, oscillator, two_unknowns

SOLUTION = two_unknowns(2).solution


@pytest.fixture(params=["npz", "nc"])
def name(request: pytest.FixtureRequest) -> str:
    """A file of each kind."""
    return f"solution.{request.param}"


@pytest.mark.parametrize("known", [two_unknowns(2), decay(), oscillator()])
def test_round_trip_is_exact(known: Known, name: str, tmp_path: Path) -> None:
    solution = known.solution
    path = solution.save(tmp_path / name)
    assert path == tmp_path / name
    again = load(str(path))
    rng = np.random.default_rng(0)
    coordinates = {
        name: rng.uniform(*interval, 50)
        for name, interval in {solution.metadata.time: (0, 3), **solution.parameters}.items()
    }
    np.testing.assert_array_equal(again(**coordinates), solution(**coordinates))
    assert again.metadata == solution.metadata
    assert again.timings == solution.timings
    assert again.outcome.measured == solution.outcome.measured
    # NaN is not equal to itself
    assert repr(again.history) == repr(solution.history)


def test_partial_and_unchecked(name: str, tmp_path: Path) -> None:
    outcome = replace(
        SOLUTION.outcome,
        slabs=SOLUTION.outcome.slabs[:1],
        status=Status.BLOW_UP,
        measured=None,
        blow_up=(1.1, (0.5, 2.5)),
    )
    again = load(Solution(outcome, SOLUTION.metadata).save(tmp_path / name))
    assert again.status is Status.BLOW_UP
    assert again.outcome.measured is None
    assert again.outcome.blow_up == (1.1, (0.5, 2.5))
    assert again.time == (0.0, 1.0)
    empty = Solution(replace(outcome, slabs=()), SOLUTION.metadata)
    assert load(empty.save(tmp_path / f"b.{name}")).rank == 0


def test_files_with_newer_notes_have_the_newer_version(tmp_path: Path) -> None:
    narrow = NarrowBox((("x0", -0.5, 0.5),))
    others = OtherEngines("train", (("cross", Verdict(Status.TOLERANCE, notes=(narrow,))),))
    for note, version in ((Remedy("wait"), 1), (narrow, 2), (others, 2)):
        outcome = replace(SOLUTION.outcome, status=Status.TOLERANCE, notes=(note,))
        path = Solution(outcome, SOLUTION.metadata).save(tmp_path / f"{type(note).__name__}.npz")
        with np.load(path) as file:
            assert json.loads(str(file["header"]))["format_version"] == version
        assert load(path).outcome.notes == (note,)


def test_the_format_is_open(tmp_path: Path) -> None:
    path = SOLUTION.save(tmp_path / "solution.npz")
    with np.load(path, allow_pickle=False) as file:
        header = json.loads(str(file["header"]), parse_constant=pytest.fail)
        assert header["format"] == "rankone-solution"
        assert header["format_version"] == 1
        assert header["metadata"]["unknowns"] == ["x", "y"]
        asked = {"unknowns": ["x", "y"], **asdict(SOLUTION.metadata)}
        assert header["metadata"] == json.loads(json.dumps(asked))
        assert file["core_0_0"].shape == (2, 14, 3)
        basis = header["bases"][header["slabs"][2]["bases"][1]]
        assert file["core_2_1"].dtype == np.float64
        assert file["core_2_2"].shape[1] == basis["degree"] * basis["elements"]


def test_existing_files_are_kept(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text("precious")
    with pytest.raises(StorageError, match=rf"{name}` exists; remedy: .*overwrite=True"):
        SOLUTION.save(path)
    assert path.read_text() == "precious"
    SOLUTION.save(path, overwrite=True)
    assert load(path).unknowns == ("x", "y")


@pytest.fixture(params=["with links", "without links"])
def _links(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise PermissionError("no links here")

    if request.param == "without links":
        monkeypatch.setattr(os, "link", refuse)


@pytest.mark.usefixtures("_links")
def test_of_several_at_once_one_saves(tmp_path: Path) -> None:
    """All have found the place free when the first of them takes it."""
    place, count = tmp_path / "a.npz", 8
    ready = threading.Barrier(count)

    def write(number: int) -> str:
        def content(stream: IO[bytes]) -> None:
            stream.write(bytes([number]))
            ready.wait(60)

        try:
            write_files({place: content}, False, StorageError)
        except StorageError as error:
            return str(error)
        return "saved"

    with ThreadPoolExecutor(count) as pool:
        told = list(pool.map(write, range(count)))
    assert place.read_bytes() == bytes([told.index("saved")])
    told.remove("saved")
    assert all("a.npz` exists; remedy: choose another name" in message for message in told)
    assert os.listdir(tmp_path) == ["a.npz"]


@pytest.mark.usefixtures("_links")
def test_a_file_that_comes_up_meanwhile_is_kept(tmp_path: Path) -> None:
    first, second = tmp_path / "a.c", tmp_path / "a.h"

    def content(stream: IO[bytes]) -> None:
        stream.write(b"new")
        second.write_bytes(b"of somebody else")

    with pytest.raises(StorageError, match=r"a\.h` exists"):
        write_files({first: b"new", second: content}, False, StorageError)
    assert os.listdir(tmp_path) == ["a.h"]
    assert second.read_bytes() == b"of somebody else"
    write_files({first: b"new", second: content}, True, StorageError)
    assert second.read_bytes() == b"new"
    assert sorted(os.listdir(tmp_path)) == ["a.c", "a.h"]


@pytest.mark.parametrize("_links", ["without links"], indirect=True)
def test_a_place_that_was_taken_is_given_back(
    _links: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        SOLUTION.save(tmp_path / "a.npz")
    assert not os.listdir(tmp_path)


@pytest.mark.parametrize("failure", [KeyboardInterrupt, MemoryError])
def test_an_interrupt_leaves_nothing(
    failure: type[BaseException], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(file: Any, array: Any, **_: Any) -> None:
        file.write(b"half")
        raise failure

    monkeypatch.setattr("numpy.lib.format.write_array", interrupted)
    with pytest.raises(failure):
        SOLUTION.save(tmp_path / "new.npz")
    assert not list(tmp_path.iterdir())
    old = tmp_path / "old.npz"
    old.write_text("precious")
    with pytest.raises(failure):
        SOLUTION.save(old, overwrite=True)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["precious"]


def test_places_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"cannot be written: there is no directory `.*missing`"):
        SOLUTION.save(tmp_path / "missing" / "solution.npz")
    (tmp_path / "folder.npz").mkdir()
    with pytest.raises(StorageError, match="cannot be written: it is a directory"):
        SOLUTION.save(tmp_path / "folder.npz", overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["folder.npz"]


@pytest.mark.parametrize("name", ["x.txt", "x", "x.npz.gz", ".npz", ""])
def test_other_suffixes_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"remedy: end the name in \.npz"):
        SOLUTION.save(tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    target, link = tmp_path / "target.npz", tmp_path / "link.npz"
    link.symlink_to(target)
    SOLUTION.save(link, overwrite=True)
    assert link.is_symlink()
    assert os.path.samefile(link, target)


@pytest.mark.parametrize("path", [None, 5, b"solution.npz", ["a.npz"]])
def test_what_is_no_path_is_refused(path: Any) -> None:
    with pytest.raises(StorageError, match="is not a path"):
        load(path)
    with pytest.raises(StorageError, match="is not a path"):
        SOLUTION.save(path)
    with pytest.raises(ro.ExportError, match="is not a path"):
        SOLUTION.export(path)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"there is no file `.*nothing\.npz`"):
        load(tmp_path / "nothing.npz")
    with pytest.raises(StorageError, match="cannot be read"):
        load(tmp_path)


def test_what_was_changed_is_refused(name: str, tmp_path: Path) -> None:
    """A border of slabs or a digit of a core that was moved would be a wrong value."""
    path = SOLUTION.save(tmp_path / name)

    def digit(_: dict[str, Any], arrays: dict[str, Any]) -> None:
        arrays["core_0_0"] = arrays["core_0_0"] * (1.0 + 1e-9)

    edited(path, digit)
    with pytest.raises(StorageError, match="do not fit their digest"):
        load(path)
    SOLUTION.save(path, overwrite=True)
    edited(path, lambda header, _: header["metadata"].update(version="0.0.1"))
    with pytest.raises(StorageError, match="do not fit their digest"):
        load(path)


def test_a_success_ends_at_the_horizon(name: str, tmp_path: Path) -> None:
    path = SOLUTION.save(tmp_path / name)

    def longer(header: dict[str, Any], arrays: dict[str, Any]) -> None:
        header["metadata"]["horizon"][1] *= 2.0

    edited(path, longer)
    with pytest.raises(StorageError, match="the last slab ends at"):
        load(path)


@pytest.mark.parametrize("name", ["fifo", "/dev/zero"])
def test_only_regular_files_are_read(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    if name == "fifo":
        os.mkfifo(path)
    with pytest.raises(StorageError, match="not a regular file"):
        load(path)


@pytest.mark.parametrize("content", [b"", b"text", b"\x80\x04pickle", b"PK\x03\x04broken"])
def test_foreign_file(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "foreign.npz"
    path.write_bytes(content)
    with pytest.raises(StorageError, match=r"foreign\.npz` is not a rankone solution"):
        load(path)


def test_foreign_archive(tmp_path: Path) -> None:
    path = tmp_path / "foreign.npz"
    np.savez(path, a=np.ones(3))
    with pytest.raises(StorageError, match="not a rankone solution"):
        load(path)
    np.savez(path, header=np.array('{"format": "another"}'))
    with pytest.raises(StorageError, match="not a rankone solution"):
        load(path)
    np.savez(path, header=np.array([{"an": "object"}], dtype=object))
    with pytest.raises(StorageError, match="damaged"):
        load(path)


Edit = Callable[[dict[str, Any], dict[str, Any]], object]


def edited(path: Path, edit: Edit) -> None:
    if path.suffix == ".nc":
        edited_netcdf(path, edit)
        return
    with np.load(path) as file:
        arrays = dict(file)
    header = json.loads(str(arrays["header"]))
    edit(header, arrays)
    arrays["header"] = np.array(json.dumps(header))
    np.savez(path, **arrays)


def edited_netcdf(path: Path, edit: Edit) -> None:
    """As somebody would who makes the checksum of the file anew."""
    content = io.BytesIO(path.read_bytes())
    with h5py.File(content, "r+") as file:
        names = [name for name in file if name.startswith(("core_", "digest"))]
        arrays = {name: file[name][()] for name in names}
        header = json.loads(file["header"].asstr()[()])
        edit(header, arrays)
        for name in ["header", *names]:
            del file[name]
        for name, array in (arrays | {"header": json.dumps(header)}).items():
            file[name] = str(array) if np.asarray(array).dtype.kind == "U" else array
    path.write_bytes(sealed(content.getvalue()))


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda header, _: header.update(format_version=7), "version 7 .* upgrade rankone"),
        (lambda header, _: header.pop("slabs"), "damaged"),
        (lambda header, _: header["metadata"].pop("rtol"), "damaged"),
        (lambda header, _: header["metadata"].update(box=[]), "names do not fit the cores"),
        (lambda header, _: header["metadata"].update(unknowns=["y"]), "unknowns do not fit"),
        (lambda header, _: header["metadata"].update(roles=["unknown"] * 3), "do not fit"),
        (lambda header, _: header["metadata"].update(roles=["unknown", "king"]), "'king' is not"),
        (lambda header, _: header["metadata"].update(rtol="1e-6"), "'1e-6' is not of the type"),
        (lambda header, _: header["metadata"].update(horizon=[0, 1, 2]), "damaged"),
        (lambda header, _: header["measured"].update(interior=[0.1]), "do not fit"),
        (lambda header, _: header["measured"].update(points=1.5), "1.5 is not of the type"),
        (lambda header, _: header["history"][0].update(accepted=1), "1 is not of the type"),
        (lambda header, _: header["history"][0].update(residuals=0.5), "0.5 is not"),
        (lambda header, _: header["history"][0].pop("ranks"), "damaged .*ranks"),
        (lambda header, _: header.update(status="FINE"), "damaged"),
        (lambda header, _: header.update(cause={"type": "Status"}), "damaged"),
        (lambda header, _: header.update(cause={"type": "Remedy", "advice": ""}), "is not a Cause"),
        (lambda header, _: header.update(notes=[{"type": "StoppedAt", "time": "x"}]), "damaged"),
        (lambda header, _: header["slabs"][0].update(bases=[0, 99]), "damaged"),
        (lambda header, _: header["bases"][0].update(degree=5), "do not fit their bases"),
        (lambda header, _: header["measured"].update(interior=[1e-7, 1e-5]), "CONVERGED"),
        (lambda header, _: header["measured"].update(interior=[1e-7, -1e-7]), "CONVERGED"),
        (lambda header, _: header["measured"].update(interior=["nan", 1e-7]), "CONVERGED"),
        (lambda header, _: header.update(measured=None), "CONVERGED, the measured error None"),
        (lambda header, _: header["metadata"].update(rtol="inf"), "rtol is inf"),
        (lambda header, _: header["metadata"].update(rtol=0), "rtol is 0.0"),
        (lambda header, _: header["metadata"].update(states=["x", "x"]), "unknowns do not fit"),
        (
            lambda header, _: header["metadata"].update(states=["x", "x"], unknowns=["x", "x"]),
            "`x` belongs both to unknown `x` and to unknown `x`",
        ),
        (lambda header, _: header["metadata"].update(parameters=["t", "k"]), "to the time and"),
        (lambda header, _: header["metadata"].update(horizon=[0, "inf"]), "the horizon is"),
        (lambda header, _: header["metadata"].update(box=[[0, "nan"], [2, 3]]), "range of x0 is"),
        (lambda header, _: header["metadata"].update(box=[[-1, 2], [2, 3]]), "basis of slab 0"),
        (lambda header, _: header["bases"][0].update(upper="nan"), "basis of slab 0"),
        (lambda header, _: header["bases"][0].update(lower=1, upper=-1), "basis of slab 0"),
        (
            lambda header, _: header["bases"][0].update(
                degree=-header["bases"][0]["degree"], elements=-header["bases"][0]["elements"]
            ),
            "no nodes",
        ),
        (lambda header, _: header["slabs"][0].update(end="nan"), "slab 0 is .* not ascend"),
        (lambda header, _: header["slabs"][0].update(end=-1), "slab 0 is .* not ascend"),
        (lambda header, _: header["slabs"][0].update(start=0.5), "slab 0 is .* after 0.0"),
        (lambda header, _: header["slabs"][1].update(start=1.1), "slab 1 is .* after 1.0"),
        (lambda header, _: header["slabs"][2].update(end=4), "horizon up to 3.0"),
        (lambda header, _: header["slabs"].reverse(), "slab 0"),
        (lambda _, arrays: arrays["core_1_1"].fill(np.nan), "cores of slab 1 are not finite"),
        (lambda _, arrays: arrays.pop("core_1_1"), "damaged"),
        (lambda _, arrays: arrays.update(core_1_1=np.ones((2, 2, 2))), "do not fit"),
        (lambda _, arrays: arrays.update(core_0_0=np.ones((2, 14, 3), "i8")), "do not fit"),
    ],
)
def test_damaged_file(edit: Any, message: str, tmp_path: Path) -> None:
    path = SOLUTION.save(tmp_path / "u.npz")
    edited(path, edit)
    with pytest.raises(StorageError, match=rf"u\.npz`.*{message}"):
        load(path)


def test_a_damaged_header_of_netcdf(tmp_path: Path) -> None:
    """Both kinds of files have the same header, read by the same code."""
    path = SOLUTION.save(tmp_path / "u.nc")
    edited(path, lambda header, _: header["history"][0].pop("ranks"))
    with pytest.raises(StorageError, match=r"u\.nc`.*damaged .*ranks"):
        load(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"states": ["x", "a\\\n*/ int main"], "unknowns": ["x", "a\\\n*/ int main"]},
            "the name 'a",
        ),
        ({"states": ["x", "y\0"], "unknowns": ["x", "y\0"]}, "the name 'y"),
        ({"states": ["x", "x0"], "unknowns": ["x", "x0"]}, "`x0` belongs both to parameter"),
        ({"parameters": ["x0", " "]}, "the name ' '"),
        ({"parameters": ["x0", "\u202ey0"]}, "printed in one line"),
        ({"time": "t\u2028"}, "the name 't"),
        ({"units": [["x", "m\n#include <x>"]]}, "a unit is"),
        ({"equations": ["x' = 1\r*/"]}, "an equation is"),
        ({"name": "title\nmore"}, "the title is"),
        ({"version": "1\0"}, "the version is"),
        ({"distributions": [["x0", "__import__('os')"]]}, "is not the name of a distribution"),
        ({"distributions": [["k", "norm(1, 1)"]]}, "something else than a parameter"),
        ({"correlations": [["x0", "y0", 2.0]]}, "damaged"),
        ({"fixed": [["k", "nan"]]}, "a fixed coordinate is not finite"),
    ],
)
def test_doctored_texts_are_refused(
    change: dict[str, Any], message: str, name: str, tmp_path: Path
) -> None:
    """Also where the digest was made anew: exports write names into sources."""
    path = SOLUTION.save(tmp_path / name)

    def doctored(header: dict[str, Any], arrays: dict[str, Any]) -> None:
        header["metadata"].update(change)
        arrays["digest"] = np.array(digest_of({**arrays, "header": np.array(json.dumps(header))}))

    edited(path, doctored)
    with pytest.raises(StorageError, match=rf"{name}`.*{message}"):
        load(path)


def test_files_without_a_digest_are_refused(name: str, tmp_path: Path) -> None:
    path = SOLUTION.save(tmp_path / name)
    edited(path, lambda _, arrays: arrays.pop("digest"))
    with pytest.raises(StorageError, match="it has no digest"):
        load(path)


def npy(shape: tuple[int, ...], content: bytes = b"", kind: str = "<f8") -> bytes:
    """An array that says to be of some shape, whatever its content."""
    stream = io.BytesIO()
    header = {"descr": kind, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, header)
    return stream.getvalue() + content


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ([("core_0_0.npy", npy((10**12, 1, 1)), False)], "shape .* does not fit"),
        ([("header.npy", npy((), kind="<U500000000"), False)], "does not fit"),
        ([("core_0_0.npy", npy((1,), bytes(8), "|O"), False)], "does not fit"),
        ([("core_0_0.npy", npy((10**6, 1, 1), bytes(8 * 10**6)), True)], "larger than the file"),
        ([("more.bin", b"1", False)], "something else than arrays"),
        ([("core_0_0.npy", npy((1, 1, 1), bytes(8)), False)] * 2, "twice"),
        ([("core_0_0.npy", b"\x93NUMPY\x07\x00", False)], "format that is not known"),
    ],
)
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_archives_that_would_take_memory(
    members: list[tuple[str, bytes, bool]], message: str, tmp_path: Path
) -> None:
    path = SOLUTION.save(tmp_path / "solution.npz")
    with ZipFile(path) as archive:
        kept = {name: archive.read(name) for name in archive.namelist()}
    with ZipFile(path, "w") as archive:
        for name, content in kept.items():
            if name not in {changed for changed, *_ in members}:
                archive.writestr(name, content)
        for name, content, packed in members:
            archive.writestr(name, content, ZIP_DEFLATED if packed else ZIP_STORED)
    with pytest.raises(StorageError, match=message):
        load(path)


@pytest.mark.parametrize("packed", [True, False])
def test_netcdf_files_that_would_take_memory(packed: bool, tmp_path: Path) -> None:
    path = SOLUTION.save(tmp_path / "solution.nc")
    content = io.BytesIO(path.read_bytes())
    with h5py.File(content, "r+") as file:
        del file["core_0_0"]
        shape = (2, 10**6, 4) if packed else (10**6, 10**6, 1)
        file.create_dataset("core_0_0", shape, "<f8", compression="gzip" if packed else None)
    path.write_bytes(sealed(content.getvalue()))
    with pytest.raises(StorageError, match="core_0_0 is not stored as it is"):
        load(path)


def with_breaks() -> Solution:
    """Elements of unequal size in every slab, other ones in the last."""
    first, *_, last = SOLUTION.outcome.slabs
    last = replace(last, start=first.end)
    rng = np.random.default_rng(4)
    slabs = []
    for slab, inside in ((first, [(-0.3, 0.1 + 0.2), ()]), (last, [(-0.3,), (7.0 / 3.0,)])):
        bases = tuple(
            ChebyshevBasis(lower, upper, 4, breaks=breaks)
            for (lower, upper), breaks in zip(SOLUTION.metadata.box, inside, strict=True)
        )
        cores = [slab.cores[0], *(rng.standard_normal((3, b.size, 3)) for b in bases)]
        cores[-1] = cores[-1][:, :, :1]
        slabs.append(replace(slab, train=Train(tuple(cores)), bases=bases))
    outcome = replace(SOLUTION.outcome, slabs=(*slabs,))
    return Solution(outcome, SOLUTION.metadata)


def test_unequal_elements_are_kept_to_the_bit(name: str, tmp_path: Path) -> None:
    solution = with_breaks()
    path = solution.save(tmp_path / name)
    header: dict[str, Any] = {}
    edited(path, lambda found, _: header.update(found))
    assert header["format_version"] == 1
    assert [b.get("breaks") for b in header["bases"]] == [[-0.3, 0.1 + 0.2], [], [-0.3], [7 / 3]]
    again = load(path)
    for ours, theirs in zip(again.outcome.slabs, solution.outcome.slabs, strict=True):
        assert ours.bases == theirs.bases
        for a, b in zip(ours.cores, theirs.cores, strict=True):
            np.testing.assert_array_equal(a, b)
    rng = np.random.default_rng(0)
    points = rng.uniform([[0], [-1], [2]], [[1], [1], [3]], (3, 100))
    at = dict(zip(("t", "x0", "y0"), points, strict=True))
    np.testing.assert_array_equal(again(at), solution(at))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"breaks": [0.3, -0.3]}, "do not ascend"),
        ({"breaks": [0.3, 0.3]}, "do not ascend"),
        ({"breaks": [-0.3, 1.0]}, "do not ascend"),
        ({"breaks": [-1.5, 0.3]}, "do not ascend"),
        ({"breaks": [-0.3, "nan"]}, "do not ascend"),
        ({"breaks": [-0.3, "inf"]}, "do not ascend"),
        ({"breaks": [-0.3, "0.3"]}, "is not of the type"),
        ({"breaks": [-0.3, True]}, "is not of the type"),
        ({"breaks": 0.3}, "is not of the type"),
        ({"breaks": None}, "is not of the type"),
        ({"breaks": [-0.3]}, "do not make 3 elements"),
        ({"elements": 4}, "do not make 4 elements"),
        ({"elements": 1}, "do not fit"),
    ],
)
def test_damaged_breaks(change: dict[str, Any], message: str, tmp_path: Path) -> None:
    path = with_breaks().save(tmp_path / "solution.npz")
    edited(path, lambda header, _: header["bases"][0].update(change))
    with pytest.raises(StorageError, match=rf"solution\.npz` is damaged .*{message}"):
        load(path)


def test_every_truncation_is_noticed(name: str, tmp_path: Path) -> None:
    path = SOLUTION.save(tmp_path / name)
    content = path.read_bytes()
    for size in range(0, len(content), len(content) // 25):
        path.write_bytes(content[:size])
        with pytest.raises(StorageError):
            load(path)


def test_flipped_bytes_are_noticed(tmp_path: Path) -> None:
    path = SOLUTION.save(tmp_path / "solution.npz")
    content = path.read_bytes()
    header = "rankone-solution".encode("utf-32-le")
    for data in (header, *(core.tobytes() for core in SOLUTION.outcome.slabs[1].cores)):
        flipped = bytearray(content)
        flipped[content.index(data) + len(data) // 2] ^= 0xFF
        path.write_bytes(flipped)
        with pytest.raises(StorageError, match="damaged"):
            load(path)


@pytest.mark.parametrize("method", ["train", "greedy"])
def test_history_is_loaded_as_it_was(method: str, tmp_path: Path) -> None:
    solution = ro.solve(REFERENCE["coupled"](), rtol=1e-2, method=method)
    again = load(solution.save(tmp_path / "solution.npz"))
    assert again.history == solution.history
    assert {type(record) for record in again.history} == {type(solution.history[0])}
    assert replace(again.outcome, slabs=()) == replace(solution.outcome, slabs=())


VERDICTS = [
    Verdict(Status.WORK_LIMIT, ReferenceLimit(0.5, 3, "x"), (Budget((("reference", 0.9),)),)),
    Verdict(Status.NO_CONVERGENCE, TrajectoryStops(0.5), (StoppedAt(None), Remedy("raise effort"))),
    Verdict(Status.NO_CONVERGENCE, UnsettledTerms(7, 0.0, 1.0, 0.1), (StoppedAt(0.5),)),
    Verdict(
        Status.STEEP,
        SteepParameter("k", "x", 1.0, 1.1, 0.5, False, True, (("m", 2.0),)),
        (MeasuredError(1e-3, 1e-6, "x", 0.1), AccurateUnknowns(("y",), ("x",))),
    ),
    Verdict(Status.TOLERANCE, MovingFeatures(), (MeasuredError(1e-3, 1e-6, drift=1e-4),)),
    Verdict(Status.NARROW, HiddenRate("x", 0.5, (("k", 1.0),))),
    Verdict(Status.UNCHECKED, DerivativeOf("k"), (NumericallyZero("x", 1e-20, 1e-16),)),
    Verdict(Status.UNCHECKED, UncertainPart(0.1), (PartOfSolution(), NothingInterpolated())),
    Verdict(Status.UNCHECKED, UnknownOutputError(1e-7)),
    Verdict(Status.CONVERGED, LessAccurateOutput(2e-2, 1e-3), (OutputError(0.0, 2e-2),)),
    Verdict(Status.CONVERGED, None, (SteadyBranch((("x", 1.5),), -0.1, 3.0),)),
    Verdict(Status.TOLERANCE, None, (OutputError(1e-3, math.inf, "peak"),)),
    Verdict(Status.WORK_LIMIT, None, (NarrowBox((("k", 0.1, 1.0), ("m", 2.0, 3.0))),)),
    Verdict(Status.CONVERGED, None, (UndecidedShare(1e-3),)),
    Verdict(Status.TOLERANCE, UndecidedOrder(0.5)),
    Verdict(Status.WORK_LIMIT, OrderSearchLimit("`hit` does not come at k = 1")),
    Verdict(Status.MEMORY_LIMIT, None, (MemoryNeeded(2e9, 1e9),)),
    Verdict(Status.CONVERGED, None, (SharedUnit(("x", "y"), 1e-12),)),
    Verdict(Status.MEMORY_LIMIT, None, (TinyUnknowns(("x", "y"), 1e-83, 1e-12),)),
    Verdict(Status.CONVERGED, None, (WorstPiece(3, 1, (("k", 0.0, 1.0),)),)),
    Verdict(Status.TOLERANCE, None, (FailedPieces((1,), 3, Verdict(Status.RANK_LIMIT)),)),
    Verdict(Status.SWITCHES, None, (SwitchingTerm("sign(v)", "equation 2", "v", "tanh(v/w)"),)),
    Verdict(Status.STEEP, None, (SwitchingTerm("floor(v)", "equation 2", "v", "", None),)),
    Verdict(Status.STEEP, None, (SeveralOrders("`hit` does not come at k = 1"),)),
    Verdict(Status.SWITCHES, None, (SwitchesNotHeld("an order of events cannot be continued"),)),
    Verdict(Status.RANK_LIMIT, SlowModes("u", 100, 1e-3, 1e-4, 400, 9)),
    Verdict(Status.TRAJECTORY_LIMIT, TooFewTrajectories(12, 30, 2e-3)),
    Verdict(Status.BLOW_UP, FieldsEnd(0.5, (("k", 1.0),))),
    Verdict(Status.CONVERGED, FieldError(1e-5, "u", 20, 29)),
    Verdict(Status.STEEP, ReducedEnds("the solution depends steeply on k", 7)),
]


def test_every_verdict_is_loaded_as_it_was(name: str, tmp_path: Path) -> None:
    """Causes and notes are data: the message of a loaded solution is the same."""
    early = EarlyEnd(0.0, 0.5, 1.0, VERDICTS[0], VERDICTS[1])
    others = OtherEngines("cross", tuple(("train", verdict) for verdict in VERDICTS))
    nested = Verdict(Status.BLOW_UP, early, (others,))
    for verdict in (nested,) if name.endswith(".nc") else (*VERDICTS, nested):
        status, cause, notes = verdict.status, verdict.cause, verdict.notes
        outcome = replace(SOLUTION.outcome, status=status, cause=cause, notes=notes)
        path = Solution(outcome, SOLUTION.metadata).save(tmp_path / name, overwrite=True)
        again = load(path)
        assert again.outcome.verdict == verdict
        assert again.message == str(verdict)
    classes = {type(note) for v in (*VERDICTS, nested) for note in (v.cause, *v.notes)}
    assert {*Tagged.subclasses.values()} - {Cause, Note} == classes - {type(None)}


def test_unknowns_are_asked_for_by_role(tmp_path: Path) -> None:
    """Neither the order of the states nor a prefix says which are unknowns."""
    metadata = replace(SOLUTION.metadata, states=("w", "x_t"), roles=("auxiliary", "unknown"))
    solution = load(Solution(SOLUTION.outcome, metadata).save(tmp_path / "solution.npz"))
    assert solution.unknowns == ("x_t",)
    at = {"t": 1.0, "x0": 0.5, "y0": 2.5}
    np.testing.assert_allclose(solution(**at), SOLUTION(**at)[1:], rtol=1e-14)
    np.testing.assert_allclose(solution.grid(**at), SOLUTION.grid(**at)[1:], rtol=1e-14)
    assert list(solution.modes) == ["x_t"]


def test_a_method_that_is_not_known_is_refused(name: str, tmp_path: Path) -> None:
    metadata = replace(SOLUTION.metadata, method="magic")
    path = Solution(SOLUTION.outcome, metadata).save(tmp_path / name)
    with pytest.raises(StorageError, match=r"method='magic', which is not known here; .* train"):
        load(path)
