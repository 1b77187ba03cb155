"""The command line: ``rankone solve FILE``, ``show``, ``export`` and ``fit``.

Exit status: 0 if the measured error is within the tolerance, 1 if it is not or is not known,
2 for bad input, 130 after an interrupt.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:
    from rankone.solution import Solution

__all__ = ["main"]

_SUCCESS, _FAILURE, _BAD_INPUT, _BROKEN_PIPE, _INTERRUPTED = 0, 1, 2, 141, 130

_STAGES = {
    "first-order": ("first-order system", "first_order"),
    "weak-form": ("weak form", "weak_form"),
    "separated": ("separated form", "separated"),
    "lifted": ("lifted form", "lifted"),
    "quadratic": ("quadratic system", "quadratic"),
    "source": ("generated module", "source"),
}
"""What ``show`` prints: for each flag the title and the attribute of the compiled problem."""
_ARGUMENTS = (
    *("self", "rtol", "method", "parameters", "t_final"),
    *("check", "cover", "max_seconds", "unknowns", "progress", "on_failure"),
)
"""What ``solve`` takes beside options of the engine."""
_FILE_HELP = "a Python file (executed) with a variable `problem`, or a TOML file (see below)"
_EXIT_HELP = """\
exit status:
  0  the measured error is within the tolerance
  1  it is not, or is not known; the summary is printed and the file is saved all the same
  2  bad input
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments without the program's name; those of the process by default.

    Returns
    -------
    int
        The exit status.
    """
    try:
        arguments = _parser().parse_args(argv)
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            return int(arguments.run(arguments))
    except SystemExit as stop:  # of argparse
        return stop.code if isinstance(stop.code, int) else _BAD_INPUT
    except KeyboardInterrupt:
        _complain("interrupted")
        return _INTERRUPTED
    except BrokenPipeError:
        # the reader has gone (`| head`); keep Python from flushing into the closed pipe at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _BROKEN_PIPE
    except Exception as error:
        from rankone.errors import ConvergenceError, RankoneError

        if not isinstance(error, RankoneError):
            raise
        _complain(f"error: {error}")
        return _FAILURE if isinstance(error, ConvergenceError) else _BAD_INPUT


class _Parser(argparse.ArgumentParser):
    """Errors in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(_BAD_INPUT, f"{self.prog}: error: {message} (see {self.prog} --help)\n")


