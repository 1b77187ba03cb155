"""Integrate references of relaxation oscillators: python tests/benchmarks/relaxation.py

The oscillators of tests/reference/relaxation.py jump at times of their own. What counts is that the
reference, about 100 trajectories, ends within a third of the budget, and that its trajectories are
right: *ok*. The error kept is that of some of them against LSODA, away from jumps. ``--solve``
solves the oscillators instead, with errors over the largest value of each unknown, which it may
have in a jump alone. For the columns see tests/benchmarks/suite.py.
"""

import sys
import time
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[2])]

import numpy as np  # noqa: E402

import rankone as ro  # noqa: E402
from rankone.solvers.engines.engine_options import CrossOptions  # noqa: E402
from rankone.solvers.request import SolveArguments, SolveRequest  # noqa: E402
from rankone.solvers.verification.reference_set import ReferenceSet  # noqa: E402
from rankone.support.budget import OutOfBudgetError, limited, operations_for  # noqa: E402
from tests.benchmarks import suite  # noqa: E402
from tests.reference.stated import Stated  # noqa: E402

SHARE = 1.0 / 3.0
"""Part of the budget within which the reference has to end."""
COMPARED = 12
"""Trajectories that are compared with independent ones."""
QUANTILE = 0.9
"""Share of times that are compared: in the others a trajectory may jump."""


def integrated(row: suite.Row, system: Stated, case: suite.Case) -> None:
    """Integrate the reference alone, with the whole budget, and compare some trajectories."""
    compiled, budget = ro.compile(system.problem()), operations_for(case.effort)
    row.dimensions = f"{len(system.rates)} × {len(system.parameters)}"
    form = compiled.form_for("cross")
    request = SolveRequest.of(
        form.system, [CrossOptions], {}, SolveArguments(case.rtol, effort=case.effort)
    )
    began, reference_set = time.process_time(), None
    with limited(budget) as account:
        try:
            reference_set = ReferenceSet.of(form.system, request)
        except OutOfBudgetError as out:
            row.verdict, row.message = "refused", f"the reference does not end: {out.reached}"
    row.seconds, row.work = time.process_time() - began, account.done / budget
    row.shares = {"reference": row.work}
    if reference_set is None:
        return
    points = reference_set.reference.points[-COMPARED:]
    times, n = system.times, len(system.rates)
    exact = np.stack([system.trajectory(point, times) for point in points], axis=1)
    sizes = np.abs(exact).max(axis=(1, 2))[:, None, None]
    errors = np.abs(reference_set.reference(times)[:n, -COMPARED:] - exact) / sizes
    row.kept = float(np.quantile(errors.max(axis=0), QUANTILE)) / case.rtol
    row.verdict = "ok" if row.work <= SHARE else "refused"
    if reference_set.end < system.end:
        row.verdict, row.message = "refused", f"it ends early, at {reference_set.end:g}"
    if row.kept > suite.WITHIN:
        row.verdict = "wrong"


if __name__ == "__main__":
    solve = "--solve" in sys.argv
    if solve:
        sys.argv.remove("--solve")
    fill = suite.Row.solved if solve else integrated
    suite.main(__doc__.splitlines()[0], "relaxation", (1e-3,), "cross", fill)
