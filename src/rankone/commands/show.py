"""``rankone show FILE``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from rankone.commands.inputs import PROBLEM_HELP, SUCCESS, layout

__all__ = ["register", "run"]

_STAGES = {
    "first-order": ("first-order system", "first_order"),
    "weak-form": ("weak form", "weak_form"),
    "separated": ("separated form", "separated"),
    "lifted": ("lifted form", "lifted"),
    "quadratic": ("quadratic system", "quadratic"),
    "source": ("generated module", "source"),
}
"""What ``show`` prints: for each flag the title and the attribute of the compiled problem."""


def register(commands: Any) -> None:
    """Add the parser."""
    show = commands.add_parser(
        "show",
        help="print what a problem compiles to, from the first-order system to the source",
        description="Print what a problem compiles to; everything if no flag selects.",
        epilog=layout(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    show.add_argument("file", metavar="FILE", type=Path, help=PROBLEM_HELP)
    for stage, (title, _) in _STAGES.items():
        show.add_argument(f"--{stage}", action="store_true", help=f"the {title}")
    show.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print the stages."""
    import rankone
    from rankone.frontend.problem_files import load_problem

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
    return SUCCESS
