"""What a calibration found, and whether to believe it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np

from rankone.inference.estimation import estimates as results
from rankone.inference.estimation.fit import Fit, one_sided
from rankone.inference.estimation.free_parameters import ends_at_bounds
from rankone.inference.estimation.identification import BOX_SHARE, UNIFORM_PRECISION
from rankone.inference.estimation.intervals import quantile_of
from rankone.inference.estimation.least_squares import SAME_COST, Descent, Expandable, Expansion
from rankone.solution.solution import Solution
from rankone.support.arrays import Array, Table, Variables
from rankone.support.errors import count, listing, quote, with_remedy
from rankone.support.options import LEVEL


class Comparison(NamedTuple):
    """The m measurements of one observable in one experiment, in order of time.

    Attributes
    ----------
    observable, experiment : str
        Their names.
    times, measured, predicted : ndarray (m,)
    bars : ndarray (2, m)
        Ends of error bars, one standard deviation of the noise below and above the measurements.
    band : ndarray (2, m)
        Where the prediction is known to be with 95 %, by linearisation; NaN without derivatives.
    standardised : ndarray (m,)
        Measurement less prediction, in standard deviations of the noise.
    """

    observable: str
    experiment: str
    times: Array
    measured: Array
    predicted: Array
    bars: Array
    band: Array
    standardised: Array


class Scale(NamedTuple):
    """The scale on which noise is normal, as functions to it and back."""

    to: Callable[[Array], Array]
    back: Callable[[Array], Array]


SCALES = {
    "lin": Scale(np.asarray, np.asarray),
    "log": Scale(np.log, np.exp),
    "log10": Scale(np.log10, lambda x: 10.0**x),
}
"""Those of observables by name."""


def compared(
    names: tuple[str, str],
    data: tuple[Array, Array],
    predicted: Array,
    noise: Array,
    root: Array,
    scale: str = "lin",
) -> Comparison:
    """What was measured of an observable in an experiment, and what is predicted.

    Parameters
    ----------
    names : (str, str)
        The observable and the experiment.
    data : pair of ndarray (m,)
        Times and measurements.
    predicted, noise : ndarray (m,)
        Predictions, and standard deviations on the scale.
    root : ndarray (m,)
        Standard deviations of the predictions, in those of the noise.
    scale : {"lin", "log", "log10"}
        The scale on which the noise is normal.
    """
    times, measured = data
    order = np.argsort(times, kind="stable")
    times, measured, predicted = times[order], measured[order], predicted[order]
    noise, root = noise[order], root[order]
    half = quantile_of(LEVEL, True, 0.0) * noise * root
    signs = np.array([[-1.0], [1.0]])
    to, back = SCALES[scale]
    with np.errstate(all="ignore"):
        at, expected = to(measured), to(predicted)
        bars, band = back(at + signs * noise), back(expected + signs * half)
    residuals = (at - expected) / noise
    return Comparison(*names, times, measured, predicted, bars, band, residuals)


# -----------------------------------------------------------------------------
# What a calibration found, from how many starts, and whether to believe it.


class Start(NamedTuple):
    """One random start and where it led.

    Attributes
    ----------
    start : dict of str to float
        Where it began.
    x : dict of str to float
        Where it ended.
    log_likelihood : float
        There, by trajectories; minus infinity if no trajectory reached the data.
    iterations : int
    arrived : bool
        Whether nothing promised a better likelihood in the end, or a limit ended it.
    """

    start: dict[str, float]
    x: dict[str, float]
    log_likelihood: float
    iterations: int
    arrived: bool


class Box(NamedTuple):
    """A box that was taken, and what came of it.

    Attributes
    ----------
    intervals : dict of str to (float, float)
        The parameters that were free in it; the others stayed at the best point so far.
    solved : bool
        Whether the solution was a success at the tolerance ``rtol``.
    rtol : float
        The tolerance that was asked for.
    log_likelihood : float
        By trajectories at the point where the fit in this box ended; NaN without a fit.
    inside : bool
        Whether it ended inside of the box.
    """

    intervals: dict[str, tuple[float, float]]
    solved: bool
    rtol: float
    log_likelihood: float = math.nan
    inside: bool = False


class Calibrated(Expandable, Protocol):
    """A likelihood whose calibration is reported."""

    def named(self, z: Array) -> dict[str, float]:
        """The parameters at z (n,), by name."""

    def log_likelihood(self, at: Expansion) -> float:
        """With all constants, by trajectories; minus infinity without any."""


@dataclass(frozen=True, repr=False)
class Calibration(results.Judged):
    """Parameters from data far from any first guess, from several random starts.

    Attributes
    ----------
    x : dict of str to float
        The best values.
    log_likelihood : float
        Their log-likelihood with all constants, by trajectories.
    starts : tuple of Start
        All starts, the best first.
    boxes : tuple of Box
        The boxes that were solved, in order.
    intervals : dict of str to (float, float)
        Where each identified parameter is with 95 %, whatever the others are within their bounds.
    limited : dict of str to str
        Which ends of these are bounds, not set by the data: ``"lower"`` or ``"upper"``.
    limits : dict of str to str
        In words what but the data these depend on: those ends, or bounds of other parameters
        without which they would be longer.
    not_identified : tuple of str
        Parameters that the data leave free over a good part of their bounds.
    at_bounds : dict of str to str
        Parameters that ended at the ``"lower"`` or ``"upper"`` end of their bounds.
    fit : Fit or None
        The fit in the last box around the best values, with intervals; None without such a box.
    solution : Solution or None
        The solution on that box, for a posterior and for statistics.
    comparisons : tuple of Comparison
        Measurements of each observable in each experiment beside the predictions.
    remark : str
        Why there is no such box; empty if there is one.
    """

    x: Mapping[str, float]
    log_likelihood: float
    starts: tuple[Start, ...]
    boxes: tuple[Box, ...] = ()
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    limited: Mapping[str, str] = field(default_factory=dict)
    limits: Mapping[str, str] = field(default_factory=dict)
    not_identified: tuple[str, ...] = ()
    at_bounds: Mapping[str, str] = field(default_factory=dict)
    fit: Fit | None = None
    solution: Solution | None = None
    comparisons: tuple[Comparison, ...] = ()
    remark: str = ""

    @classmethod
    def of(
        cls,
        problem: Calibrated,
        ways: Sequence[Descent],
        reaches: Mapping[str, Reach],
        **further: Any,
    ) -> Calibration:
        """The result of descents, the best of them first.

        ``reaches`` are how far each parameter can go; see the attributes for the others.
        """
        starts = tuple(
            Start(
                problem.named(way.start),
                problem.named(way.at.z),
                problem.log_likelihood(way.at),
                way.iterations,
                way.arrived,
            )
            for way in ways
        )
        at = ways[0].at
        told = {name: reach for name, reach in reaches.items() if not reach.free}
        return cls(
            starts[0].x,
            starts[0].log_likelihood,
            starts,
            intervals={n: _interval(problem, at.z, n, each) for n, each in told.items()},
            limited={n: each.limited for n, each in told.items() if each.limited},
            limits={n: _limits(each) for n, each in told.items()},
            not_identified=tuple(name for name, each in reaches.items() if each.free),
            at_bounds=ends_at_bounds(problem.names, at.z),
            **further,
        )

    _done, _itself = "the starts agree", "them"

    @property
    def checks(self) -> tuple[str, ...]:
        """Why there is no box around the optimum, if so."""
        return (self.remark,) if self.remark else ()

    @property
    def iterations(self) -> int:
        """Iterations from all starts; each evaluates the likelihood with its derivatives."""
        return sum(start.iterations for start in self.starts)

    @property
    def agreeing(self) -> int:
        """How many starts ended within 0.1 of the best log-likelihood."""
        return sum(s.log_likelihood >= self.log_likelihood - 0.5 * SAME_COST for s in self.starts)

    @cached_property
    def findings(self) -> tuple[str, ...]:
        """Reasons not to trust the calibration, a sentence each."""
        sentences = []
        if not np.isfinite(self.log_likelihood):
            return (
                with_remedy(
                    "no trajectory reaches all of the data from any start",
                    "give narrower bounds, or more starts",
                ),
            )
        if self.agreeing < 2 and len(self.starts) > 1:
            sentences.append(
                with_remedy("only one start found this optimum", "take more starts: starts=50")
            )
        if not self.starts[0].arrived:
            sentences.append(
                with_remedy("the best start was still on its way at its limit of iterations",
                            "take it as a start of a fit in a box around it")
            )  # fmt: skip
        if self.not_identified:
            sentences.append(
                with_remedy(
                    f"the data do not identify {listing(self.not_identified)}",
                    "fix some of them, or measure more",
                )
            )
        free = [name for name in self.at_bounds if name not in self.not_identified]
        for name in free:
            sentences.append(f"{quote(name)} is at the {self.at_bounds[name]} end of its bounds")
        for name, side in self.limited.items():
            if name not in free:
                sentences.append(one_sided(name, side))
        if self.fit is not None and not self.fit.success and not sentences:
            sentences.append(f"the fit around the optimum is no success: {self.fit.message}")
        return tuple(sentences)

    # --- display -------------------------------------------------------------------------------

    def _table(self) -> Table:
        """The estimates, a line each."""
        rows = []
        for name, x in self.x.items():
            cell = "not identified" if name in self.not_identified else ""
            if name in self.intervals:
                cell = results.interval_text(self.intervals[name])
            rows.append([name, f"{x:.6g}", cell, self.limits.get(name, "")])
        header = ["parameter", "estimate", "95 % interval", "limited by"]
        if not any(self.limits.values()):
            header, rows = header[:-1], [row[:-1] for row in rows]
        starts = f"{self.agreeing} of {count(len(self.starts), 'start')} within {0.5 * SAME_COST:g}"
        return Table(
            f"Calibration: log-likelihood {self.log_likelihood:.6g}, {starts}",
            header,
            rows,
            self._remarks,
        )

    def _variables(self) -> Variables:
        """Estimates, and the log-likelihoods of the starts."""
        names = list(self.x)
        ends = [self.intervals.get(name, (np.nan, np.nan)) for name in names]
        columns: dict[str, list[Any]] = {
            "estimate": [self.x[name] for name in names],
            "lower": [low for low, _ in ends],
            "upper": [high for _, high in ends],
            "identified": [name not in self.not_identified for name in names],
            "limited": [self.limits.get(name, "") for name in names],
        }
        arrays, labels = results.by_parameter(columns, names)
        likelihoods = np.array([start.log_likelihood for start in self.starts])
        return Variables(
            {**arrays, "log_likelihood": (("start",), likelihoods)},
            {**labels, "start": list(range(len(self.starts)))},
        )


def _limits(reach: Reach) -> str:
    """What but the data an interval depends on, in words."""
    if reach.limited:
        return f"{reach.limited} bound"
    return f"bounds of {listing(reach.others)}" if reach.others else ""


def _interval(problem: Calibrated, z: Array, name: str, reach: Reach) -> tuple[float, float]:
    """The interval of a parameter by its ends in z (n,)."""
    ends = np.repeat(z[None], 2, axis=0)
    ends[:, problem.names.index(name)] = reach.lower, reach.upper
    low, high = (problem.named(end)[name] for end in ends)
    return low, high


# -----------------------------------------------------------------------------
# How far the data determine each parameter at an optimum, by linearisation.


class Reach(NamedTuple):
    """The interval of a parameter in z, and what ends it.

    ``limited`` are the ends that are its bounds, ``""``, ``"lower"``, ``"upper"`` or ``"both"``;
    a ``free`` one is not identified. Beyond the bounds of ``others`` it would be longer.
    """

    lower: float
    upper: float
    limited: str = ""
    free: bool = False
    others: tuple[str, ...] = ()


def limited_by(lower: bool, upper: bool) -> str:
    """Which ends of an interval are bounds, in a word."""
    return "both" if lower and upper else "lower" * lower + "upper" * upper


def linear_reaches(names: Sequence[str], at: Expansion, variance: float) -> dict[str, Reach]:
    """That of each parameter with 95 %, by linearisation, within the bounds."""
    deviations = deviations_at(at, variance)
    free = unidentified(names, deviations)
    reaches = {}
    for name, z, half in zip(names, at.z, quantile_of(LEVEL, True, 0.0) * deviations, strict=True):
        ends = float(z - half), float(z + half)
        limited = limited_by(ends[0] <= 0.0, ends[1] >= 1.0)
        free_one = name in free or limited == "both"
        reaches[name] = Reach(max(ends[0], 0.0), min(ends[1], 1.0), limited, free_one)
    return reaches


def covariance_at(at: Expansion, variance: float = 1.0) -> Array:
    """The covariance (n, n) in z at a point; see :func:`covariance_of`."""
    return covariance_of(at.jacobian, variance)


def covariance_of(jacobian: Array, variance: float = 1.0) -> Array:
    """The covariance (n, n) in z by the Jacobian (m, n), of a prior uniform between the bounds.

    ``variance`` is that of the residuals.
    """
    information = jacobian.T @ jacobian / variance
    information[np.diag_indices_from(information)] += UNIFORM_PRECISION
    return np.asarray(np.linalg.inv(information))


def deviations_at(at: Expansion, variance: float = 1.0) -> Array:
    """Standard deviations (n,) in z; see :func:`covariance_at`."""
    return np.asarray(np.sqrt(np.diag(covariance_at(at, variance))))


def spread_of(rows: Array, covariance: Array) -> Array:
    """Standard deviations (m,) of quantities with derivatives (m, n)."""
    return np.asarray(np.sqrt(np.einsum("mi,ij,mj->m", rows, covariance, rows)))


def unidentified(names: Sequence[str], deviations: Array) -> tuple[str, ...]:
    """Parameters whose variance between the bounds the data hardly reduce."""
    lost = deviations**2 > BOX_SHARE / UNIFORM_PRECISION
    return tuple(name for name, is_lost in zip(names, lost, strict=True) if is_lost)
