"""Solve random systems whose order of events changes: python -m tests.benchmarks.orders

Doses, thresholds and slips of which a second order holds in at least 3 % of the box, at rtol 1e-4.
*kept* is the largest error of a success over the tolerance, against single trajectories at random
points; it is *wrong* above 5. Seconds are those of the processor, compiling included.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import time
from collections import Counter

import numpy as np

from tests.honesty.cases import case
from tests.honesty.orders import shares_of_orders
from tests.honesty.verdicts import judged


def main() -> None:
    """Print a table, and how many of them were solved."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=40, help="how many systems")
    parser.add_argument("--seed", type=int, default=0, help="the first seed")
    options = parser.parse_args()
    verdicts: Counter[str] = Counter()
    print("| seed | system | orders | kept | seconds | verdict |")
    print("| ---: | --- | ---: | ---: | ---: | --- |")
    for seed in range(options.seed, options.seed + options.count):
        system = case("orders", seed)
        began = time.process_time()
        verdict = judged(system, longest=np.inf)
        seconds = time.process_time() - began
        verdicts[verdict.verdict] += 1
        count = len(shares_of_orders(system))
        text = verdict.verdict
        if text != "ok":
            text += f": {verdict.message[:90]}"
        print(
            f"| {seed} | {system.name} | {count} | {verdict.kept:.2f} | {seconds:.1f} | {text} |",
            flush=True,
        )
    print(f"\n{verdicts['ok']} of {options.count} solved, {verdicts['wrong']} wrong")


if __name__ == "__main__":
    main()
