"""Solving, evaluation, files and the command line of the standalone solver.

This module is the last part of every exported solver: the exporter carries it over with all that
it refers to. It is written against the library, which is why it is type checked and linted here,
and it knows neither SymPy nor a problem: the solver's own names are handed in.
"""

from __future__ import annotations

import argparse
import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from rankone.discretization import BASES
from rankone.errors import (
    ConvergenceError,
    EvaluationError,
    OptionError,
    RankoneError,
    StorageError,
)
from rankone.solution import SolutionMetadata
from rankone.solvers.outcome import Outcome, Status
from rankone.solvers.request import checked_rtol, delivered
from rankone.storage import slab_arrays
from rankone.system import Array, System
from rankone.tensors.slab import SlabTrain

__all__ = ["Solution", "load", "run", "solve_system"]

_CHUNK = 4096
"""Points evaluated at once."""
_LARGEST_GRID = 20_000_000
"""Largest number of values on a grid of the command line."""


def system_features(system: System) -> tuple[tuple[float, ...], list[list[float]]]:
    """Nothing to cut at: every known function of this problem is a polynomial."""
    return (), [[] for _ in system.BOX]


class Solution:
    """The unknowns as functions of time and of all parameters.

    ``solution(t=1.0, x0=9.0)`` has the shape (unknowns, *broadcast shape of the values);
    ``solution.grid(t=times, x0=values)`` has one axis for each coordinate. Values outside of the
    box or of the horizon are errors.
    """

    def __init__(self, outcome: Outcome, metadata: SolutionMetadata) -> None:
        self.outcome, self.metadata = outcome, metadata
        self.success = outcome.status is Status.CONVERGED
        self.message, self.unknowns = outcome.message, metadata.unknowns
        self.parameters = dict(zip(metadata.parameters, metadata.box, strict=True))
        start, end = metadata.horizon
        reached = outcome.slabs[-1].end if outcome.slabs else start
        self.time = start, end if abs(end - reached) <= 1e-10 * (end - start) else reached
        self._intervals = {metadata.time: self.time, **self.parameters}

    @property
    def error(self) -> float:
        """Largest measured error, relative to each state's size; NaN if it was not measured."""
        measured = self.outcome.measured
        return math.nan if measured is None else max(measured.interior)

    def __call__(self, values: Mapping[str, Any] | None = None, /, **named: Any) -> Array:
        """Values of all unknowns; coordinates by keyword, or in a mapping from their names."""
        return self._at(np.broadcast_arrays(*self._checked({**(values or {}), **named})))

    def grid(self, values: Mapping[str, Any] | None = None, /, **named: Any) -> Array:
        """Values of all unknowns for every combination of the coordinates."""
        axes = self._checked({**(values or {}), **named})
        return self._at(np.meshgrid(*axes, indexing="ij"))

    def save(self, path: str, *, overwrite: bool = False) -> None:
        """Write the solution to a file, which `load` and `rankone.load` read."""
        write_arrays(path, slab_arrays(self), overwrite)  # type: ignore[arg-type]

    def _checked(self, given: Mapping[str, Any]) -> list[Array]:
        """The values of all coordinates, time first; none may be outside of its interval."""
        if given.keys() != self._intervals.keys():
            expected = ", ".join(self._intervals)
            raise EvaluationError(f"values of {', '.join(given)} were given, not of {expected}")
        arrays = []
        for name, (lower, upper) in self._intervals.items():
            array = np.asarray(given[name], dtype=float)
            slack = max(1e-12 * (upper - lower), 4.0 * np.spacing(max(abs(lower), abs(upper))))
            if not np.all((array >= lower - slack) & (array <= upper + slack)):
                raise EvaluationError(f"`{name}` is not everywhere in [{lower:.12g}, {upper:.12g}]")
            arrays.append(np.clip(array, lower, upper))
        return arrays

    def _at(self, coordinates: Sequence[Array]) -> Array:
        """Values at time and parameters, arrays of one shape: (unknowns, *shape)."""
        points = np.array([values.ravel() for values in coordinates])
        slabs = self.outcome.slabs
        if not slabs:
            raise EvaluationError(f"nothing was solved: {self.message}")
        values = np.empty((len(self.unknowns), points.shape[1]))
        owner = np.searchsorted([slab.start for slab in slabs[1:]], points[0], side="right")
        for index in np.unique(owner):
            here = np.flatnonzero(owner == index)
            for begin in range(0, here.size, _CHUNK):
                part = here[begin : begin + _CHUNK]
                states = slabs[index](points[0, part], points[1:, part])
                values[:, part] = states[: len(self.unknowns)]
        return values.reshape(-1, *coordinates[0].shape)


