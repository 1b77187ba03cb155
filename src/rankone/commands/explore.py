"""``rankone explore FILE``: a page with sliders for the parameters, and the curves that follow."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rankone.commands.inputs import (
    FAILURE,
    MODEL_RTOL,
    SOLVED_HELP,
    SUCCESS,
    layout,
    may_be_written,
    solution_of,
)

__all__ = ["register", "run"]


def register(commands: Any) -> None:
    """Add the parser."""
    parser = commands.add_parser(
        "explore",
        help="write a page with sliders and curves",
        description="Write one HTML file that works offline: a slider for each parameter, curves "
        "that follow at once, bands over the box, a phase plot, Sobol indices over time.",
        epilog=layout(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("file", metavar="FILE", type=Path, help=SOLVED_HELP)
    parser.add_argument(
        "-o",
        "--output",
        metavar="PATH",
        type=Path,
        help="the page (default: the name of FILE with .html, in the present directory)",
    )
    parser.add_argument(
        "--title", help="title of the page (default: the name of the problem, or that of the page)"
    )
    parser.add_argument("--rtol", type=float, help="tolerance for a problem file (default: 1e-6)")
    parser.add_argument("--method", help="the engine for a problem file (default: auto)")
    parser.add_argument("--model-rtol", **MODEL_RTOL)
    parser.add_argument(
        "--allow-failed",
        action="store_true",
        help="write a page also if the error is not within the tolerance (status 1)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Load or solve, and write the page."""
    from rankone.export import check_options
    from rankone.export.explorer import page_target

    target = arguments.output or Path(f"{arguments.file.stem}.html")
    # before the solve, not after it
    page_target(target, arguments.overwrite)
    check_options(target, rtol=arguments.model_rtol)
    solution = solution_of(arguments.file, arguments.rtol, arguments.method)
    if not may_be_written(solution, arguments):
        return FAILURE
    given = {"overwrite": arguments.overwrite, "allow_failed": arguments.allow_failed}
    path = solution.explore(target, title=arguments.title, rtol=arguments.model_rtol, **given)
    print(path)
    return SUCCESS if solution.success else FAILURE
