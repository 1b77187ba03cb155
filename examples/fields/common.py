"""What the scripts of this folder share: their arguments, and figures written to a folder."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.figure import Figure

DPI = 100


def run(
    name: str,
    size: int,
    draw: Callable[[int], Figure],
    page: Callable[[int, Path], Path] | None = None,
) -> None:
    """Solve and draw with the size of the command line; write figure and page to ``--to DIR``."""
    parser = argparse.ArgumentParser(description=f"Solve and draw: {name}.")
    parser.add_argument("size", nargs="?", type=int, default=size, help=f"by default {size}")
    parser.add_argument("--to", type=Path, help="folder of the figure; by default a new one")
    arguments = parser.parse_args()
    folder = arguments.to or Path(tempfile.mkdtemp(prefix="rankone-"))
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.png"
    figure = draw(arguments.size)
    figure.savefig(path, dpi=DPI)
    plt.close(figure)
    print(path)
    if page is not None:
        print(page(arguments.size, folder))
