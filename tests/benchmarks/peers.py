"""The reference problems by other tools at equal error: python tests/benchmarks/peers.py

    pip install -e ".[peers]"
    python tests/benchmarks/peers.py --update

rankone first; then each tool of ``peer_tools.py``, at growing sizes until its error is that of
rankone or within the tolerance, whichever is larger. Error is that of tests/reference/measure.py:
256 random points × 21 times, relative to each unknown's size. *Offline* is everything from the
equations to the surrogate: for rankone compiling, solving and checking; for the others the
trajectories and the fit at the size that is reported; *with search* adds the smaller sizes tried
before. *Per curve* is a new parameter point at 21 times, in batches of 1,000. Times are processor
times, SymPy's caches are emptied before rankone is run, and no fit may
take more than ``--seconds`` and ``--gib``. ``--update`` writes the table to docs/which-tool.md.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import resource
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from sympy.core.cache import clear_cache

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

import rankone as ro  # noqa: E402
from rankone.solvers.engines import cross_engine as engine  # noqa: E402
from tests.benchmarks.peer_tools import TOOLS, Samples, Surrogate, Tool  # noqa: E402
from tests.benchmarks.report import TITLES, machine, update  # noqa: E402
from tests.problems import MEASURED  # noqa: E402
from tests.reference.measure import Array, Independent, trajectories  # noqa: E402
from tests.reference.systems import INDEPENDENT  # noqa: E402

PROBLEMS = {
    "decay": 1e-6,
    "linear": 1e-6,
    "free_fall": 1e-6,
    "coupled": 1e-6,
    "lotka_volterra": 1e-6,
    "kirchhoff": 1e-4,
    "kirchhoff_long": 1e-3,
    "chain": 1e-4,
}
CURVES, REPEATED = 1_000, 0.5
"""Parameter points in a batch, and processor seconds for which a measurement is repeated."""

_TIMES = ("offline", "search", "curve")
Curves = Callable[[Array, Array], Array]
"""Unknowns (n, m, times) at points (d, m) and times."""


@dataclass(frozen=True)
class Row:
    """What one tool did with one problem."""

    tool: str
    size: str
    trajectories: int
    offline: float
    search: float
    curve: float
    error: float
    reached: bool


class _TooLongError(BaseException):
    """A fit took more than its time; not among the exceptions that tools catch."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--problem", action="append", choices=PROBLEMS, help="only this one")
    parser.add_argument("--tool", action="append", default=[], help="only tools with this name")
    parser.add_argument("--seconds", type=float, default=40.0, help="most seconds of one fit")
    parser.add_argument("--gib", type=int, default=8, help="most memory of all")
    parser.add_argument("--update", action="store_true", help="write docs/which-tool.md")
    given = parser.parse_args()
    signal.signal(signal.SIGPROF, _stop)
    resource.setrlimit(resource.RLIMIT_AS, (given.gib << 30, given.gib << 30))
    lines = ["| problem | tool | size | trajectories | offline | with search | per curve | error |"]
    lines.append("| --- | --- | --- | --: | --: | --: | --: | --: |")
    for name in given.problem or PROBLEMS:
        rows = [_rankone(name)]
        for tool in TOOLS:
            if not given.tool or any(word in tool.name for word in given.tool):
                rows.append(_peer(tool, name, max(PROBLEMS[name], rows[0].error), given.seconds))
            print(rows[-1], file=sys.stderr, flush=True)
        lines += _shown(f"{TITLES[name]}, {PROBLEMS[name]:.0e}".replace("e-0", "e-"), rows)
    versions = machine() | _versions()
    text = "\n".join([*lines, "", "Measured on " + ", ".join(versions.values()) + "."])
    print(text)
    if given.update:
        update(ROOT / "docs" / "which-tool.md", text)


def _stop(*_: object) -> None:
    raise _TooLongError


