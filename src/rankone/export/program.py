"""Solving and the command line of the standalone solver.

This module is the last part of every exported solver: the exporter carries it over with all that
it refers to. It is written against the library, which is why it is type checked and linted here,
and it knows neither SymPy nor a problem: the solver's own names are handed in.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from rankone.ir.metadata import SolutionMetadata
from rankone.ir.outcome import SlabRecord
from rankone.ir.request import SOLVE_ARGUMENTS, SolveRequest
from rankone.ir.system import System
from rankone.solution.core import SolutionCore, raise_blow_up
from rankone.solvers.engine import Engine, solve_with
from rankone.storage.npz import read, target
from rankone.support.arrays import Array
from rankone.support.budget import EFFORT_HELP, effort_of
from rankone.support.errors import ConvergenceError, OptionError, RankoneError, StorageError
from rankone.support.files import npz, write_files
from rankone.support.wording import quote

__all__ = ["box_of", "load_solution", "options_of", "pairs_of", "run", "solve_system"]

_LARGEST_GRID = 20_000_000
"""Largest number of values on a grid of the command line."""
_PAIR, _SPAN = "NAME=VALUE", "NAME=LOWER:UPPER"
"""How values and ranges are written on the command line."""
_STATES_HELP = "all: derivatives that are states (x_t) as well, at the point and on the grid"


def solve_system(
    engine: Engine, system: System, metadata: SolutionMetadata, request: SolveRequest
) -> SolutionCore:
    """Solve the system on its own box and horizon, or on others."""
    solution = SolutionCore(*solve_with([engine], system, request, metadata))

    def on_box(intervals: Mapping[int, tuple[float, float]], factor: float) -> SolutionCore:
        return solve_system(engine, system, metadata, request.on_box(intervals, factor))

    raise_blow_up(solution, on_box)
    return solution


def load_solution(
    path: str, expected: SolutionMetadata, records: Mapping[str, type[SlabRecord]]
) -> SolutionCore:
    """Read a solution of the same equations."""
    outcome, metadata = read(path, records)
    if (metadata.equations, metadata.parameters) != (expected.equations, expected.parameters):
        raise StorageError(f"`{path}` holds the solution of other equations")
    return SolutionCore(outcome, metadata)


def run(solve: Callable[..., SolutionCore], load: Callable[[str], SolutionCore], about: str) -> int:
    """Run the command line of a solver with these functions; ``--help`` says ``about`` first.

    Returns the exit status: 0, 1 (tolerance not reached) or 2 (bad input).
    """
    parser = _parser(about)
    given = parser.parse_args()
    limits = given.effort, given.max_seconds
    asked = given.rtol, given.box, given.t_final, *limits, given.options
    if given.load is not None and any(value is not None for value in asked):
        refused = "--rtol, --box, --t-final, --effort, --max-seconds or --options"
        parser.error(f"--load takes a solution as it is: no {refused}")
    if given.grid is not None and given.save is None:
        parser.error("--grid needs --save")
    solution = None
    try:
        if given.save is not None:  # find out before the solve, not after it
            target(given.save, given.overwrite)
        solution = load(given.load) if given.load is not None else _solved(solve, given)
        if given.save is not None:
            _save(solution, given)
        values = _values(solution, given)
    except KeyboardInterrupt:
        parser.exit(130, "interrupted\n")
    except RankoneError as error:
        failed = isinstance(error, ConvergenceError) or (solution and not solution.success)
        parser.exit(1 if failed else 2, f"error: {error}\n")
    if given.json:
        print(json.dumps(_summary(solution) | ({"values": values} if values else {})))
    else:
        print(solution.message)
        for name, value in values.items():
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
    add("--box", nargs="+", action="extend", metavar=_SPAN, help="other ranges of parameters")
    add("--t-final", type=float, metavar="T", help="another end of the horizon")
    add("--effort", metavar="E", type=effort_of, help=EFFORT_HELP)
    add("--max-seconds", type=float, metavar="S", help="time limit; the best so far is kept")
    add("--options", nargs="+", action="extend", metavar=_PAIR, help="options of the engine")
    add("--at", nargs="+", action="extend", metavar=_PAIR, help="evaluate at one point")
    add("--grid", type=int, metavar="N", help="evaluate on N values of every coordinate")
    add("--states", choices=("unknowns", "all"), default="unknowns", help=_STATES_HELP)
    add("--load", metavar="PATH", help="take a saved solution instead of solving")
    add("--save", metavar="PATH", help="write the values on the grid, or else the solution (.npz)")
    add("--overwrite", action="store_true", help="let --save replace a file")
    add("--json", action="store_true", help="print JSON")
    return parser


def _solved(solve: Callable[..., SolutionCore], given: argparse.Namespace) -> SolutionCore:
    """Solve as the command line asks; after a blow-up take the part before it."""
    box, options = box_of(given.box), options_of(given.options, SOLVE_ARGUMENTS)
    effort = "normal" if given.effort is None else given.effort
    limits = {"t_final": given.t_final, "effort": effort, "max_seconds": given.max_seconds}
    rtol = 1e-6 if given.rtol is None else given.rtol
    try:
        return solve(rtol, parameters=box, **limits, **options)
    except ConvergenceError as error:
        if not isinstance(error.solution, SolutionCore):
            raise
        print(f"error: {error}", file=sys.stderr)
        return error.solution


def box_of(texts: Sequence[str] | None) -> dict[str, list[float]]:
    """Ranges of parameters as ``--box`` has them."""
    return pairs_of("--box", texts, lambda text: [float(x) for x in text.split(":")], _SPAN)


def options_of(texts: Sequence[str] | None, others: Sequence[str]) -> dict[str, Any]:
    """Options of the engine as ``--options`` has them; ``others`` are arguments of ``solve``."""
    as_json = "-0123456789["  # what begins with one of these is a number or a list of them
    options = pairs_of("--options", texts, lambda v: json.loads(v) if v[:1] in as_json else v)
    for name in options:
        if name in others:
            raise OptionError(f"--options: {quote(name)} is no option of the engine")
    return options


def _save(solution: SolutionCore, given: argparse.Namespace) -> None:
    """Write the solution, or its values on a grid."""
    if given.grid is None:
        solution.save(given.save, overwrite=given.overwrite)
        return
    arrays = _grid(solution, given.grid, _names(solution, given))
    write_files({target(given.save, given.overwrite): npz(arrays)}, given.overwrite, StorageError)


def _summary(solution: SolutionCore) -> dict[str, Any]:
    """How good a solution is; errors that are not known are null."""
    known = {name: float(error) for name, error in solution.errors.items() if np.isfinite(error)}
    return {
        "success": solution.success,
        "message": solution.message,
        "error": float(solution.error) if np.isfinite(solution.error) else None,
        "errors": {name: known.get(name) for name in solution.states},
        "corner_error": solution.corner_error if np.isfinite(solution.corner_error) else None,
    }


def _names(solution: SolutionCore, given: argparse.Namespace) -> tuple[str, ...]:
    """What is evaluated."""
    return solution.states if given.states == "all" else solution.unknowns


def _grid(solution: SolutionCore, count: int, names: Sequence[str]) -> dict[str, Array]:
    """Axes and states on a tensor grid, by name."""
    intervals = {solution.metadata.time: solution.time, **solution.parameters}
    if count < 1 or count ** len(intervals) * len(names) > _LARGEST_GRID:
        raise OptionError(f"--grid {count}: from 1 on, at most {_LARGEST_GRID:,} values in all")
    axes = {name: np.linspace(*interval, count) for name, interval in intervals.items()}
    return axes | {name: solution[name].grid(axes) for name in names}


def _values(solution: SolutionCore, given: argparse.Namespace) -> dict[str, float]:
    """Values at one point, by name."""
    if not given.at:
        return {}
    at = pairs_of("--at", given.at, float)
    return {name: float(solution[name](at)) for name in _names(solution, given)}


def pairs_of(
    option: str, texts: Sequence[str] | None, read: Callable[[str], Any], form: str = _PAIR
) -> dict[str, Any]:
    """Values by name from texts of a form."""
    values: dict[str, Any] = {}
    for text in texts or ():
        name, _, value = text.rpartition("=")
        if name in values:
            raise OptionError(f"{option}: {text!r} has a name that is given twice")
        try:
            values[name] = read(value)
        except (ValueError, RecursionError):
            name = ""
        if not name:
            raise OptionError(f"{option}: {text!r} cannot be read", remedy=f"write {form}")
    return values
