"""Solve times of the reference problems beside those of another commit, in turns.

``python tests/benchmarks/against.py 98a64d7`` checks that commit out beside the sources and solves
every problem in turns with both, each in a process of its own with one BLAS thread. The ratio is
that of the least times, which is the ratio of the break-evens: one trajectory costs both the same.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

SECONDS = 1.5
"""How long a process repeats a solve; three times at least."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("commit")
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--only", help="problems whose name starts so")
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.one:
        place, name, rtol = given.one
        print(json.dumps(least(Path(place), name, float(rtol))))
        return
    with tempfile.TemporaryDirectory() as folder:
        other = Path(folder) / "other"
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "-q", "--detach", str(other), given.commit], check=True)
        try:
            compare(other, given)
        finally:
            subprocess.run([*git, "remove", "--force", str(other)], check=True)


def compare(other: Path, given: argparse.Namespace) -> None:
    """Print a row for each problem, and the geometric mean."""
    from tests.benchmarks.report import BARS  # puts these sources before all others

    ratios = []
    print(f"| problem | rtol | ms, {given.commit} | ms, now | ratio |")
    print("| --- | ---: | ---: | ---: | ---: |")
    for name, rtol in BARS:
        if given.only and not name.startswith(given.only):
            continue
        times: dict[Path, float] = {other: math.inf, ROOT: math.inf}
        for _ in range(given.rounds):
            for place in times:
                times[place] = min(times[place], elsewhere(place, given.commit, name, rtol))
        before, now = times[other], times[ROOT]
        ratios.append(now / before)
        row = f"{1e3 * before:.2f} | {1e3 * now:.2f} | {now / before:.3f}"
        print(f"| {name} | {rtol:g} | {row} |", flush=True)
    if not ratios:
        names = ", ".join(dict(BARS))
        raise SystemExit(f"no problem's name starts with {given.only}: there are {names}")
    mean = math.exp(sum(map(math.log, ratios)) / len(ratios))
    print(f"\ngeometric mean {mean:.3f}, largest {max(ratios):.3f}")


def elsewhere(place: Path, commit: str, name: str, rtol: float) -> float:
    """The least time with the sources in a place."""
    one = ["--one", str(place), name, repr(rtol)]
    command = [sys.executable, str(Path(__file__)), commit, *one]
    run = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return float(json.loads(run.stdout))


def least(place: Path, name: str, rtol: float) -> float:
    """The least time of a solve with the sources in a place, repeated in this process."""
    sys.path.insert(0, str(place / "src"))
    import rankone as ro

    if not Path(ro.__file__).is_relative_to(place):
        raise SystemExit(f"{ro.__file__} is not in {place}")
    from tests.problems import MEASURED

    compiled = ro.compile(MEASURED[name]())
    compiled.solve(rtol)
    times: list[float] = []
    while sum(times) < SECONDS or len(times) < 3:
        began = time.perf_counter()
        compiled.solve(rtol)
        times.append(time.perf_counter() - began)
    return min(times)


if __name__ == "__main__":
    main()