def _rankone(name: str) -> Row:
    """rankone as it is, with the check of the error; trajectories sampled and checked."""
    problem, system, made = MEASURED[name](), INDEPENDENT[name], []
    original = engine.Trajectories

    def noted(*given: Any) -> Any:
        made.append(original(*given))
        return made[-1]

    engine.Trajectories = noted
    try:
        solution = ro.solve(problem, rtol=PROBLEMS[name])
    finally:
        engine.Trajectories = original
    count = sum(each.count for each in made) + solution.outcome.measured.points

    def curves(points: Array, times: Array) -> Array:
        values = dict(zip(solution.parameters, points[:, :, None], strict=True))
        return solution({**values, solution.metadata.time: times})

    def afresh() -> None:
        clear_cache()
        ro.solve(problem, rtol=PROBLEMS[name])

    seconds = _seconds(afresh)
    error = _error(curves, system)
    size = f"{solution.method}, rank {solution.rank}"
    curve = _per_curve(curves, system)
    return Row("**rankone**", size, count, seconds, seconds, curve, error, True)


def _peer(tool: Tool, name: str, wanted: float, most: float) -> Row:
    """The smallest size of a tool that reaches an error, or the one that comes closest."""
    system = INDEPENDENT[name]
    prepared = Samples(system, PROBLEMS[name])
    best: tuple[float, int, Surrogate] | None = None
    search = 0.0
    for size in tool.sizes(prepared.dimensions):
        prepared.count = 0
        signal.setitimer(signal.ITIMER_PROF, 1.2 * most, 1.0)
        began = time.process_time()
        try:
            found = tool.fit(prepared, size)
            error = _error(found.curves, system)
        except (_TooLongError, MemoryError):
            break
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
        spent = time.process_time() - began
        search += spent
        if best is None or error < best[0]:
            best, count, offline = (error, size, found), prepared.count, spent
        if error <= wanted or spent > 0.7 * most:
            break
    if best is None:
        return Row(tool.name, "none within the limits", 0, np.nan, np.nan, np.nan, np.nan, False)
    error, size, found = best
    if offline < REPEATED:
        offline = _seconds(lambda: tool.fit(prepared, size))
    curve = _per_curve(found.curves, system)
    size_shown, reached = tool.shown.format(size), error <= wanted
    return Row(tool.name, size_shown, count, offline, search, curve, error, reached)


def _error(curves: Curves, system: Independent) -> float:
    """The largest error as measured everywhere."""
    points, times, exact = trajectories(system)
    differences = np.abs(curves(points, times) - exact)
    return float((differences.max(axis=(1, 2)) / np.abs(exact).max(axis=(1, 2))).max())


def _per_curve(curves: Curves, system: Independent) -> float:
    lower, upper = np.array(system.box).T
    points = np.random.default_rng(3).uniform(lower, upper, (CURVES, lower.size)).T
    times = np.linspace(system.start, system.end, 21)
    return _seconds(lambda: curves(points, times)) / CURVES


def _seconds(run: Callable[[], object]) -> float:
    """Mean processor seconds of as many runs as fit into a while."""
    began, runs = time.process_time(), 0
    while (spent := time.process_time() - began) < REPEATED:
        run()
        runs += 1
    return spent / runs


def _shown(title: str, rows: list[Row]) -> list[str]:
    """Lines of the table; the least times among the rows that reach the error are bold."""
    reached = [row for row in rows if row.reached]
    least = [min(getattr(row, key) for row in reached) for key in _TIMES]

    def text(value: float, least: float) -> str:
        if np.isnan(value):
            return "–"
        unit, factor = ("s", 1.0) if value >= 1 else ("ms", 1e3) if value >= 1e-3 else ("µs", 1e6)
        digits = ".2g" if factor * value < 99.5 else ".0f"
        shown = f"{factor * value:{digits}}\N{NO-BREAK SPACE}{unit}"
        return f"**{shown}**" if value == least else shown

    lines = []
    for row in rows:
        times = [text(getattr(row, key), best) for key, best in zip(_TIMES, least, strict=True)]
        error = "–" if np.isnan(row.error) else f"{row.error:.1e}".replace("e-0", "e-")
        error += "" if row.reached else " (not reached)"
        cells = (title, row.tool, row.size, f"{row.trajectories:,}", *times, error)
        lines.append("| " + " | ".join(cells) + " |")
        title = ""
    return lines


def _versions() -> dict[str, str]:
    from importlib.metadata import version

    return {name: f"{name} {version(name)}" for name in ("chaospy", "teneva", "scikit-learn")}


if __name__ == "__main__":
    main()
