"""Solve published problems over a box: python tests/benchmarks/petab_solutions.py FOLDER

FOLDER has a folder for each problem, as the PEtab benchmark collection has. The box has four
parameters at most, those that the data tell best and tell apart at the nominal values, 20 % to each
side. Printed are the largest measured error of the solutions, the log-likelihood where they are
fitted, and how much it differs from that by trajectories at the same parameters. Seconds are of the
processor: of the solutions, and of the fit.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

from tests.benchmarks.published_sbml import chosen, of_collection  # noqa: E402

SPREAD = 1.2


def main() -> None:
    parser = of_collection(__doc__)
    parser.add_argument("--rtol", type=float, default=1e-3)
    arguments = parser.parse_args()
    print(
        f"{'problem':36}{'experiments':>12}{'free':>6}{'error':>9}{'success':>9}"
        f"{'log-likelihood':>16}{'difference':>12}{'seconds':>15}"
    )
    for file in chosen(arguments, "*[0-9].yaml"):
        print(f"{file.stem:36}{_tried(file, arguments.rtol)}", flush=True)


def _tried(file: Path, rtol: float) -> str:
    """One line of the table, after the name."""
    import rankone
    from rankone.inference.calibration.calibrate import box_around
    from rankone.inference.calibration.experiment_objective import coordinates_of

    problem = rankone.read_petab(file)
    estimated = [problem.parameters[name] for name in problem.estimated]
    free, active = coordinates_of(estimated, problem.point()), problem._settings.active
    began = time.process_time()
    try:
        jacobian = problem.evaluate().jacobian * [p.width for p in estimated]
        names = list(box_around(free, jacobian, problem.point(), active))
        solutions = problem.solve(rtol, box=names, spread=SPREAD)
        solved = time.process_time()
        fit = solutions.fit()
        ended = time.process_time()
        by_trajectories = -problem.objective({**problem.point(), **fit.most_likely})
    except rankone.RankoneError as error:
        return f"  {type(error).__name__}: {error}"
    return (
        f"{len(solutions.solutions):12}{len(names):6}{solutions.error:9.1e}"
        f"{'yes' if solutions.success else 'no':>9}{fit.log_likelihood:16.3f}"
        f"{fit.log_likelihood - by_trajectories:12.1e}{solved - began:9.1f}{ended - solved:6.1f}"
    )


if __name__ == "__main__":
    main()