def write_arrays(path: str, arrays: Mapping[str, Any], overwrite: bool) -> None:
    """Write an .npz file; it is either complete or not there."""
    target = Path(path)
    if target.exists() and not overwrite:
        raise StorageError(f"`{target}` exists", remedy="choose another name, or overwrite")
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        with partial.open("xb") as file:
            np.savez(file, allow_pickle=False, **arrays)
        partial.replace(target)
    except OSError as error:
        raise StorageError(f"`{target}` cannot be written: {error}") from error
    finally:
        partial.unlink(missing_ok=True)


def load(path: str) -> Solution:
    """Read a solution that was saved; its history is left in the file."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            header = json.loads(str(arrays["header"][()]))
            if header["format"] != "rankone-solution" or header["format_version"] != 1:
                raise StorageError(f"`{path}` is no solution of version 1")
            size = ("lower", "upper", "degree", "elements")
            bases = [
                BASES[fields["kind"]](*(fields[key] for key in size)) for fields in header["bases"]
            ]
            slabs = []
            for i, slab in enumerate(header["slabs"]):
                own = tuple(bases[k] for k in slab["bases"])
                cores = tuple(arrays[f"core_{i}_{j}"] for j in range(len(own) + 1))
                slabs.append(SlabTrain(slab["start"], slab["end"], cores, own))
    except (OSError, LookupError, TypeError, ValueError) as error:
        raise StorageError(f"`{path}` cannot be read as a solution: {error}") from error
    fields = {key: _frozen(value) for key, value in header["metadata"].items()}
    outcome = Outcome(tuple(slabs), Status[header["status"]], header["message"], None, ())
    return Solution(outcome, SolutionMetadata(**fields))


def _frozen(value: Any) -> Any:
    """Lists as tuples, at every depth."""
    return tuple(_frozen(item) for item in value) if isinstance(value, list) else value


def solve_system(
    system: System,
    metadata: SolutionMetadata,
    engine: Callable[..., Outcome],
    engine_options: Any,
    rtol: float,
    parameters: Mapping[str, Sequence[float]] | None,
    t_final: float | None,
    check: int,
) -> Solution:
    """Solve the system on its own box and horizon, or on others."""
    rtol = checked_rtol(rtol)
    start, end = metadata.horizon
    horizon = _interval("the horizon", (start, end if t_final is None else t_final))
    box = dict(zip(metadata.parameters, metadata.box, strict=True))
    for name, interval in (parameters or {}).items():
        if name not in box:
            raise OptionError(
                f"there is no parameter `{name}`", remedy=f"choose from {', '.join(box)}"
            )
        box[name] = _interval(f"the range of `{name}`", interval)
    moved: Any = SimpleNamespace(**{**vars(system), "TIME": horizon, "BOX": tuple(box.values())})
    for j, (name, (lower, upper)) in enumerate(box.items()):
        with np.errstate(all="ignore"):
            if not np.isfinite(system.parameter_factors(j, np.linspace(lower, upper, 257))).all():
                raise OptionError(f"a coefficient is not finite for `{name}` in its range")
    with one_blas_thread():
        outcome = engine(moved, rtol, engine_options, check)
    asked = replace(metadata, box=moved.BOX, horizon=horizon, rtol=rtol)
    return delivered(Solution(outcome, asked), outcome, "return")  # type: ignore


def _interval(what: str, given: Sequence[float]) -> tuple[float, float]:
    try:
        lower, upper = (float(value) for value in given)
    except (TypeError, ValueError):
        lower = upper = math.nan
    if not (math.isfinite(lower) and math.isfinite(upper) and lower < upper):
        raise OptionError(f"{what} is {given!r}, not two numbers in ascending order")
    return lower, upper


def one_blas_thread() -> AbstractContextManager[Any]:
    """Small products run fastest on one thread; without threadpoolctl, set OMP_NUM_THREADS=1."""
    try:
        from threadpoolctl import threadpool_limits
    except ImportError:
        return nullcontext()
    limits: AbstractContextManager[Any] = threadpool_limits(1, "blas")
    return limits


def run(solve: Callable[..., Solution], description: str, argv: Sequence[str] | None = None) -> int:
    """Run the command line: the exit status is 0, 1 (tolerance not reached) or 2 (bad input)."""
    parser = argparse.ArgumentParser(
        description=description,
        epilog="status: 0 the measured error is within the tolerance, 1 it is not, 2 bad input",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    pair, span = "NAME=VALUE", "NAME=LOWER:UPPER"
    add("--rtol", type=float, default=1e-6, help="relative tolerance (default: %(default)g)")
    add("--box", nargs="+", metavar=span, default=[], help="other ranges of parameters")
    add("--t-final", type=float, metavar="T", help="another end of the horizon")
    add("--at", nargs="+", metavar=pair, help="evaluate at one time and parameter point")
    add("--grid", type=int, metavar="N", help="evaluate on N values of every coordinate")
    add("--load", metavar="PATH", help="take a saved solution instead of solving")
    add("--save", metavar="PATH", help="write the values on the grid, or else the solution (.npz)")
    add("--overwrite", action="store_true", help="let --save replace a file")
    add("--json", action="store_true", help="print JSON")
    given = parser.parse_args(argv)
    try:
        if given.load:
            solution = load(given.load)
        else:
            ranges = {k: [float(x) for x in v.split(":")] for k, v in _pairs(given.box)}
            solution = solve(given.rtol, parameters=ranges, t_final=given.t_final)
        summary: dict[str, Any] = {"success": solution.success, "message": solution.message}
        if given.at:
            values = solution({name: float(text) for name, text in _pairs(given.at)})
            summary["values"] = dict(zip(solution.unknowns, values.tolist(), strict=True))
        if given.grid is not None:
            arrays = _grid(solution, given.grid)
        if given.save and given.grid is not None:
            write_arrays(given.save, arrays, given.overwrite)
        elif given.save:
            solution.save(given.save, overwrite=given.overwrite)
    except (RankoneError, ValueError) as error:
        parser.exit(1 if isinstance(error, ConvergenceError) else 2, f"error: {error}\n")
    if given.json:
        print(json.dumps(summary))
    else:
        print(solution.message)
        for name, value in summary.get("values", {}).items():
            print(f"{name} = {value!r}")
    return 0 if solution.success else 1


def _pairs(texts: Sequence[str]) -> list[tuple[str, str]]:
    """Names and values from texts of the form NAME=VALUE."""
    pairs = [text.partition("=") for text in texts]
    if wrong := [name for name, sign, value in pairs if not (sign and value)]:
        raise OptionError(f"{wrong[0]!r} is not of the form NAME=VALUE")
    return [(name, value) for name, _, value in pairs]


def _grid(solution: Solution, count: int) -> dict[str, Array]:
    """Axes and unknowns on a tensor grid, by name."""
    intervals = {solution.metadata.time: solution.time, **solution.parameters}
    if count < 1 or count ** len(intervals) * len(solution.unknowns) > _LARGEST_GRID:
        raise OptionError(f"a grid of {count} values in {len(intervals)} dimensions is too large")
    axes = {name: np.linspace(*interval, count) for name, interval in intervals.items()}
    return axes | dict(zip(solution.unknowns, solution.grid(axes), strict=True))