def _parser() -> argparse.ArgumentParser:
    from rankone.commands import fit
    from rankone.problem_files import TOML_LAYOUT

    layout = "layout of a TOML file:\n" + "".join(
        f"  {line}\n" if line else "\n" for line in TOML_LAYOUT.splitlines()
    )
    parser = _Parser(
        prog="rankone",
        description="Solve a parametric ODE system once, for every parameter value of a box.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    solve = commands.add_parser(
        "solve",
        usage="rankone solve FILE [options]",
        help="solve a problem, print a summary and optionally save the solution",
        description="Solve a problem for every parameter value of its box and measure the error.",
        epilog=f"{layout}\n{_EXIT_HELP}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    solve.add_argument("file", metavar="FILE", type=Path, help=_FILE_HELP)
    solve.add_argument(
        "--rtol", type=float, default=1e-6, help="relative tolerance (default: %(default)g)"
    )
    solve.add_argument(
        "--save", metavar="PATH", type=Path, help="write the solution to PATH (.npz, see docs)"
    )
    solve.add_argument("--overwrite", action="store_true", help="let --save replace a file")
    solve.add_argument(
        "--check",
        metavar="N",
        type=_count,
        help="number of check points in the interior; 0 leaves the error unknown (status 1)",
    )
    solve.add_argument(
        "--method", default="auto", help="auto, cross, train or greedy (default: %(default)s)"
    )
    solve.add_argument(
        "--box",
        metavar="NAME=LOWER:UPPER",
        nargs="+",
        action="extend",
        help="other ranges of parameters, for this solve",
    )
    solve.add_argument(
        "--t-final", metavar="T", type=float, help="another end of the horizon, for this solve"
    )
    solve.add_argument(
        "--options",
        metavar="NAME=VALUE",
        nargs="+",
        action="extend",
        help="options of the engine, such as max_rank=300",
    )
    solve.add_argument(
        "--cover",
        choices=("interior", "box"),
        help="whether success covers the corners of the box; by default up to three parameters",
    )
    solve.add_argument(
        "--max-seconds",
        metavar="S",
        type=float,
        help="time limit, 25 by default; the best so far is kept",
    )
    solve.add_argument(
        "--unknowns",
        metavar="NAME",
        nargs="+",
        help="the unknowns whose error has to be within the tolerance; by default all",
    )
    solve.add_argument("--json", action="store_true", help="print the summary as JSON")
    solve.add_argument(
        "--quiet", action="store_true", help="no summary (except --json) and no progress bar"
    )
    solve.set_defaults(run=_solve)

    show = commands.add_parser(
        "show",
        help="print what a problem compiles to, from the first-order system to the source",
        description="Print what a problem compiles to; everything if no flag selects.",
        epilog=layout,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    show.add_argument("file", metavar="FILE", type=Path, help=_FILE_HELP)
    for stage, (title, _) in _STAGES.items():
        show.add_argument(f"--{stage}", action="store_true", help=f"the {title}")
    show.set_defaults(run=_show)

    export = commands.add_parser(
        "export",
        help="write a standalone solver that needs only NumPy and SciPy",
        description="Write a problem and its engine to one Python file, which needs only NumPy "
        "and SciPy and is both a module and a program.",
        epilog=layout,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    export.add_argument("file", metavar="FILE", type=Path, help=_FILE_HELP)
    export.add_argument(
        "-o", "--output", metavar="PATH", type=Path, required=True, help="a .py file"
    )
    export.add_argument("--method", default="auto", help="the engine (default: %(default)s)")
    export.add_argument("--overwrite", action="store_true", help="replace an existing file")
    export.set_defaults(run=_export)

    fit.add(commands)
    return parser


class _Version(argparse.Action):
    """Look the version up only when it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from rankone.version import __version__

        print(f"rankone {__version__}")
        parser.exit()


def _count(text: str) -> int:
    """Parse a number of trajectories."""
    try:
        count = int(text)
    except ValueError:
        count = -1
    if count < 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0")
    return count


def _solve(arguments: argparse.Namespace) -> int:
    """Run ``rankone solve``."""
    import rankone
    from rankone.deadline import preparing
    from rankone.errors import ConvergenceError
    from rankone.export.program import box_of, options_of
    from rankone.problem_files import load_problem
    from rankone.storage import target

    box, options = box_of(arguments.box), options_of(arguments.options, _ARGUMENTS)
    if arguments.save is not None:  # find out before the solve, not after it
        target(arguments.save, arguments.overwrite)

    with preparing(arguments.max_seconds):
        compiled = rankone.compile(load_problem(arguments.file))
    check = True if arguments.check is None else arguments.check or False
    bar = sys.stderr.isatty() and not arguments.quiet
    try:
        solution = compiled.solve(
            rtol=arguments.rtol,
            method=arguments.method,
            parameters=box,
            t_final=arguments.t_final,
            check=check,
            cover=arguments.cover,
            max_seconds=arguments.max_seconds,
            unknowns=arguments.unknowns,
            progress=bar,
            **options,
        )
    except ConvergenceError as error:
        if error.solution is None:
            raise
        _complain(f"error: {error}")
        solution = error.solution
    if arguments.save is not None:
        solution.save(arguments.save, overwrite=arguments.overwrite)
    if arguments.json:
        print(json.dumps(_summary(solution, arguments), indent=2, allow_nan=False))
    elif not arguments.quiet:
        print(solution)
        if arguments.save is not None:
            print(f"  saved     {arguments.save}")
    sys.stdout.flush()
    return _SUCCESS if solution.success else _FAILURE


def _summary(solution: Solution, arguments: argparse.Namespace) -> dict[str, Any]:
    """The summary as plain data; numbers that are not known are null."""
    return {
        "file": str(arguments.file),
        "success": solution.success,
        "status": solution.status.name.lower(),
        "message": solution.message,
        "method": solution.method,
        "rtol": solution.rtol,
        "error": _number(solution.error),
        "errors": {name: _number(error) for name, error in solution.errors.items()},
        "corner_error": _number(solution.corner_error),
        "checked": _checked(solution),
        "unknowns": list(solution.unknowns),
        "time": list(solution.time),
        "parameters": {name: list(interval) for name, interval in solution.parameters.items()},
        "slabs": len(solution.ranks),
        "rank": solution.rank,
        "nodes": list(solution.nodes),
        "timings": solution.timings,
        "version": solution.metadata.version,
        "saved": None if arguments.save is None else str(arguments.save),
    }


def _checked(solution: Solution) -> dict[str, Any] | None:
    """On what the error was measured, and what success covers."""
    measured = solution.outcome.measured
    if measured is None:
        return None
    return {
        "trajectories": measured.points,
        "cover": measured.cover,
        "unknowns": [solution.states[i] for i in measured.counted or range(len(solution.states))],
        "quantile95": measured.quantile,
        "worst": dict(zip(solution.parameters, measured.worst, strict=False)),
    }


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _show(arguments: argparse.Namespace) -> int:
    """Run ``rankone show``."""
    import rankone
    from rankone.problem_files import load_problem

    compiled = rankone.compile(load_problem(arguments.file))
    chosen = vars(arguments)
    flagged = any(chosen[stage.replace("-", "_")] for stage in _STAGES)
    if not flagged:
        print("# methods\n")
        for method, reason in compiled.methods.items():
            print(f"{method:6} {'applies' if reason is None else f'does not apply: {reason}'}")
        print(f"auto   tries {', then '.join(compiled.automatic)}\n")
    there = [stage for stage in _STAGES if stage != "lifted" or compiled.lifted is not None]
    asked = [stage for stage in _STAGES if chosen[stage.replace("-", "_")]] or there
    for number, stage in enumerate(asked):
        title, attribute = _STAGES[stage]
        if len(asked) > 1:
            print(f"{'' if number == 0 else chr(10)}# {title}\n")
        shown = getattr(compiled, attribute)
        reason = "not all terms separate" if stage == "quadratic" else "there is nothing to lift"
        print(f"none: {reason}" if shown is None else str(shown).rstrip("\n"))
    sys.stdout.flush()
    return _SUCCESS


def _export(arguments: argparse.Namespace) -> int:
    """Run ``rankone export``."""
    import rankone
    from rankone.export import solver_target
    from rankone.problem_files import load_problem

    solver_target(arguments.output, arguments.overwrite)

    compiled = rankone.compile(load_problem(arguments.file))
    compiled.export(arguments.output, method=arguments.method, overwrite=arguments.overwrite)
    return _SUCCESS


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    _complain(f"warning: {message}")


def _complain(text: str) -> None:
    print(f"rankone: {text}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
