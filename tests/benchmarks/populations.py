"""How often intervals of a population hold the true values, and how long a fit takes.

    python -m tests.benchmarks.populations [SETS [FIRST]]

Thirty subjects with three random effects and combined noise, of which all is estimated, in 400 data
sets with fixed seeds. Printed are, for each parameter, how many 95 % intervals hold its true value,
its mean estimate, how many fits were a success, and the processor time of a fit.
"""

from __future__ import annotations

import sys
import time
from collections import Counter

import numpy as np

from tests.inference.populations.simulated import TRUE, oral, population


def main() -> None:
    sets = int(sys.argv[1]) if len(sys.argv) > 1 else 400
    first = int(sys.argv[2]) if len(sys.argv) > 2 else 0
    oral()
    inside, seconds = Counter(), []
    estimates = {name: [] for name in TRUE}
    for seed in range(first, first + sets):
        begin = time.process_time()
        fit = population(seed)
        intervals = fit.interval()
        seconds.append(time.process_time() - begin)
        inside["success"] += fit.success
        if not fit.success:
            print(f"  data set {seed}: {fit.message}", flush=True)
        for name, true in TRUE.items():
            low, high = intervals.get(name, (np.nan, np.nan))
            inside[name] += low <= true <= high
            estimates[name].append(fit.x.get(name, np.nan))
    for name, true in TRUE.items():
        mean = np.mean(estimates[name])
        print(f"{name:11} {inside[name]:4} of {sets}   true {true:g}, mean estimate {mean:.4g}")
    print(f"{inside['success']} success, {np.mean(seconds):.2f} s each, at most {max(seconds):.2f}")


if __name__ == "__main__":
    main()
