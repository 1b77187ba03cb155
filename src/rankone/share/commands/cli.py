"""The command line: parsing and dispatch; each command has a module beside this one.

Exit status: 0 if the measured error is within the tolerance, 1 if it is not or is not known,
2 for bad input, 130 after an interrupt.
"""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from collections.abc import Sequence
from typing import Any, NoReturn

from rankone.share.commands import evaluate, report
from rankone.share.commands import export_files as export
from rankone.share.commands import fit_data as fit
from rankone.share.commands import solve_files as solve
from rankone.share.commands.common import BAD_INPUT, FAILURE, complain, spelled
from rankone.share.commands.spelling import spelling

_INTERRUPTED = 130  # Exit status after an interrupt, as shells have it: 128 and the signal
_BROKEN_PIPE = 141  # Exit status when the reader of the output has gone


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, with these arguments or those of the process; the exit status."""
    try:
        arguments = _parser().parse_args(argv)
        spelled.set(spelling(arguments))
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: complain(f"warning: {message}")
            return int(arguments.run(arguments))
    except SystemExit as stop:  # of argparse
        return stop.code if isinstance(stop.code, int) else BAD_INPUT
    except KeyboardInterrupt:
        complain("interrupted")
        return _INTERRUPTED
    except BrokenPipeError:
        # the reader has gone (`| head`); keep Python from flushing into the closed pipe at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _BROKEN_PIPE
    except Exception as error:
        from rankone.support.errors import ConvergenceError, RankoneError

        if not isinstance(error, RankoneError):
            raise
        complain(f"error: {error}")
        return FAILURE if isinstance(error, ConvergenceError) else BAD_INPUT


_SIMILAR = 0.75  # Least similarity of an option that is meant: all begin with the same dashes


class _Parser(argparse.ArgumentParser):
    """Errors in one line; unknown options are told the one that is like them."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        arguments, unknown = super().parse_known_args(args, namespace)
        if unknown:
            from rankone.support.wording import did_you_mean

            options = [option for action in self._actions for option in action.option_strings]
            named = (each.partition("=")[0] for each in unknown if each.startswith("--"))
            hint = next(filter(None, (did_you_mean(each, options, _SIMILAR) for each in named)), "")
            self.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
        return arguments, unknown

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"{self.prog}: error: {message} (see {self.prog} --help)\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="rankone",
        description="Solve a parametric ODE system once, for every parameter value of a box.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for command in (solve, evaluate, report, fit, export):
        command.register(commands)
    return parser


class _Version(argparse.Action):
    """Look the version up only when it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from rankone.support import __version__

        print(f"rankone {__version__}")
        parser.exit()


if __name__ == "__main__":
    sys.exit(main())
