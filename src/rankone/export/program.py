"""Solving, evaluation, files and the command line of the standalone solver.

This module is the last part of every exported solver: the exporter carries it over with all that
it refers to. It is written against the library, which is why it is type checked and linted here,
and it knows neither SymPy nor a problem: the solver's own names are handed in.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rankone.arrays import Array
from rankone.discretization import BASES
from rankone.domain import Domain, check_factors
from rankone.errors import (
    ConvergenceError,
    EvaluationError,
    OptionError,
    RankoneError,
    StorageError,
)
from rankone.progress import quiet
from rankone.solution import SolutionMetadata
from rankone.solvers.engine import Engine
from rankone.solvers.outcome import Measured, Outcome, Status
from rankone.solvers.request import raise_blow_up
from rankone.storage import FORMAT, FORMAT_VERSION, free_target, slab_arrays, write_arrays
from rankone.system import System
from rankone.tensors.slab import SlabTrain

__all__ = ["Solution", "load_solution", "run", "solve_system"]

_CHUNK = 4096
"""Points evaluated at once."""
_LARGEST_GRID = 20_000_000
"""Largest number of values on a grid of the command line."""


def system_breakpoints(
    system: System, domain: Domain
) -> tuple[tuple[float, ...], list[list[float]]]:
    """Nothing to cut at: every known function of this problem is a polynomial."""
    return (), [[] for _ in domain.box]


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
            outside = array[~((array >= lower - slack) & (array <= upper + slack))]
            if outside.size:
                interval = f"[{lower:.12g}, {upper:.12g}]"
                raise EvaluationError(f"`{name}` is {outside[0]:.12g}, not in {interval}")
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
        return values.reshape(len(values), *coordinates[0].shape)


def load_solution(path: str, expected: SolutionMetadata) -> Solution:
    """Read a solution of the same equations; the history of its solve is left in the file."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            header = json.loads(str(arrays["header"][()]))
            if (header["format"], header["format_version"]) != (FORMAT, FORMAT_VERSION):
                raise ValueError(f"no {FORMAT} of version {FORMAT_VERSION}")
            bases = [BASES[fields.pop("kind")](**fields) for fields in header["bases"]]
            slabs = []
            for i, slab in enumerate(header["slabs"]):
                own = tuple(bases[k] for k in slab["bases"])
                cores = tuple(arrays[f"core_{i}_{j}"] for j in range(len(own) + 1))
                slabs.append(SlabTrain(slab["start"], slab["end"], cores, own))
        metadata = SolutionMetadata(**{k: _frozen(v) for k, v in header["metadata"].items()})
        status, measured = Status[header["status"]], header["measured"]
        if measured is not None:
            errors = [tuple(map(float, measured[key])) for key in ("interior", "corners")]
            measured = Measured(errors[0], errors[1], measured["points"], measured["method"])
        timings, message = header["timings"], header["message"]
    except Exception as error:  # a damaged archive fails in many ways
        reason = getattr(error, "strerror", None) or "it is no solution, or damaged"
        raise StorageError(f"`{path}` cannot be read: {reason}") from error
    if (metadata.equations, metadata.parameters) != (expected.equations, expected.parameters):
        raise StorageError(f"`{path}` holds the solution of other equations")
    return Solution(Outcome(tuple(slabs), status, message, measured, (), timings), metadata)


def _frozen(value: Any) -> Any:
    """Lists as tuples, at every depth."""
    return tuple(_frozen(item) for item in value) if isinstance(value, list) else value


def solve_system(
    system: System,
    metadata: SolutionMetadata,
    engine: Engine[Any],
    engine_options: Mapping[str, Any],
    rtol: float,
    parameters: Mapping[str, Sequence[float]] | None,
    t_final: float | None,
    check: bool | int,
) -> Solution:
    """Solve the system on its own box and horizon, or on others."""
    request = engine.request(rtol, check, engine_options)
    domain = Domain.of(system).moved(metadata.parameters, parameters, t_final)
    check_factors(system, domain)
    outcome = engine.solve(system, domain, request, quiet)
    changes = {"box": domain.box, "horizon": domain.horizon, "rtol": request.rtol}
    solution = Solution(outcome, replace(metadata, **changes))  # type: ignore[arg-type]
    raise_blow_up(solution, outcome)  # type: ignore[arg-type]
    return solution


