"""``rankone solve --split --checkpoint --executor``: pieces of a box, side by side, which go on."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from rankone.commands.common import complain
from rankone.export.program import pairs_of

if TYPE_CHECKING:
    from rankone.interface.compiled import CompiledProblem
    from rankone.interface.solution import Solution

_SPLIT_HELP = "solve pieces of the box, as many of each parameter as its number says, and join them"
_CHECKPOINT_HELP = (
    "a folder for finished solutions; after an interrupt the same command goes on from there"
)
_EXECUTOR_HELP = (
    "how many processes solve pieces side by side, or the address of a scheduler of dask, "
    "tcp://host:port; without --split they share the trajectories of the solve"
)


def add_pieces(add: Callable[..., object]) -> None:
    """Add the options to the parser of ``rankone solve``."""
    add("--split", metavar="NAME=COUNT", nargs="+", action="extend", help=_SPLIT_HELP)
    add("--checkpoint", metavar="FOLDER", help=_CHECKPOINT_HELP)
    add("--executor", metavar="N|ADDRESS", type=_executor, help=_EXECUTOR_HELP)


def in_pieces(arguments: argparse.Namespace) -> bool:
    """Whether what is asked for is a solve of pieces, or of one that is kept in a checkpoint."""
    return arguments.split is not None or arguments.checkpoint is not None


def solve_pieces(
    compiled: CompiledProblem,
    arguments: argparse.Namespace,
    options: Mapping[str, Any],
    progress: bool,
) -> Solution:
    """One solution of all pieces; a table of them on stderr if one is without success."""
    import rankone

    boxes = compiled.problem.split(pairs_of("--split", arguments.split, int, "NAME=COUNT"))
    pieces = rankone.solve_many(
        compiled,
        boxes,
        executor=arguments.executor,
        checkpoint=arguments.checkpoint,
        progress=progress,
        **options,
    )
    if len(pieces) == 1:
        return pieces[0]
    if not pieces.success and not arguments.quiet:
        complain(str(pieces))
    return pieces.join()


def _executor(text: str) -> int | str:
    return int(text) if text.isdecimal() else text
