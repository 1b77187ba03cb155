"""Fit published problems: python tests/benchmarks/petab_fits.py FOLDER [--only NAME ...]

FOLDER has a folder for each problem, as the PEtab benchmark collection has. Each problem is fitted
from ten random starts within its bounds; nominal values are used for nothing but the line of the
table: *published* is the log-likelihood at them, and *difference* what the fit is below it.
Negative differences are better fits than the published one. *Independent* is the same difference
with the log-likelihood at the end by SciPy and the package ``petab``, as petab_problems.py
has it. Seconds are of the processor.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

from tests.benchmarks.petab_problems import Independent  # noqa: E402
from tests.benchmarks.published_sbml import chosen, of_collection  # noqa: E402

NEAR = 0.1  # Difference of log-likelihoods that counts as the published optimum


def main() -> None:
    parser = of_collection(__doc__)
    parser.add_argument("--starts", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    print(
        f"{'problem':36}{'parameters':>10}{'published':>14}{'best':>14}{'difference':>12}"
        f"{'independent':>13}{'near it':>9}{'iterations':>12}{'seconds':>9}"
    )
    for file in chosen(arguments, "*[0-9].yaml"):
        print(_tried(file, arguments.starts, arguments.seed), flush=True)


def _tried(file: Path, starts: int, seed: int) -> str:
    """One line of the table."""
    import rankone

    problem = rankone.read_petab(file)
    published = -problem.objective()
    began = time.process_time()
    calibration = problem.fit(starts=starts, seed=seed)
    seconds = time.process_time() - began
    difference = published - calibration.log_likelihood
    near = sum(start.log_likelihood >= published - NEAR for start in calibration.starts)
    return (
        f"{problem.name:36}{len(calibration.x):10}{published:14.3f}"
        f"{calibration.log_likelihood:14.3f}{difference:12.3f}"
        f"{_independent(file, published, calibration.x):>13}{near:4} of {starts:2}"
        f"{calibration.iterations:12}{seconds:9.0f}"
    )


def _independent(file: Path, published: float, x: dict[str, float]) -> str:
    """The difference by SciPy at the end of a fit, or why there is none."""
    reference = Independent(file)
    try:
        return f"{published + reference.objective({**reference.nominal, **x}):.3f}"
    except Exception as error:  # whatever SciPy stops at
        return type(error).__name__


if __name__ == "__main__":
    main()
