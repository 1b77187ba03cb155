"""Check densities, quantiles and indices: python -m tests.benchmarks.distributions

A Markdown table of the functions of ``tests/reference/random_functions.py``, each solved at rtol
1e-6, and a summary:

- *density*: the L1 error, from probabilities of 4096 cells of the range, of ``solution.density``
  without what is within one of its bandwidths of a jump or pole of the true density, at most 0.03;
- *quantiles*: the true probability of the returned quantiles against what was asked for;
- *probabilities*: at the true quantiles;
- *Sobol*: first and total indices.

Errors are held against the half widths of 95 % that are stated, ``half_width`` of what is returned
(of a quantile in probability; of indices ``first_half_width`` and ``total_half_width``). Where
there is none: 1.96 × the standard error ``error`` of a probability; 1e-3, which the reference
states, for a quantile; what the error of the solution allows for an index. The truth is good to
TRUTH, which every comparison allows. Seconds are those of the processor: the solve, and statistics.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import fnmatch
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

import rankone as ro
from tests.reference.measure import Array
from tests.reference.random_functions import (
    PROBABILITIES,
    SEED,
    TRUTH,
    RandomFunction,
    random_functions,
    snippet,
)

RTOL = 1e-6
MOST_L1, MOST_HALF_WIDTH = 0.03, 1e-2
_CELLS = 4096
_NORMAL = 1.96  # Half width of 95 % over a standard error
_DOCUMENTED = 1e-3  # Of probabilities of quantiles, if nothing is stated beside them


@dataclass(frozen=True)
class Errors:
    """Errors and the half widths that are stated, of the same shape."""

    off: Array
    stated: Array

    @property
    def held(self) -> Array:
        return np.abs(self.off) <= self.stated + TRUTH

    def text(self) -> str:
        return f"{np.abs(self.off).max():.1e} / {self.stated.max():.1e}"


@dataclass(frozen=True)
class Row:
    """A line of the table; nothing but a message if there is no solution."""

    function: RandomFunction
    seconds: tuple[float, float]
    l1: float = np.nan
    bandwidth: float = np.nan
    quantiles: Errors | None = None
    probabilities: Errors | None = None
    sobol: Errors | None = None
    moments: float = np.nan
    message: str = ""

    def text(self) -> str:
        solve, statistics = self.seconds
        if self.quantiles is None or self.probabilities is None or self.sobol is None:
            return f"| {self.function.name} | | | | | | {solve:.2f} | | {self.message[:100]} |"
        parts = (self.quantiles, self.probabilities, self.sobol)
        marks = ["" if part.held.all() else " *" for part in parts]
        cells = [
            f"{self.l1:.4f}{'' if self.l1 <= MOST_L1 else ' *'}",
            *(part.text() + mark for part, mark in zip(parts, marks, strict=True)),
            f"{self.moments:.1e}",
        ]
        times = f"{solve:.2f} | {statistics:.2f}"
        return f"| {self.function.name} | {' | '.join(cells)} | {times} | {self.message[:100]} |"


def l1_error(function: RandomFunction, density: ro.Density) -> float:
    """Of a density, without what is within one bandwidth of jumps and poles of the true one."""
    lower, upper = function.range
    x, y = density.values, density.density
    edges = np.linspace(min(lower, x[0]), max(upper, x[-1]), _CELLS + 1)
    every = np.union1d(x, edges)
    heights = np.interp(every, x, y, left=0.0, right=0.0)
    masses = 0.5 * (heights[1:] + heights[:-1]) * np.diff(every)
    cumulative = np.concatenate([[0.0], np.cumsum(masses)])
    estimated = np.diff(np.interp(edges, every, cumulative))
    true = np.diff(function.cdf(edges))
    away = np.ones(_CELLS, dtype=bool)
    for place in function.breaks:
        away &= (edges[:-1] > place + density.bandwidth) | (edges[1:] < place - density.bandwidth)
    return float(np.abs(estimated - true)[away].sum())


def _stated(of: object, names: tuple[str, ...], otherwise: Array) -> Array:
    for name in names:
        stated = getattr(of, name, None)
        if stated is not None:
            return np.broadcast_to(np.asarray(stated, dtype=float), otherwise.shape)
    return otherwise


def _of_quantiles(function: RandomFunction, solution: ro.Solution, count: dict) -> Errors:
    q = np.array(PROBABILITIES)
    found = solution.quantile(q, function.end, **count)
    off = function.cdf(np.asarray(found)[:, 0]) - q
    stated = getattr(found, "half_width", None)
    widths = np.full(q.size, _DOCUMENTED)
    if stated is not None:
        widths = np.broadcast_to(np.asarray(stated, dtype=float).reshape(-1), q.shape)
    return Errors(off, widths)


def _of_probabilities(function: RandomFunction, solution: ro.Solution, count: dict) -> Errors:
    q, off, stated = np.array(PROBABILITIES), [], []
    for limit, true in zip(function.quantile(q), q, strict=True):
        found = solution.probability(function.end, below=float(limit), **count)
        off.append(float(found.value) - true)
        error = np.asarray(getattr(found, "error", np.nan))
        stated.append(float(_stated(found, ("half_width",), _NORMAL * error)))
    return Errors(np.array(off), np.array(stated))


def _of_sobol(function: RandomFunction, solution: ro.Solution) -> Errors:
    found = solution.sobol([function.end])
    off = np.array([found.first[0, :, 0], found.total[0, :, 0]]) - np.array(function.sobol)
    size, spread = max(map(abs, function.range)), np.sqrt(function.moments[1])
    allowed = np.full(off.shape[1], 2.0 * solution.error * size / spread)
    shares = {}
    for which, share in zip(("first", "total"), (found.first, found.total), strict=True):
        whole = np.broadcast_to(allowed[None, :, None], share.shape)
        names = (f"{which}_half_width", f"{which}_error", "half_width", "error")
        shares[which] = _stated(found, names, whole)[0, :, 0]
    return Errors(off, np.array([shares["first"], shares["total"]]))


def measured(function: RandomFunction, chosen: dict) -> Row:
    """A row of the table."""
    began = time.process_time()
    try:
        solution = ro.solve(function.problem(), rtol=RTOL)
    except ro.RankoneError as refused:
        seconds = (time.process_time() - began, 0.0)
        return Row(function, seconds, message=" ".join(str(refused).split()))
    solved = time.process_time() - began
    if not solution.success:
        return Row(function, (solved, 0.0), message=" ".join(solution.message.split()))
    began = time.process_time()
    mean, variance = function.moments
    means = float(solution.mean(function.end)[0]), float(solution.var(function.end)[0])
    moments = max(abs(means[0] - mean) / np.sqrt(variance), abs(means[1] / variance - 1.0))
    density = solution.density(function.end, **chosen)
    quantiles = _of_quantiles(function, solution, chosen)
    probabilities = _of_probabilities(function, solution, chosen)
    sobol = _of_sobol(function, solution)
    seconds = (solved, time.process_time() - began)
    l1 = l1_error(function, density)
    return Row(function, seconds, l1, density.bandwidth, quantiles, probabilities, sobol, moments)


def _share(of: Array) -> str:
    return f"{np.count_nonzero(of)} of {of.size} ({100 * np.mean(of):.1f} %)"


def summary(rows: list[Row]) -> Iterator[str]:
    """Shares of the functions, and of what is stated."""
    solved = [row for row in rows if row.quantiles is not None]
    yield f"{len(solved)} of {len(rows)} solved"
    if not solved:
        return
    l1 = np.array([row.l1 for row in solved])
    yield f"density: L1 at most {MOST_L1} in {_share(l1 <= MOST_L1)}; largest {l1.max():.3f}"
    for name in ("quantiles", "probabilities", "sobol"):
        parts: list[Errors] = [getattr(row, name) for row in solved]
        held = np.concatenate([part.held.ravel() for part in parts])
        off = np.concatenate([np.abs(part.off).ravel() for part in parts])
        line = f"{name}: stated errors hold in {_share(held)}; largest error {off.max():.1e}"
        if name != "sobol":
            widths = np.concatenate([part.stated.ravel() for part in parts])
            line += f"; half width at most {MOST_HALF_WIDTH} in {_share(widths <= MOST_HALF_WIDTH)}"
            line += f", largest {widths.max():.1e}"
        yield line
    moments = np.array([row.moments for row in solved])
    yield f"mean and variance: largest error {moments.max():.1e} (relative to the spread)"
    families = dict.fromkeys(row.function.family for row in solved)
    for family in families:
        of_family = np.array([row.l1 for row in solved if row.function.family == family])
        yield f"  density of {family}: {_share(of_family <= MOST_L1)}"
    yield f"{sum(sum(row.seconds) for row in rows):.0f} s of the processor"


def main() -> None:
    """Print the table and its summary."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="*", help="names, with wildcards")
    parser.add_argument("--count", type=int, help="points, in place of the defaults")
    parser.add_argument("--seed", type=int, default=SEED, help="of the functions")
    chosen = parser.parse_args()
    warnings.simplefilter("ignore", ro.RankoneWarning)  # of parameters that are in no term
    count = {} if chosen.count is None else {"count": chosen.count}
    print("Errors, each / the stated half width; * where it does not hold\n")
    print("| function | L1 | quantiles | probabilities | Sobol | moments | solve s | s | |")
    print("|---|---|---|---|---|---|---|---|---|")
    rows = []
    for function in (snippet(), *random_functions(chosen.seed)):
        if fnmatch.fnmatch(function.name, chosen.only):
            rows.append(measured(function, count))
            print(rows[-1].text(), flush=True)
    print()
    print("\n".join(summary(rows)))


if __name__ == "__main__":
    main()
