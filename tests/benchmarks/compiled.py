"""What compiled trajectories gain: python tests/benchmarks/compiled.py

Needs heyoka. For each reference problem, for the rates of a stack and for whole trajectories: the
time of a compilation, without heyoka's cache; the time of one of a thousand trajectories of a
stack, over that of one with compiled rates, or of a compiled one. Then the time of a solve
by each integrator, over that of one trajectory of SciPy in a loop (the break-even of report.py),
compiled integrators being kept from the first solve on. Processor time, the least of repetitions
made in turns, in one process.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import heyoka
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

import rankone as ro  # noqa: E402
from rankone.trajectories.integrators import series  # noqa: E402
from rankone.trajectories.integrators.compiled_series import CompiledIntegrator  # noqa: E402
from rankone.trajectories.integrators.integrator import Integrator, Tolerances  # noqa: E402
from rankone.trajectories.stacks.stack import StackedIntegrator  # noqa: E402
from rankone.trajectories.system.system import System  # noqa: E402
from tests.benchmarks.report import TITLES, _trajectory  # noqa: E402
from tests.problems import MEASURED  # noqa: E402
from tests.reference.systems import INDEPENDENT  # noqa: E402

CASES = (
    ("coupled", 1e-6),
    ("lotka_volterra", 1e-4),
    ("lotka_volterra", 1e-6),
    ("robertson", 1e-4),
    ("kirchhoff", 1e-4),
    ("kirchhoff_long", 1e-3),
    ("chain", 1e-4),
)
INTEGRATORS = ("stack", "auto", "compiled")
TRAJECTORIES, TIMES = 1000, 30
"""How many are sampled, at how many times."""
SAMPLING, REFERENCE = 0.03, 0.003
"""Tolerances of sampled trajectories and of the reference, over that of the solve."""
HEADER = ("problem", "rtol", "rates compiled in", "gain", "trajectories compiled in", "gain")
HEADER += (*INTEGRATORS, "sampled by")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--problem", action="append", help="only this one")
    parser.add_argument("--repetitions", type=int, default=5, help="turns (default: %(default)s)")
    arguments = parser.parse_args()
    print("| " + " | ".join(HEADER) + " |")
    print("| --- |" + " --: |" * (len(HEADER) - 1))
    for name, rtol in CASES:
        if not arguments.problem or name in arguments.problem:
            cells = _row(name, rtol, arguments.repetitions)
            print("| " + " | ".join((TITLES[name], f"{rtol:.0e}", *cells)) + " |", flush=True)


def _row(name: str, rtol: float, repetitions: int) -> list[str]:
    compiled = ro.compile(MEASURED[name]())
    system = compiled.system
    order = series.order_of(REFERENCE * rtol)
    rates = series._code(system), *series._shape(system)
    seconds = _compilation(partial(series._compiled_rates.__wrapped__, *rates))
    of_series = _compilation(partial(series.taylor_integrator, system, order))
    stacked, quick, fast = _least(
        [partial(_sample, system, rtol, each) for each in _integrators(rtol)], repetitions
    )
    single = _trajectory(system, INDEPENDENT[name].stiff)
    solves = [partial(compiled.solve, rtol, integrator=each) for each in INTEGRATORS]
    histories = [solve().history[-1].integrator for solve in solves]
    times = _least([*solves, *single.values()], repetitions)
    alone = min(times[len(solves) :])
    ratios = [f"{each / alone:.0f}" for each in times[: len(solves)]]
    cells = [f"{1e3 * seconds:.0f} ms", f"{stacked / quick:.1f}"]
    cells += [f"{1e3 * of_series:.0f} ms", f"{stacked / fast:.1f}"]
    return [*cells, *ratios, ", ".join(histories)]


def _integrators(rtol: float) -> list[Integrator]:
    stack = StackedIntegrator()
    return [stack, StackedIntegrator(compiled=True), CompiledIntegrator(stack, REFERENCE * rtol)]


def _sample(system: System, rtol: float, integrator: Integrator) -> None:
    lower, upper = np.array(system.box).T
    points = np.random.default_rng(0).uniform(lower, upper, (TRAJECTORIES, lower.size))
    times = np.linspace(*system.horizon, TIMES)
    tolerance = SAMPLING * rtol
    sizes = np.abs(system.initial(points.T)).max(axis=1, keepdims=True)
    sizes[sizes == 0.0] = sizes.max()
    tolerances = Tolerances(tolerance, 1e-5 * tolerance * sizes)
    integrator.sample(system, points, list(system.horizon), tolerances, times)


def _compilation(compile_once: Callable[[], object]) -> float:
    """Processor seconds of a compilation, without heyoka's caches and without its import."""
    cached = heyoka.llvm_state.get_memcache_limit()
    heyoka.llvm_state.set_diskcache_enabled(False)
    heyoka.llvm_state.set_memcache_limit(0)
    began = time.process_time()
    compile_once()
    seconds = time.process_time() - began
    heyoka.llvm_state.set_memcache_limit(cached)
    return seconds


def _least(runs: Sequence[Callable[[], object]], repetitions: int) -> list[float]:
    """Least processor seconds of each, made in turns."""
    least = [np.inf] * len(runs)
    for run in runs:
        run()  # what is compiled is kept
    for _ in range(repetitions):
        for k, run in enumerate(runs):
            began = time.process_time()
            run()
            least[k] = min(least[k], time.process_time() - began)
    return least


if __name__ == "__main__":
    main()
