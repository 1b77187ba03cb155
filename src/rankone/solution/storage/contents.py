"""The content of a solution file, whatever its container: a header and cores.

The array ``header`` is a JSON text: the :class:`~rankone.solvers.outcome.SolutionMetadata`, the
bases of every slab and the :class:`~rankone.solvers.outcome.Outcome`; ``core_<slab>_<dimension>``
are the cores of each :class:`~rankone.tensors.slab.SlabTrain`. Readers refuse newer
versions and ignore entries they do not know; the version grows when an old reader could
misunderstand a file.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, get_type_hints
from zipfile import BadZipFile
from zlib import error as ZlibError

import numpy as np
from numpy.typing import NDArray

from rankone.solvers.outcome import Outcome, Piece, SlabRecord, SolutionMetadata
from rankone.support.arrays import NEGLIGIBLE
from rankone.support.errors import StorageError, is_line, name_defect, quote
from rankone.support.files import as_path, plain, rebuilt
from rankone.tensors import BASES, SCALES, Basis1D, Scale
from rankone.tensors.branch_evaluator import Tiling
from rankone.tensors.slab import SlabTrain
from rankone.tensors.train import Train
from rankone.trajectories.system.timeline import CLOCK_STATES, BranchedTimeline, Timeline
from rankone.trajectories.system.verdict import NarrowBox, Status

FORMAT = "rankone-solution"
FIELD_FORMAT = "rankone-fields"  # Of files with a solution of coefficients, and modes
# Versions of files: the third came with timelines, the fourth with those of several branches, the
# fifth with solutions joined of pieces, the newest one that is read with openings of branches
_FIRST, _SECOND, _THIRD, _FOURTH, _FIFTH, FORMAT_VERSION = range(1, 7)
_SECOND_NOTES = (NarrowBox.__name__,)  # Notes that came with version 2, as did scales of bases
# Fields of an outcome that the header holds as they are
_PLAIN = ("status", "cause", "notes", "measured", "timings", "work", "blow_up")
# What reading a damaged file may raise
_DAMAGE = (
    BadZipFile,
    EOFError,
    LookupError,
    NotImplementedError,
    OverflowError,
    RecursionError,
    TypeError,
    ValueError,
    ZlibError,
)


Arrays = Mapping[str, NDArray[Any]]
"""The arrays of a file by name: texts without dimensions, and cores."""


@contextmanager
def reading(path: str | PathLike[str]) -> Iterator[Path]:
    """The path of a file to read; whatever goes wrong inside becomes a StorageError."""
    place = as_path(path, StorageError)
    try:
        if place.exists() and not place.is_file():
            raise StorageError(f"`{place}` cannot be read: it is not a regular file", term=place)
        yield place
    except StorageError:
        raise
    except MemoryError as error:
        raise StorageError(f"there is no memory for what `{place}` holds", term=place) from error
    except FileNotFoundError:
        raise StorageError(f"there is no file `{place}`", term=place) from None
    except OSError as error:
        raise StorageError(f"`{place}` cannot be read: {error}", term=place) from error
    except _DAMAGE as error:
        raise StorageError(
            f"`{place}` is damaged ({type(error).__name__}: {error})",
            term=place,
            remedy="restore it from a copy, or solve again",
        ) from error


def not_a_solution(path: Path) -> StorageError:
    """The error for a file that holds something else."""
    return StorageError(
        f"`{path}` is not a rankone solution",
        term=path,
        remedy="give a file written by `solution.save` or `rankone solve --save`",
    )


def packed(outcome: Outcome, metadata: SolutionMetadata) -> Arrays:
    """The arrays of a file by name: header, cores and digest."""
    bases: dict[Basis1D, int] = {}
    slabs = []
    for slab in outcome.slabs:
        used = [bases.setdefault(basis, len(bases)) for basis in slab.bases]
        slabs.append({"start": slab.start, "end": slab.end, "bases": used})
    scaled = any(not basis.scale.is_identity for basis in bases)
    is_second = scaled or _has_new_notes(plain((outcome.cause, outcome.notes)))
    version = _SECOND if is_second else _FIRST
    timeline: dict[str, Timeline | BranchedTimeline] = {}
    if isinstance(outcome.timeline, BranchedTimeline):
        version = FORMAT_VERSION if outcome.timeline.openings else _FOURTH
        timeline = {"branches": outcome.timeline}
    elif outcome.timeline is not None:
        version, timeline = _THIRD, {"timeline": outcome.timeline}
    pieces = {"pieces": len(outcome.pieces)} if outcome.pieces else {}
    if pieces:
        version = _FIFTH
    header = {
        "format": FORMAT,
        "format_version": version,
        "metadata": {"unknowns": metadata.unknowns, **plain(metadata)},
        **{name: getattr(outcome, name) for name in ("message", *_PLAIN)},
        "history": () if outcome.pieces else outcome.history,
        "bases": [_fields(basis) for basis in bases],
        "slabs": slabs,
        **timeline,
        **pieces,
    }
    arrays: dict[str, NDArray[Any]] = {
        "header": np.array(json.dumps(plain(header), allow_nan=False))
    }
    for i, piece in enumerate(outcome.pieces):
        own = packed(piece.outcome, piece.metadata)
        arrays |= {f"{piece_prefix(i)}{name}": array for name, array in own.items()}
    for i, slab in enumerate(outcome.slabs):
        for j, core in enumerate(slab.cores):
            arrays[f"core_{i}_{j}"] = np.ascontiguousarray(core, dtype="<f8")
    arrays["digest"] = np.array(digest_of(arrays))
    return arrays


def piece_prefix(index: int) -> str:
    """What the names of the arrays of a piece begin with."""
    return f"piece_{index}_"


def _has_new_notes(content: object) -> bool:
    """Whether plain data holds notes of version 2, in notes or in verdicts within them."""
    if isinstance(content, list):
        return any(map(_has_new_notes, content))
    if not isinstance(content, dict):
        return False
    return content.get("type") in _SECOND_NOTES or any(map(_has_new_notes, content.values()))


def digest_of(arrays: Arrays) -> str:
    """SHA-256 of the header, of the digests of pieces, and of cores in the order of their names."""
    digest = hashlib.sha256(str(arrays["header"][()]).encode())
    for name in sorted(name for name in arrays if name.startswith("piece_")):
        if name.endswith("_digest"):
            digest.update(f"{name} {arrays[name][()]} ".encode())
    for name in sorted(name for name in arrays if name.startswith("core_")):
        digest.update(f"{name} {arrays[name].shape} ".encode())
        digest.update(np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()


def unpacked(
    arrays: Arrays, path: Path, records: Mapping[str, type[SlabRecord]]
) -> tuple[Outcome, SolutionMetadata]:
    """The solution in the arrays of a file, checked; ``records`` has a class for each method."""
    header = _header(arrays, path)
    metadata: SolutionMetadata = rebuilt(SolutionMetadata, header["metadata"])
    fit = len(metadata.roles) == len(metadata.states)
    if not fit or [*metadata.unknowns] != header["metadata"]["unknowns"]:
        raise ValueError("the unknowns do not fit the states")
    if metadata.method not in records and "pieces" not in header:
        raise StorageError(
            f"`{path}` holds a solution by method={metadata.method!r}, which is not known here",
            term=path,
            remedy=f"methods that can be read: {', '.join(records)}",
        )
    if "pieces" in header:
        outcome = _joined_outcome(header, arrays, path, records)
    else:
        outcome = _outcome(header, records[metadata.method], arrays)
    _check(outcome, metadata)
    if "digest" not in arrays:
        raise ValueError("it has no digest, so whether it is as it was saved is not known")
    if str(arrays["digest"][()]) != digest_of(arrays):
        raise ValueError("its contents do not fit their digest: it was changed after it was saved")
    return outcome, metadata


def _header(arrays: Arrays, path: Path) -> dict[str, Any]:
    """The header, if it is one that this version understands."""
    if "header" not in arrays:
        raise not_a_solution(path)
    header = json.loads(str(arrays["header"][()]))
    if isinstance(header, dict) and header.get("format") == FIELD_FORMAT:
        raise StorageError(
            f"`{path}` holds fields, not a plain solution",
            term=path,
            remedy="read it in Python by rankone.load, and save outputs: "
            "solution.output({...}).save(...)",
        )
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise not_a_solution(path)
    version = header["format_version"]
    if type(version) is not int or version < 1:
        raise ValueError(f"format_version is {version!r}")
    if version > FORMAT_VERSION:
        raise StorageError(
            f"`{path}` has version {version} of the format; this rankone reads up to "
            f"version {FORMAT_VERSION}",
            term=path,
            remedy="upgrade rankone",
        )
    return header


def _outcome(header: Mapping[str, Any], record: type[SlabRecord], arrays: Arrays) -> Outcome:
    hints = get_type_hints(Outcome)
    bases = [_basis(fields) for fields in header["bases"]]
    slabs = [
        _slab(i, fields, tuple(bases[k] for k in fields["bases"]), arrays)
        for i, fields in enumerate(header["slabs"])
    ]
    return Outcome(
        slabs=tuple(slabs),
        history=tuple(rebuilt(record, entry) for entry in header["history"]),
        timeline=rebuilt(Timeline | None, header.get("timeline"))
        or rebuilt(BranchedTimeline | None, header.get("branches")),
        **{name: rebuilt(hints[name], header[name]) for name in _PLAIN},
    )


def _joined_outcome(
    header: Mapping[str, Any],
    arrays: Arrays,
    path: Path,
    records: Mapping[str, type[SlabRecord]],
) -> Outcome:
    """The outcome of a solution that was joined of pieces, with these."""
    count = rebuilt(int, header["pieces"])
    own = [WithPrefix(arrays, piece_prefix(i)) for i in range(count)]
    pieces = tuple(Piece(*unpacked(piece, path, records)) for piece in own)
    if count < 2 or any(piece.outcome.pieces or not piece.outcome.slabs for piece in pieces):
        raise ValueError("it is said to be joined of pieces, and has none")
    outcome = _outcome({**header, "slabs": [], "history": []}, SlabRecord, arrays)
    history = tuple(record for piece in pieces for record in piece.outcome.history)
    return replace(outcome, pieces=pieces, history=history)


class WithPrefix(Mapping[str, NDArray[Any]]):
    """The arrays of a file whose names begin with a prefix, without it."""

    def __init__(self, arrays: Arrays, prefix: str) -> None:
        self._arrays, self._prefix = arrays, prefix

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self._arrays[self._prefix + name]

    def __iter__(self) -> Iterator[str]:
        size = len(self._prefix)
        return (name[size:] for name in self._arrays if name.startswith(self._prefix))

    def __len__(self) -> int:
        return sum(1 for _ in self)


def _fields(basis: Basis1D) -> dict[str, Any]:
    """One basis as plain data; its scale is left out where it is the parameter itself."""
    fields: dict[str, Any] = {"kind": basis.kind, **plain(basis)}
    del fields["scale"]
    if not basis.scale.is_identity:
        fields["scale"] = {"kind": basis.scale.kind, **plain(basis.scale)}
    return fields


def _basis(fields: Mapping[str, Any]) -> Basis1D:
    """One basis; its breaks fit the number of elements."""
    unscaled = {name: content for name, content in fields.items() if name != "scale"}
    basis: Basis1D = rebuilt(BASES[fields["kind"]], unscaled)
    if "scale" in fields:
        scale: Scale = rebuilt(type(SCALES[fields["scale"]["kind"]]), fields["scale"])
        basis = replace(basis, scale=scale)
    if basis.breaks and basis.elements != fields["elements"]:
        raise ValueError("the breaks of a basis do not fit")
    if min(basis.degree, basis.elements) < 1:
        raise ValueError("a basis has no nodes")
    return basis


def _slab(
    index: int, fields: Mapping[str, Any], bases: tuple[Basis1D, ...], arrays: Arrays
) -> SlabTrain:
    """One slab; its cores are float64 and fit together and to their bases."""
    cores = tuple(arrays[f"core_{index}_{j}"] for j in range(len(bases) + 1))
    for core, following in zip(cores, (*cores[1:], None), strict=True):
        rank = 1 if following is None else following.shape[0]
        if core.dtype != np.float64 or core.ndim != 3 or core.shape[2] != rank or not core.size:
            raise ValueError(f"the cores of slab {index} do not fit together")
    if any(core.shape[1] != basis.size for core, basis in zip(cores[1:], bases, strict=True)):
        raise ValueError(f"the cores of slab {index} do not fit their bases")
    return SlabTrain(
        rebuilt(float, fields["start"]), rebuilt(float, fields["end"]), Train(cores), bases
    )


def _check(outcome: Outcome, metadata: SolutionMetadata) -> None:
    """Raise a ValueError unless the entries of a file fit each other."""
    states, parameters = len(metadata.states), len(metadata.parameters)
    timeline = outcome.timeline
    rows = states if timeline is None else states + CLOCK_STATES
    counts = {(len(slab.cores[0]), len(slab.bases)) for slab in outcome.slabs}
    if isinstance(timeline, BranchedTimeline):
        counts = _check_branches(timeline, outcome.slabs, states, parameters)
    measured = states if outcome.measured is None else len(outcome.measured.interior)
    if counts | {(rows, len(metadata.box))} != {(rows, parameters)} or measured != states:
        raise ValueError("the names do not fit the cores")
    if outcome.pieces:
        _check_pieces(outcome, metadata)
    counted = None if outcome.measured is None else outcome.measured.counted
    if counted is not None and not (counted and {*counted} <= {*range(states)}):
        raise ValueError(f"the states that count are {counted}, of {states}")
    _check_texts(metadata)
    for subject, interval in (
        ("the horizon", metadata.horizon),
        *((f"the range of {name}", metadata.box[j]) for j, name in enumerate(metadata.parameters)),
    ):
        if not -math.inf < interval[0] < interval[1] < math.inf:
            raise ValueError(f"{subject} is {interval}, not two finite ascending numbers")
    span = metadata.horizon
    if timeline is not None:
        branches = timeline.branches if isinstance(timeline, BranchedTimeline) else (timeline,)
        for branch in branches:
            _check_timeline(branch, span, parameters)
        span = (0.0, float(timeline.stretches))
    if not outcome.pieces:
        _check_slabs(outcome, metadata, span)
        _check_end(outcome, span)
    _check_error(outcome, metadata.rtol)


def _check_pieces(outcome: Outcome, metadata: SolutionMetadata) -> None:
    """Raise a ValueError unless pieces tile the box, and are as good as the whole is said to be."""
    pieces = [piece.metadata for piece in outcome.pieces]
    alike = {(piece.states, piece.parameters, piece.horizon) for piece in pieces}
    if alike != {(metadata.states, metadata.parameters, metadata.horizon)}:
        raise ValueError("its pieces are of different problems")
    if Tiling.of([piece.box for piece in pieces], metadata.parameters).box != metadata.box:
        raise ValueError("its pieces do not tile the box")
    statuses = {piece.outcome.status for piece in outcome.pieces}
    if outcome.status is Status.CONVERGED and statuses != {Status.CONVERGED}:
        raise ValueError("the status is CONVERGED, and that of a piece is not")


def _check_end(outcome: Outcome, span: tuple[float, float]) -> None:
    """Raise a ValueError if a solution converged without reaching the end."""
    end = span[1]
    if outcome.status is Status.CONVERGED and not outcome.slabs[-1].end >= end - _near(span):
        raise ValueError(
            f"the status is CONVERGED, but the last slab ends at {outcome.slabs[-1].end}, not {end}"
        )


def _check_texts(metadata: SolutionMetadata) -> None:
    """Raise a ValueError for names that a problem cannot have, or texts of several lines."""
    named = [(metadata.time, "the time")]
    named += [(name, f"parameter {quote(name)}") for name in metadata.parameters]
    named += [(name, f"unknown {quote(name)}") for name in metadata.states]
    defect = name_defect(named)
    if defect is not None:
        raise ValueError(defect[1])
    lines = {
        "the title": (metadata.name,),
        "an equation": metadata.equations,
        "a unit": tuple(text for pair in metadata.units for text in pair),
        "a distribution": tuple(text for pair in metadata.distributions for text in pair),
        "a correlation": tuple(name for *pair, _ in metadata.correlations for name in pair),
        "a fixed coordinate": tuple(name for name, _ in metadata.fixed),
        "a constant": tuple(name for name, _ in metadata.constants),
        "a definition": tuple(text for pair in metadata.definitions for text in pair),
        "the version": (metadata.version,),
    }
    for subject, texts in lines.items():
        for text in texts:
            if not is_line(text):
                raise ValueError(f"{subject} is {text!r}, no text that can be printed in one line")
    random = {n for *pair, _ in metadata.correlations for n in pair}
    if not random | {*dict(metadata.distributions)} <= {*metadata.parameters}:
        raise ValueError("a distribution or a correlation is of something else than a parameter")
    if not {*metadata.additive} <= {*metadata.parameters}:
        raise ValueError("what is additive is something else than a parameter")
    if not all(math.isfinite(at) for _, at in metadata.fixed):
        raise ValueError("a fixed coordinate is not finite")
    if not all(math.isfinite(value) for _, value in metadata.constants):
        raise ValueError("a constant is not finite")
    if not all(name in metadata.states and 0.0 <= size < math.inf for name, size in metadata.atol):
        raise ValueError("an absolute tolerance is not finite, or of something else than a state")


def _check_timeline(timeline: Timeline, horizon: tuple[float, float], parameters: int) -> None:
    """Raise a ValueError unless the entries of a timeline fit each other."""
    names = {name for instant in timeline.instants for name in instant}
    if timeline.horizon != horizon or len(timeline.resets) != len(timeline.instants):
        raise ValueError("the timeline does not fit the horizon, or itself")
    if timeline.stretches < 1 or not all(map(is_line, {*names, *timeline.events})):
        raise ValueError("the timeline has no stretch, or an event a name of several lines")
    for border, numbers in timeline.affine_times:
        fits = 0 < border <= timeline.stretches and len(numbers) in (1, 1 + parameters)
        if not fits or not all(map(math.isfinite, numbers)):
            raise ValueError(f"the time of border {border} is {numbers}, which is none")


def _check_branches(
    timeline: BranchedTimeline, slabs: Sequence[SlabTrain], states: int, parameters: int
) -> set[tuple[int, int]]:
    """The rows and parameters of slabs without guards; a ValueError for forks that do not fit."""
    branches = range(len(timeline.branches))
    if not branches or len(timeline.guards) != len(branches):
        raise ValueError("the guards do not fit the branches")
    if len(timeline.tolerances) != states or not timeline.width > 0.0:
        raise ValueError("the tolerances of the branches do not fit the states")
    for fork in timeline.forks:
        guards = timeline.guards[fork.first] if fork.first in branches else 0
        fits = fork.first in branches and fork.second in branches and fork.stretch >= -1
        if not fits or (fork.guard is not None and not 0 <= fork.guard < guards):
            raise ValueError(f"{fork} is between no branches")
    for grazing in timeline.grazings:
        guards = timeline.guards[grazing.branch] if grazing.branch in branches else 0
        if not 0 <= grazing.guard < guards or not grazing.scale > 0.0:
            raise ValueError(f"{grazing} is of no branch")
    for opening in timeline.openings:
        guards = timeline.guards[opening.parent] if opening.parent in branches else 0
        fits = opening.parent < opening.branch and opening.branch in branches
        if not fits or not 0 <= opening.guard < guards or not 0.0 <= opening.lower < opening.upper:
            raise ValueError(f"{opening} is between no branches")
    counts = set()
    for slab in slabs:
        k = timeline.branch_of(0.5 * (slab.start + slab.end))
        if k not in branches:
            raise ValueError("the slabs do not fit the branches")
        roots = len(timeline.roots_of(k))
        counts.add((len(slab.cores[0]) - timeline.guards[k], len(slab.bases) - roots))
    return counts


def _check_slabs(outcome: Outcome, metadata: SolutionMetadata, span: tuple[float, float]) -> None:
    """Raise a ValueError unless slabs follow each other over a span and cover the box."""
    begin, end = span
    near, timeline = _near(span), outcome.timeline
    slabs = outcome.slabs
    for i, slab in enumerate(slabs):
        if not -math.inf < slab.start < slab.end < math.inf:
            raise ValueError(f"slab {i} is ({slab.start}, {slab.end}), which does not ascend")
        before = slabs[i - 1].end if i else begin
        if abs(slab.start - before) > near or slab.end > end + near:
            raise ValueError(
                f"slab {i} is ({slab.start}, {slab.end}) after {before} in a horizon up to {end}"
            )
        box = metadata.box
        if isinstance(timeline, BranchedTimeline):
            box = (*box, *timeline.roots_of(timeline.branch_of(0.5 * (slab.start + slab.end))))
        for basis, interval in zip(slab.bases, box, strict=True):
            if (basis.lower, basis.upper) != interval:
                raise ValueError(f"a basis of slab {i} is not one on {interval}")
        if not all(np.isfinite(core).all() for core in slab.cores):
            raise ValueError(f"the cores of slab {i} are not finite")


def _near(span: tuple[float, float]) -> float:
    """By how much neighbouring slabs may miss each other."""
    begin, end = span
    return NEGLIGIBLE * (end - begin)


def _check_error(outcome: Outcome, rtol: float) -> None:
    """Raise a ValueError if a solution converged without an error within the tolerance."""
    if not 0.0 < rtol < math.inf:
        raise ValueError(f"rtol is {rtol}, not a positive number")
    if outcome.status is Status.CONVERGED:
        measured = outcome.measured
        errors = None if measured is None else measured.interior
        if measured is None or not all(e >= 0.0 for e in errors or ()) or measured.error > rtol:
            raise ValueError(f"the status is CONVERGED, the measured error {errors}, rtol {rtol}")
