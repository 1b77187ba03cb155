"""The calibration of a problem from files, with measurements beside predictions."""

from __future__ import annotations

from typing import Any

import numpy as np

from rankone.inference.calibration.calibrated_parameters import Records
from rankone.inference.calibration.descent import Expansion
from rankone.inference.calibration.linearised import covariance_at, linear_reaches, spread_of
from rankone.inference.calibration.result import Calibration, Comparison, compared
from rankone.inference.calibration.searched import OfFiles
from rankone.inference.calibration.starts import MOST_STARTS, descents
from rankone.support.options import checked_number
from rankone.support.tasks import checked_executor

_SCREENED = 10  # Random points, the best of which is a start


def calibrated(
    records: Records, likelihood: OfFiles, starts: int, seed: int, executor: Any = None
) -> Calibration:
    """The calibration from random starts; see :meth:`.CalibrationProblem.fit`."""
    starts = checked_number("starts", starts, 1, MOST_STARTS)
    wanted = None if executor is None else checked_executor("executor", executor)
    ways = descents(likelihood, starts, seed, _SCREENED, wanted)
    comparisons = comparisons_of(records, likelihood, ways[0].at)
    at = ways[0].at
    reaches = linear_reaches(likelihood.names, at, 1.0) if np.isfinite(at.cost) else {}
    return Calibration.of(likelihood, ways, reaches, comparisons=comparisons)


def comparisons_of(records: Records, likelihood: OfFiles, at: Expansion) -> tuple[Comparison, ...]:
    """Measurements and predictions at the end of a search; none without trajectories."""
    if not np.isfinite(at.cost):
        return ()
    evaluation, covariance = likelihood.evaluated(at.z), covariance_at(at)
    comparisons, first = list[Comparison](), 0
    for series in records.series:
        count, rows = series.times.size, np.array(series.rows)
        deviations = spread_of(at.jacobian[first : first + count], covariance)
        first += 2 * count
        for e in np.unique(series.experiments):
            here = np.flatnonzero(series.experiments == e)
            comparisons.append(
                compared(
                    (series.observable.name, records.experiments[e].name),
                    (series.times[here], series.measurements[here]),
                    evaluation.predicted[rows[here]],
                    evaluation.noise[rows[here]],
                    deviations[here],
                    series.observable.transformation,
                )
            )
    return tuple(comparisons)
