"""Compare peaks of solves and calls with ``max_memory``: python tests/benchmarks/memory.py

Peaks are beyond what a process had before. Each solve and each call has a process of its own.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import gc
import resource
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

import numpy as np  # noqa: E402

import rankone as ro  # noqa: E402
from rankone.support.options import checked_memory, in_words  # noqa: E402
from tests.benchmarks.machines import double_well  # noqa: E402


def peak() -> float:
    """Largest memory of this process so far, in bytes."""
    return 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def memory_of(what: str) -> float:
    """Bytes of this process: those it has, ``VmRSS``, or most since :func:`forget_peak`."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024.0 * next(float(line.split()[1]) for line in lines if line.startswith(what))


def forget_peak() -> None:
    """Let Linux begin anew to look for the peak."""
    Path("/proc/self/clear_refs").write_text("5")


def stream(count: int, limit: str) -> None:
    """Evaluate so many points in blocks, and print the peak beyond what the process had."""
    solution = ro.solve(*double_well(1.0, 1e-3)[::2])
    side, before = round(count**0.5), peak()
    axes = {"c": np.linspace(0.1, 0.4, side)[:, None], "x0": np.linspace(0.5, 1.3, side)}
    began, total, values = time.process_time(), 0, 0.0
    for _, block in solution.blocks(t=0.5, a=0.05, v0=0.0, **axes, max_memory=limit):
        total, values = total + block[0].size, values + float(block.sum())
    share = (peak() - before) / checked_memory("limit", limit)
    seconds = time.process_time() - began
    print(f"{total:.3g} points in {seconds:.1f} s: peak {share:.2f} x {limit}", flush=True)


def bouncing() -> Any:
    """A ball that bounces, as often as its drop says."""
    problem = ro.Problem.from_strings(
        {"h": "v", "v": "-g"},
        {"h": "h0", "v": "0"},
        {"g": (9.0, 10.0), "h0": (0.9, 1.1)},
        (0, 2.5),
        events=[{"when": "h", "direction": "falling", "then": {"h": "0", "v": "-0.8*v"}}],
    )
    return ro.solve(problem, 1e-4)


def wells() -> Any:
    """The double well, whole."""
    return ro.solve(*double_well(1.0, 1e-3)[::2])


def pieces() -> Any:
    """The double well, joined of pieces."""
    return ro.solve_many(*double_well(1.0, 1e-3)).join()


def many_states() -> Any:
    """A chain of 300 states."""
    return ro.solve(chain_of(300), 1e-3)


SOLVED = (wells, bouncing, pieces, many_states)
CALLS = ("points", "curves", "grid", "gradient")


def evaluated(of: str, how: str, numbers: int, limit: str) -> None:
    """Evaluate so many numbers by one call within a limit, and print the peak beyond before.

    ``of`` names the solution, and ``how`` the call: of paired points, of curves of 100 times, of a
    grid, or of the gradient.
    """
    solve = {each.__name__: each for each in SOLVED}[of]
    with ProcessPoolExecutor(1, get_context("spawn")) as executor:  # keeps what the solve needed
        solution = executor.submit(solve).result()
    names, box = list(solution.parameters), list(solution.parameters.values())
    each = len(solution.unknowns) * (len(names) if how == "gradient" else 1)
    points, times = numbers // each, np.linspace(*solution.time, 100)
    rng, call = np.random.default_rng(0), solution.grid
    if how == "grid":
        side = int((points / 100) ** (1 / len(names)))
        at = {name: np.linspace(*ends, side) for name, ends in solution.parameters.items()}
    else:
        shape = (points // 100,) if how == "curves" else (points,)
        at = {name: rng.uniform(*ends, shape) for name, ends in zip(names, box, strict=True)}
        times = times[:, None] if how == "curves" else rng.uniform(*solution.time, shape)
        call = solution.gradient if how == "gradient" else solution
    gc.collect()
    forget_peak()
    before, began = memory_of("VmRSS"), time.process_time()
    values = call(times, at, max_memory=limit or None)
    grown = memory_of("VmHWM") - before
    allowed = f", {grown / checked_memory('limit', limit):.2f} x {limit}" if limit else ""
    print(
        f"{how} of {of}, {values.size:.3g} numbers in {time.process_time() - began:.1f} s: "
        f"{in_words(grown)}, {grown / values.nbytes:.2f} x the values{allowed}",
        flush=True,
    )


def chain_of(states: int) -> ro.Problem:
    """A chain of compartments."""
    rates = {f"x{i}": f"k*x{i - 1} - (k + c)*x{i}" for i in range(1, states)}
    return ro.Problem.from_strings(
        {"x0": "-k*x0", **rates},
        {f"x{i}": "1" if i == 0 else "0" for i in range(states)},
        {"k": (7, 14), "c": (1, 2)},
        (0, 2),
    )


def chain(states: int, limit: str | None, method: str = "auto") -> None:
    """Solve a chain of compartments with a limit, and print how it ends and the peak."""
    compiled, before = ro.compile(chain_of(states)), peak()
    solution = compiled.solve(1e-3, method=method, max_memory=limit)
    grown = peak() - before
    text = "" if limit is None else f", {grown / checked_memory('limit', limit):.2f} x {limit}"
    ended = f"{solution.method}: {solution.message[:150]}"
    print(f"{states} states: {in_words(grown)}{text}; {ended}", flush=True)


def memory() -> None:
    """Compare peaks with limits, each in a process of its own."""
    calls = [["stream", "1e7", "100MB"], ["stream", "1e8", "500MB"]]
    for of in SOLVED:
        for how in CALLS:
            calls += [["evaluated", of.__name__, how, "1e7", limit] for limit in ("", "100MB")]
    calls += [["chain", n, limit] for n in ("50", "300") for limit in ("", "50MB", "100MB", "1GB")]
    calls += [["chain", n, limit, "train"] for n in ("20", "150") for limit in ("50MB", "100MB")]
    for call in calls:
        subprocess.run([sys.executable, __file__, *call], check=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.set_defaults(run=lambda _: memory())
    parts = parser.add_subparsers(metavar="PART", help="one of the processes; by default all")
    streaming = parts.add_parser("stream", help=str(stream.__doc__))
    streaming.add_argument("count", type=float)
    streaming.add_argument("limit")
    streaming.set_defaults(run=lambda asked: stream(int(asked.count), asked.limit))
    calling = parts.add_parser("evaluated", help=str(evaluated.__doc__).partition("\n")[0])
    calling.add_argument("of", choices=[each.__name__ for each in SOLVED])
    calling.add_argument("how", choices=CALLS)
    calling.add_argument("numbers", type=float)
    calling.add_argument("limit")
    calling.set_defaults(
        run=lambda asked: evaluated(asked.of, asked.how, int(asked.numbers), asked.limit)
    )
    solving = parts.add_parser("chain", help=str(chain.__doc__))
    solving.add_argument("states", type=int)
    solving.add_argument("limit")
    solving.add_argument("method", nargs="?", default="auto")
    solving.set_defaults(run=lambda asked: chain(asked.states, asked.limit or None, asked.method))
    asked = parser.parse_args()
    asked.run(asked)


if __name__ == "__main__":
    main()
