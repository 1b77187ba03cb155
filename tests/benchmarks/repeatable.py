"""Whether solves end alike on a busy machine: python tests/benchmarks/repeatable.py

Forty solves, ten of them failures, each as a digest of its bits, its engine and its message: on the
machine as it is, with four busy loops beside them, at low priority, and with two workers. Prints
what differs from the first run; the exit status is 1 if something does.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import hashlib
import json
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

import rankone as ro  # noqa: E402
from tests.problems import EXAMPLES  # noqa: E402
from tests.reference.published import PUBLISHED  # noqa: E402

PUBLISHED_ONES = (
    *("pendulum", "fall", "resonance", "kepler", "rigid_body", "mathieu", "josephson", "rlc"),
    *("quadruple_tank", "stommel", "blasius", "lorenz", "roessler", "selkov", "hopfield"),
    *("morris_lecar", "sir", "budworm", "enzyme", "flame", "toggle", "goodwin", "e5", "hires"),
)
ENDS_EARLY = {
    **dict.fromkeys(("chua", "wilson_cowan", "piecewise_oscillator", "minimal_model"), 0.04),
    **dict.fromkeys(("pollu", "bouc_wen", "duffing"), 0.01),
}
"""Published systems that need more work than these efforts allow."""
FAR = ro.Problem.from_strings(
    {"x": "10*(y - x)", "y": "x*(r - z) - y", "z": "x*y - 8*z/3"},
    {"x": "1", "y": "1", "z": "20"},
    {"r": (26, 30)},
    (0, 20),
)
STEEP = ro.Problem.from_strings(
    {"x": "x - x**3 + a"}, {"x": "k"}, {"k": (-0.5, 0.5), "a": (-0.1, 0.1)}, (0, 8)
)
BUSY = "while True: pass"
RUNS = {"quiet": (), "busy": (), "nice": ("nice", "-n", "19"), "workers": ()}

Solve = tuple[str, ro.Problem, float, dict[str, Any]]


def solves() -> Iterator[Solve]:
    """Name, problem, tolerance and options of each solve."""
    for name in ("decay", "free_fall", "coupled", "lotka_volterra", "kirchhoff", "robertson"):
        yield name, EXAMPLES[name].problem, 1e-4, {}
    for name in PUBLISHED_ONES:
        yield name, PUBLISHED[name].problem(), 1e-4, {}
    for name, effort in ENDS_EARLY.items():
        yield name, PUBLISHED[name].problem(), 1e-5, {"effort": effort}
    yield "far", FAR, 1e-5, {"effort": 0.1}
    yield "far, train", FAR, 1e-5, {"effort": 0.1, "method": "train"}
    yield "steep", STEEP, 1e-6, {"effort": 0.3}


def digest(problem: ro.Problem, rtol: float, options: dict[str, Any]) -> dict[str, str]:
    """Bits, engine and message of a solve."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            solution = ro.solve(problem, rtol, **options)
        except ro.RankoneError as error:
            return {"bits": "", "engine": type(error).__name__, "message": str(error)}
    bits = hashlib.sha256()
    for slab in solution.outcome.slabs:
        bits.update(np.array([slab.start, slab.end]).tobytes())
        for core in slab.cores:
            bits.update(np.ascontiguousarray(core).tobytes())
    work = json.dumps(solution.work)
    return {
        "bits": bits.hexdigest()[:16],
        "engine": solution.method,
        "message": solution.message,
        "success": str(solution.success),
        "work": work,
    }


def digests(workers: int | None) -> None:
    """Print the digests of all solves as JSON, a line each."""
    for name, problem, rtol, options in solves():
        takes = workers and options.get("method") != "train"
        more = {"executor": workers} if takes else {}
        print(json.dumps([name, digest(problem, rtol, options | more)]), flush=True)


def run(kind: str) -> dict[str, dict[str, str]]:
    """The digests of one kind of run, made in a process of its own."""
    command = [*RUNS[kind], sys.executable, __file__, "--digests"]
    command += ["--workers", "2"] if kind == "workers" else []
    with ExitStack() as stack:
        for _ in range(4 if kind == "busy" else 0):
            loop = stack.enter_context(subprocess.Popen([sys.executable, "-c", BUSY]))
            stack.callback(loop.kill)
        lines = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    return dict(map(json.loads, lines.splitlines()))


def main() -> int:
    """Compare the runs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", nargs="+", choices=RUNS, default=list(RUNS))
    parser.add_argument("--digests", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--workers", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.digests:
        digests(given.workers)
        return 0
    first: dict[str, dict[str, str]] = {}
    differ = 0
    for kind in given.runs:
        began = time.perf_counter()
        results = run(kind)
        first = first or results
        failures = sum(result.get("success") != "True" for result in results.values())
        different = [name for name, result in results.items() if result != first[name]]
        differ += len(different)
        print(
            f"{kind}: {len(results)} solves, {failures} failures, {len(different)} different, "
            f"{time.perf_counter() - began:.0f} s",
            flush=True,
        )
        for name in different:
            print(f"  {name}: {first[name]}\n    here: {results[name]}")
    return int(bool(differ))


if __name__ == "__main__":
    sys.exit(main())
