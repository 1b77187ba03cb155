"""What the scripts of the gallery share: reference trajectories, errors, and where figures go.

Every script takes ``--to DIR`` or ``--update``, see :func:`run_script`.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import io
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

import matplotlib  # noqa: E402

matplotlib.use("Agg")

import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
import scipy.integrate  # noqa: E402
import sympy as sp  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from PIL import Image  # noqa: E402

import rankone as ro  # noqa: E402
from examples import lotka_volterra  # noqa: E402

__all__ = [
    "PAGE",
    "ROOT",
    "Array",
    "error_of",
    "figure",
    "lotka_volterra_until",
    "march",
    "publish",
    "run_script",
    "save",
    "slope",
    "table",
    "trajectories",
]

Array = NDArray[np.float64]

FOLDER = ROOT / "docs" / "gallery"
PAGE = FOLDER / "gallery.md"
POINTS, TIMES, SEED = 256, 21, 4711
MOST_BYTES = 120_000

plt.rcParams.update(
    {
        "font.size": 9,
        "axes.titlesize": 9,
        "axes.grid": True,
        "grid.alpha": 0.3,
        "lines.linewidth": 1.4,
        "lines.markersize": 4,
        "legend.fontsize": 8,
        "legend.framealpha": 0.6,
    }
)


# --- trajectories and errors -------------------------------------------------------------------


def trajectories(compiled: ro.CompiledProblem, points: Array, times: Array) -> Array:
    """SciPy trajectories (DOP853, rtol 1e-11) for parameters (m, d): shape (n, m, times).

    All points are integrated together as one stacked system.
    """
    system = compiled.system
    count, n = len(points), system.n_differential
    start = np.zeros((n, count))
    rows = [system.parameter_factors(j, column) for j, column in enumerate(points.T)]
    for coefficient, state, factors in system.initial_terms:
        product = np.full(count, coefficient)
        for row, index in zip(rows, factors, strict=True):
            product = product * row[index]
        start[state] += product

    def stacked(t: float, y: Array) -> Array:
        rates = system.rhs(t, y.reshape(n, count), points.T)
        return np.asarray(np.broadcast_to(rates, (n, count)).ravel())

    sizes = np.maximum(np.abs(start).max(axis=1), 1.0)
    done = scipy.integrate.solve_ivp(
        stacked,
        (system.horizon[0], times[-1]),
        start.ravel(),
        method="DOP853",
        t_eval=times,
        rtol=1e-11,
        atol=np.repeat(1e-13 * sizes, count),
    )
    assert done.success, done.message
    return np.asarray(done.y.reshape(n, count, times.size))


@cache
def _reference(compiled: ro.CompiledProblem) -> tuple[Array, Array, Array]:
    lower, upper = np.array(compiled.system.box).T
    points = np.random.default_rng(SEED).uniform(lower, upper, (POINTS, lower.size))
    times = np.linspace(*compiled.system.horizon, TIMES)
    return points, times, trajectories(compiled, points, times)


def error_of(compiled: ro.CompiledProblem, solution: ro.Solution) -> float:
    """The error measured everywhere in this project (DESIGN, section 4).

    The largest difference over 256 random parameter points and 21 equispaced times, of each
    unknown relative to its largest value; of these the largest. NaN if the solution is partial.
    """
    points, times, exact = _reference(compiled)
    if solution.time[1] < times[-1]:
        return float("nan")
    values: dict[str, Any] = {
        name: column[:, None] for name, column in zip(solution.parameters, points.T, strict=True)
    }
    got = solution(times, values)
    sizes = np.abs(exact).max(axis=(1, 2))
    return float((np.abs(got - exact[: len(got)]).max(axis=(1, 2)) / sizes[: len(got)]).max())


def march(compiled: ro.CompiledProblem, **options: Any) -> tuple[ro.Solution, float]:
    """Solve once; the seconds are those of the engine alone, without the check against SciPy."""
    solution = compiled.solve(**options)
    return solution, solution.timings["march"]


def slope(x: Any, y: Any) -> float:
    """Slope of the line through log y over log x."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def lotka_volterra_until(end: float) -> ro.Problem:
    """The example's problem up to another time."""
    problem = lotka_volterra
    x, y, t = problem.x, problem.y, problem.t
    return ro.Problem(
        equations=[sp.Eq(x.diff(t), x * (1.5 - y)), sp.Eq(y.diff(t), -y * (3 - x))],
        time=(t, 0, end),
        parameters={problem.x0: (8, 12), problem.y0: (4, 6)},
        initial={x: problem.x0, y: problem.y0},
        name="Lotka-Volterra",
    )


# --- figures and tables ------------------------------------------------------------------------


def figure(rows: int, columns: int, **options: Any) -> tuple[Figure, Any]:
    """A figure of a common size, and its axes as an array (rows, columns)."""
    size = (3.1 * columns, 2.6 * rows)
    return plt.subplots(
        rows, columns, **{"figsize": size, "layout": "constrained", "squeeze": False, **options}
    )


def save(drawn: Figure, name: str, folder: Path) -> Path:
    """Write a figure as ``name.png``; it must stay small."""
    path = folder / f"{name}.png"
    buffer = io.BytesIO()
    drawn.savefig(buffer, dpi=110)
    plt.close(drawn)
    # a palette makes the file a third as large
    Image.open(buffer).convert("RGB").quantize(128).save(path, optimize=True)
    assert path.stat().st_size <= MOST_BYTES, f"{path.name}: {path.stat().st_size} bytes"
    print(f"wrote {path.relative_to(ROOT) if path.is_relative_to(ROOT) else path}")
    return path


def table(head: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(head) + " |", "|---" + "|--:" * (len(head) - 1) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def publish(
    name: str, text: str, drawn: dict[str, Figure], folder: Path, page: Path = PAGE
) -> None:
    """Print the numbers found and write the figures to a folder.

    If it is the folder of the docs, the numbers are written into their page, too, between
    ``<!-- found: name -->`` and ``<!-- /found -->``.
    """
    print(text)
    for title, one in drawn.items():
        save(one, title, folder)
    if folder != FOLDER:
        return
    before, mark, rest = page.read_text().partition(f"<!-- found: {name} -->\n")
    assert mark, f"{page.name} has no place for {name}"
    _, end, after = rest.partition("<!-- /found -->")
    page.write_text(f"{before}{mark}{text.strip()}\n{end}{after}")


def run_script(main: Callable[[Path], None], arguments: Sequence[str] | None = None) -> None:
    """Call ``main`` with the folder for its figures, as the command line says.

    It is a new temporary one, or that of ``--to DIR``; that of the docs only with ``--update``.
    """
    parser = argparse.ArgumentParser(description="Print the numbers found and write the figures.")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--to", metavar="DIR", type=Path, help="folder for the figures")
    where.add_argument("--update", action="store_true", help="rewrite those shown in the docs")
    options = parser.parse_args(arguments)
    if options.update:
        folder = FOLDER
    else:
        folder = options.to or Path(tempfile.mkdtemp(prefix="gallery-"))
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            parser.error(f"--to {folder}: {error.strerror}")
        if folder.samefile(FOLDER):
            parser.error("the figures of the docs are rewritten by --update only")
    main(folder)
    print(f"figures are in {folder}")
