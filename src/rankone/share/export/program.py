"""Solving, loading and the command line of every standalone solver.

The exporter bundles this module with all that it imports. It knows neither SymPy nor a problem: the
generated system and the functions of the front are handed in.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from rankone.solution.evaluation.core import SolutionCore, raise_blow_up
from rankone.solution.evaluation.event_times import EventTimes
from rankone.solution.storage.npz import read, target
from rankone.solvers.outcome import SlabRecord, SolutionMetadata
from rankone.solvers.request import SOLVE_ARGUMENTS, SolveRequest
from rankone.solvers.selection import solve_with
from rankone.solvers.ways import Engine
from rankone.support.arrays import MOST_NUMBERS, Array
from rankone.support.budget import EFFORT_HELP, MEMORY_HELP, SECONDS_HELP, effort_of
from rankone.support.errors import ConvergenceError, OptionError, RankoneError, StorageError, quote
from rankone.support.files import npz, write_files
from rankone.support.options import INTEGRATOR_HELP, INTEGRATORS
from rankone.trajectories.system.system import System

_PAIR_FORM = "NAME=VALUE"  # How a number for a name is written on the command line
_RANGE_FORM = "NAME=LOWER:UPPER[:SCALE]"  # How a range of a parameter is written
_STATES_HELP = "all: derivatives that are states (x_t) as well, at the point and on the grid"
Parsed = TypeVar("Parsed")


def solve_system(
    engine: Engine, system: System, metadata: SolutionMetadata, request: SolveRequest
) -> EventTimes:
    """Solve the system on its own box and horizon, or on others."""
    solution = EventTimes(*solve_with([engine], system, request, metadata))

    def on_box(intervals: Mapping[int, tuple[float, float]], factor: float) -> EventTimes:
        return solve_system(engine, system, metadata, request.on_box(intervals, factor))

    raise_blow_up(solution, on_box)
    return solution


def load_solution(
    path: str, expected: SolutionMetadata, records: Mapping[str, type[SlabRecord]]
) -> EventTimes:
    """Read a solution of the same equations."""
    outcome, metadata = read(path, records)
    if (metadata.equations, metadata.parameters) != (expected.equations, expected.parameters):
        raise StorageError(f"`{path}` holds the solution of other equations")
    return EventTimes(outcome, metadata)


def run(solve: Callable[..., SolutionCore], load: Callable[[str], SolutionCore], about: str) -> int:
    """Run the command line of a solver with these functions; ``about`` begins its help.

    Returns the exit status: 0, 1 (tolerance not reached) or 2 (bad input).
    """
    parser = _parser(about)
    arguments = parser.parse_args()
    limits = ("effort", "max_seconds", "max_memory")
    for_solves = ("rtol", "box", "t_final", *limits, "integrator", "options")
    if arguments.load is not None and any(vars(arguments)[n] is not None for n in for_solves):
        refused = "--rtol, --box, --t-final, --effort, --max-seconds, --max-memory, "
        refused += "--integrator or --options"
        parser.error(f"--load takes a solution as it is: no {refused}")
    if arguments.grid is not None and arguments.save is None:
        parser.error("--grid needs --save")
    solution = None
    try:
        if arguments.save is not None:  # find out before the solve, not after it
            target(arguments.save, arguments.overwrite)
        solution = _solved(solve, arguments) if arguments.load is None else load(arguments.load)
        if arguments.save is not None:
            _save(solution, arguments)
        states = _states_at(solution, arguments)
    except KeyboardInterrupt:
        parser.exit(130, "interrupted\n")
    except RankoneError as error:
        failed = isinstance(error, ConvergenceError) or (solution and not solution.success)
        parser.exit(1 if failed else 2, f"error: {error}\n")
    if arguments.json:
        print(json.dumps(_summary(solution) | ({"values": states} if states else {})))
    else:
        print(solution.message)
        for name, value in states.items():
            print(f"{name} = {value!r}")
    return 0 if solution.success else 1


def _parser(description: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=description,
        epilog="status: 0 the measured error is within the tolerance, 1 it is not, 2 bad input",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--rtol", type=float, help="relative tolerance (default: 1e-6)")
    add("--box", nargs="+", action="extend", metavar=_RANGE_FORM, help="other ranges of parameters")
    add("--t-final", type=float, metavar="T", help="another end of the horizon")
    add("--effort", metavar="E", type=effort_of, help=EFFORT_HELP)
    add("--max-seconds", type=float, metavar="S", help=SECONDS_HELP)
    add("--max-memory", metavar="SIZE", help=MEMORY_HELP)
    add("--integrator", choices=INTEGRATORS, help=INTEGRATOR_HELP)
    add("--options", nargs="+", action="extend", metavar=_PAIR_FORM, help="options of the engine")
    add("--at", nargs="+", action="extend", metavar=_PAIR_FORM, help="evaluate at one point")
    add("--grid", type=int, metavar="N", help="evaluate on N values of every coordinate")
    add("--states", choices=("unknowns", "all"), default="unknowns", help=_STATES_HELP)
    add("--load", metavar="PATH", help="take a saved solution instead of solving")
    add("--save", metavar="PATH", help="write the values on the grid, or else the solution (.npz)")
    add("--overwrite", action="store_true", help="let --save replace a file")
    add("--json", action="store_true", help="print JSON")
    return parser


def _solved(solve: Callable[..., SolutionCore], arguments: argparse.Namespace) -> SolutionCore:
    """Solve as the command line asks; after a blow-up return the solution before it."""
    try:
        return solve(
            1e-6 if arguments.rtol is None else arguments.rtol,
            parameters=box_of(arguments.box),
            t_final=arguments.t_final,
            effort="normal" if arguments.effort is None else arguments.effort,
            max_seconds=arguments.max_seconds,
            max_memory=arguments.max_memory,
            integrator=arguments.integrator or "auto",
            **options_of(arguments.options, SOLVE_ARGUMENTS),
        )
    except ConvergenceError as error:
        if not isinstance(error.solution, SolutionCore):
            raise
        print(f"error: {error}", file=sys.stderr)
        return error.solution


def box_of(texts: Sequence[str] | None, option: str = "--box") -> dict[str, list[float | str]]:
    """Ranges of parameters as ``--box`` has them: ``0.5:1.5``, or ``1e-3:10:log``."""

    def interval(text: str) -> list[float | str]:
        fields = text.split(":")
        return [*map(float, fields[:2]), *fields[2:]]

    return pairs_of(option, texts, interval, _RANGE_FORM)


def options_of(texts: Sequence[str] | None, reserved: Sequence[str]) -> dict[str, Any]:
    """Options of the engine as ``--options`` has them; ``reserved`` are arguments of ``solve``."""
    as_json = "-0123456789["  # numbers and lists of numbers begin with one of these
    options = pairs_of("--options", texts, lambda v: json.loads(v) if v[:1] in as_json else v)
    for name in options:
        if name in reserved:
            raise OptionError(f"--options: {quote(name)} is not an option of the engine")
    return options


def pairs_of(
    option: str, texts: Sequence[str] | None, read: Callable[[str], Parsed], form: str = _PAIR_FORM
) -> dict[str, Parsed]:
    """Pairs ``NAME=...`` as a dictionary; ``read`` converts the text after the equals sign."""
    pairs: dict[str, Parsed] = {}
    for text in texts or ():
        name, _, right = text.rpartition("=")
        if name in pairs:
            raise OptionError(f"{option}: {text!r} has a name that is given twice")
        try:
            pairs[name] = read(right)
        except (ValueError, RecursionError):
            name = ""
        if not name:
            raise OptionError(f"{option}: {text!r} cannot be read", remedy=f"write {form}")
    return pairs


def _save(solution: SolutionCore, arguments: argparse.Namespace) -> None:
    """Write the solution, or its states on a grid."""
    if arguments.grid is None:
        solution.save(arguments.save, overwrite=arguments.overwrite)
        return
    content = npz(_grid(solution, arguments.grid, _names(solution, arguments)))
    path = target(arguments.save, arguments.overwrite)
    write_files({path: content}, arguments.overwrite, StorageError)


def _summary(solution: SolutionCore) -> dict[str, object]:
    """How good a solution is; errors that are not known are null."""
    return {
        "success": solution.success,
        "message": solution.message,
        "error": _finite_or_none(solution.error),
        "errors": {name: _finite_or_none(solution.errors[name]) for name in solution.states},
        "corner_error": _finite_or_none(solution.corner_error),
        "narrower": solution.outcome.verdict.narrower,
    }


def _finite_or_none(error: float) -> float | None:
    return float(error) if np.isfinite(error) else None


def _names(solution: SolutionCore, arguments: argparse.Namespace) -> tuple[str, ...]:
    """The states that are evaluated."""
    return solution.states if arguments.states == "all" else solution.unknowns


def _grid(solution: SolutionCore, count: int, names: Sequence[str]) -> dict[str, Array]:
    """Axes and states on a tensor grid by name."""
    intervals = {solution.metadata.time: solution.time, **solution.parameters}
    if count < 1 or count ** len(intervals) * len(names) > MOST_NUMBERS:
        raise OptionError(f"--grid {count}: from 1 on, at most {MOST_NUMBERS:,} values in all")
    axes = {name: np.linspace(*interval, count) for name, interval in intervals.items()}
    return axes | {name: solution[name].grid(axes) for name in names}


def _states_at(solution: SolutionCore, arguments: argparse.Namespace) -> dict[str, float]:
    """The states at the point asked for, by name; nothing without a point."""
    if not arguments.at:
        return {}
    at = pairs_of("--at", arguments.at, float)
    return {name: float(solution[name](at)) for name in _names(solution, arguments)}
