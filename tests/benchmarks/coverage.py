"""How often 95 % intervals hold the true values when the noise is estimated as well.

    python -m tests.benchmarks.coverage [SETS] [METHOD]

For each of five designs 400 data sets with fixed seeds are fitted. Printed are, for each
parameter, how many intervals hold its true value, and how many fits were a success. METHOD is that
of the intervals, linear or profile.
"""

from __future__ import annotations

import sys
import time
from collections import Counter

from tests.estimation.experiments import DESIGNS, TRUE
from tests.estimation.systems import covered


def counts(design, sets, method="linear"):
    """How many of the intervals hold the true values, by parameter, and how many fits succeed."""
    inside = Counter()
    for seed in range(sets):
        fit = design(seed)
        for name, interval in fit.interval(method=method).items():
            inside[name] += covered(interval, TRUE[name])
        inside["success"] += fit.success
    return inside


def main() -> None:
    sets = int(sys.argv[1]) if len(sys.argv) > 1 else 400
    method = sys.argv[2] if len(sys.argv) > 2 else "linear"
    for name, design in DESIGNS.items():
        begin = time.process_time()
        inside = counts(design, sets, method)
        each = 1e3 * (time.process_time() - begin) / sets
        successes = inside.pop("success")
        texts = ", ".join(f"{parameter} {count}" for parameter, count in inside.items())
        print(f"{name}: {texts} of {sets}; {successes} success, {each:.0f} ms each", flush=True)


if __name__ == "__main__":
    main()