def run(solve: Callable[..., Solution], load: Callable[[str], Solution], description: str) -> int:
    """Run the command line: the exit status is 0, 1 (tolerance not reached) or 2 (bad input)."""
    parser = argparse.ArgumentParser(
        description=description,
        epilog="status: 0 the measured error is within the tolerance, 1 it is not, 2 bad input",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    pair, span = "NAME=VALUE", "NAME=LOWER:UPPER"
    add("--rtol", type=float, help="relative tolerance (default: 1e-6)")
    add("--box", nargs="+", action="extend", metavar=span, help="other ranges of parameters")
    add("--t-final", type=float, metavar="T", help="another end of the horizon")
    add("--options", nargs="+", action="extend", metavar=pair, help="options of the engine")
    add("--at", nargs="+", action="extend", metavar=pair, help="evaluate at one point")
    add("--grid", type=int, metavar="N", help="evaluate on N values of every coordinate")
    add("--load", metavar="PATH", help="take a saved solution instead of solving")
    add("--save", metavar="PATH", help="write the values on the grid, or else the solution (.npz)")
    add("--overwrite", action="store_true", help="let --save replace a file")
    add("--json", action="store_true", help="print JSON")
    given = parser.parse_args()
    asked = given.rtol, given.box, given.t_final, given.options
    if given.load is not None and any(value is not None for value in asked):
        parser.error("--load takes a solution as it is: no --rtol, --box, --t-final or --options")
    if given.grid is not None and given.save is None:
        parser.error("--grid needs --save")
    solution = None
    try:
        if given.save is not None:
            free_target(given.save, given.overwrite)
        solution = load(given.load) if given.load is not None else _solved(solve, given)
        summary: dict[str, Any] = {"success": solution.success, "message": solution.message}
        if given.save is not None and given.grid is None:
            solution.save(given.save, overwrite=given.overwrite)
        elif given.save is not None:
            write_arrays(given.save, _grid(solution, given.grid), given.overwrite)
        if given.at:
            values = solution(_pairs("--at", given.at, float))
            summary["values"] = dict(zip(solution.unknowns, values.tolist(), strict=True))
    except KeyboardInterrupt:
        parser.exit(130, "interrupted\n")
    except RankoneError as error:
        failed = isinstance(error, ConvergenceError) or (solution and not solution.success)
        parser.exit(1 if failed else 2, f"error: {error}\n")
    if given.json:
        print(json.dumps(summary))
    else:
        print(solution.message)
        for name, value in summary.get("values", {}).items():
            print(f"{name} = {value!r}")
    return 0 if solution.success else 1


def _solved(solve: Callable[..., Solution], given: argparse.Namespace) -> Solution:
    """Solve as the command line asks; after a blow-up take the part before it."""
    box = _pairs("--box", given.box, lambda text: [float(x) for x in text.split(":")])
    as_json = "-0123456789["  # what begins with one of these is a number or a list of them
    options = _pairs("--options", given.options, lambda v: json.loads(v) if v[:1] in as_json else v)
    if own := options.keys() & {"rtol", "parameters", "t_final", "check"}:
        raise OptionError(f"--options: {own} are no options of the engine")
    rtol = 1e-6 if given.rtol is None else given.rtol
    try:
        return solve(rtol, parameters=box, t_final=given.t_final, **options)
    except ConvergenceError as error:
        if error.solution is None:
            raise
        print(f"error: {error}", file=sys.stderr)
        return error.solution  # type: ignore[return-value]


def _pairs(option: str, texts: Sequence[str] | None, read: Callable[[str], Any]) -> dict[str, Any]:
    """Values by name from texts of the form NAME=VALUE."""
    values: dict[str, Any] = {}
    for text in texts or ():
        name, _, value = text.rpartition("=")
        if not name or name in values:
            raise OptionError(f"{option}: {text!r} has no name, or one that is given twice")
        try:
            values[name] = read(value)
        except ValueError:
            raise OptionError(f"{option}: {text!r} cannot be read; --help has the form") from None
    return values


def _grid(solution: Solution, count: int) -> dict[str, Array]:
    """Axes and unknowns on a tensor grid, by name."""
    intervals = {solution.metadata.time: solution.time, **solution.parameters}
    if count < 1 or count ** len(intervals) * len(solution.unknowns) > _LARGEST_GRID:
        raise OptionError(f"--grid {count}: from 1 on, at most {_LARGEST_GRID:,} values in all")
    axes = {name: np.linspace(*interval, count) for name, interval in intervals.items()}
    return axes | dict(zip(solution.unknowns, solution.grid(axes), strict=True))
