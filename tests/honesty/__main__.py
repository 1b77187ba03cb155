"""Try random and hostile systems: ``python -m tests.honesty --kind systems --count 100``.

Prints the counts for each kind, and the worst cases with what makes them anew. Kinds that are known
limits run if they are named: what is wrong among them is no failure.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import multiprocessing
import sys
from collections import Counter
from functools import partial

import numpy as np

from tests.honesty.cases import KINDS, LIMITS
from tests.honesty.verdicts import tried

VERDICTS = ("ok", "refused", "wrong", "error", "slow", "unknown")


def main() -> int:
    """Print a line for each case that is not ok, and the table; 1 if some were wrong."""
    parser = argparse.ArgumentParser(prog="python -m tests.honesty", description=__doc__)
    parser.add_argument("--kind", choices=[*KINDS, *LIMITS, "all"], default="all")
    parser.add_argument("--count", type=int, default=100, help="cases of each kind")
    parser.add_argument("--seed", type=int, default=0, help="the first seed")
    parser.add_argument("--method", default="auto", help="the method")
    parser.add_argument("--one", action="store_true", help="ask for one unknown of each alone")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--show", action="store_true", help="also print the refused ones")
    given = parser.parse_args()
    kinds = list(KINDS) if given.kind == "all" else [given.kind]
    rows, wrong = [], 0
    with multiprocessing.get_context("spawn").Pool(given.processes) as pool:
        for kind in kinds:
            counts: Counter[str] = Counter()
            seconds = []
            seeds = range(given.seed, given.seed + given.count)
            attempt = partial(tried, kind=kind, method=given.method, one=given.one)
            for seed, name, found in pool.imap_unordered(attempt, seeds):
                counts[found.verdict] += 1
                seconds.append(found.seconds)
                if found.verdict not in ("ok", *(() if given.show else ("refused",))):
                    again = f"--kind {kind} --seed {seed} --count 1 --show{' --one' * given.one}"
                    text = f"{found.kept:.3g} x rtol, {found.seconds:.1f} s; {found.message}"
                    print(f"{found.verdict}: {name} ({again}): {text}", flush=True)
            wrong += counts["error"] + (0 if kind in LIMITS else counts["wrong"])
            times = f"{np.median(seconds):.2f} | {max(seconds):.1f}"
            rows.append(f"| {kind} | {' | '.join(str(counts[v]) for v in VERDICTS)} | {times} |")
    print(f"\n| kind | {' | '.join(VERDICTS)} | seconds, median | longest |")
    print(f"| --- |{' ---: |' * (len(VERDICTS) + 2)}")
    print("\n".join(rows))
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
