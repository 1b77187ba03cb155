"""``rankone.calibrate``: random starts over wide bounds, and a box around the optimum."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from rankone.inference.calibration import result
from rankone.inference.calibration.records import Interval
from rankone.inference.calibration.trajectory_likelihood import OfExperiments, profile_reaches
from rankone.inference.estimation import least_squares
from rankone.inference.estimation.experiments import Experiment
from rankone.inference.estimation.fit import Fit
from rankone.inference.estimation.free_parameters import Bounds, FreeParameters
from rankone.inference.estimation.likelihood import UNNOTICED
from rankone.inference.estimation.search import fit_experiments
from rankone.problem.problem import Problem
from rankone.solution.compiled import compile_problem
from rankone.solution.solution import Solution
from rankone.support.arrays import COARSE, MINOR, SAME, Array
from rankone.support.errors import (
    OptionError,
    RankoneError,
    check_kind,
    count,
    listing,
    quote,
    shown,
)
from rankone.support.options import of_keywords, takes_options_of
from rankone.tensors.joint_distribution import by_name

MOST_END_PARAMETERS = 6
"""Most parameters of the box around the optimum."""
_SEARCHES = ("trajectories", "boxes")


@takes_options_of(least_squares.Starts)
def calibrate(
    problem: Problem,
    experiments: Experiment | Sequence[Experiment],
    *,
    bounds: Bounds = None,
    fixed: Mapping[Any, float] | None = None,
    search: str = "trajectories",
    box: bool = True,
    rtol: float = 1e-5,
    **options: Any,
) -> result.Calibration:
    """Parameters from data over bounds that are too wide for one solution.

    Random starts go down by least squares on trajectories and their exact derivatives. Around the
    best end the problem is solved on a box and fitted there, which gives intervals, and a solution
    for a posterior.

    Parameters
    ----------
    problem : Problem
        Its parameters have the bounds, over decades as ``(1e-5, 1e3, "log")``. Nothing is solved
        on all of them.
    experiments : Experiment or list of Experiment
        Measurements, and what is known in each experiment, as for :func:`rankone.fit`.
    bounds, fixed : mapping, optional
        As for :meth:`Solution.fit`; bounds also of parameters that observables have of their own.
    starts : int
        Number of random starts, a latin hypercube in the coordinates of the search.
    seed : int
        Of the random numbers.
    search : {"trajectories", "boxes"}
        How a start gets to its optimum. With ``"boxes"`` a box of at most four parameters, those
        that matter most, is solved around the point, fitted in, and moved; each of them costs as
        much as dozens of steps on trajectories, which is why these are the default.
    box : bool
        Whether to solve around the optimum, if at most six parameters are identified.
    rtol : float
        Tolerance of solutions on boxes.
    executor : int, concurrent.futures.Executor, distributed.Client or str, optional
        Where starts go down on trajectories, as for :func:`rankone.solve_many`; the calibration is
        the same to the bit. Boxes follow each other: ``search="boxes"`` takes no executor.

    Returns
    -------
    Calibration
        With ``x``, ``log_likelihood``, ``starts``, ``not_identified``, ``fit`` and ``solution``.

    Raises
    ------
    ProblemError
        If rates jump where states cross a threshold, or where a free parameter says.
    OptionError
        As for :meth:`Solution.fit`; if there is no such search; if an event of the problem depends
        on its states; if some experiments fix a parameter that others leave free.
    """
    check_kind("calibrate", problem, Problem, remedy="build one with rankone.Problem(...)")
    if search not in _SEARCHES:
        raise OptionError(f"search={search!r} is unknown", remedy=f"use {listing(_SEARCHES)}")
    begin = of_keywords(least_squares.Starts, "calibrate", options).checked()
    if begin.executor is not None and search == "boxes":
        raise OptionError(
            "search='boxes' takes no executor: each box begins where the one before led",
            term=options["executor"],
            remedy="leave out one of them",
        )
    listed = [experiments] if isinstance(experiments, Experiment) else experiments
    if not isinstance(listed, list | tuple) or not listed:
        raise OptionError(
            f"{shown(experiments)} is no list of experiments",
            term=experiments,
            remedy="give rankone.Experiment(data, ...), or several in a list",
        )
    likelihood = OfExperiments.of(compile_problem(problem), listed, bounds, fixed)
    _check_conditions(likelihood)
    middle = likelihood.expanded(np.full(len(likelihood.names), 0.5))
    boxes = BoxSearch(problem, listed, likelihood, middle, rtol, _own_bounds(likelihood, bounds))
    ways = (
        _by_boxes(boxes, begin) if search == "boxes" else least_squares.descents(likelihood, begin)
    )
    return _result(boxes, ways, box)


def _check_conditions(likelihood: OfExperiments) -> None:
    """Raise an OptionError where some experiments fix what others leave free."""
    for trial in likelihood.likelihood.trials:
        for name in trial.fixed:
            if name in likelihood.names:
                raise OptionError(
                    f"{quote(name)} is fixed in some experiments and free in others",
                    term=name,
                    remedy="fix it in all of them, or give it another name there",
                )


def _own_bounds(likelihood: OfExperiments, bounds: Bounds) -> dict[str, tuple[float | str, ...]]:
    """The bounds of parameters that belong to observables and noise."""
    named = by_name("bounds", bounds, likelihood.likelihood.free.order)
    return {name: ends for name, ends in named.items() if name not in likelihood.dynamic}


def _by_boxes(boxes: BoxSearch, begin: least_squares.Starts) -> list[least_squares.Descent]:
    """Ways down from box to box, the best first."""
    ways, rtol = [], boxes.rtol
    for z in least_squares.random_starts(begin.starts, len(boxes.likelihood.names), begin.seed):
        boxes.at, before = boxes.likelihood.expanded(z), len(boxes.boxes)
        boxes.rtol = max(rtol, COARSE)
        way = least_squares.Descent(boxes.at, z)
        if np.isfinite(boxes.at.cost):
            way.arrived = boxes.search()
        way.at, way.iterations = boxes.at, len(boxes.boxes) - before
        ways.append(way)
    boxes.rtol = rtol
    return sorted(ways, key=lambda way: way.at.cost)


def _result(boxes: BoxSearch, ways: list[least_squares.Descent], box: bool) -> result.Calibration:
    """What is said of the best way, with a box around its end."""
    likelihood, boxes.at = boxes.likelihood, ways[0].at
    boxes.fit = boxes.solution = None
    remark, reaches = "", dict[str, result.Reach]()
    if np.isfinite(boxes.at.cost):
        reaches = profile_reaches(likelihood, boxes.at)
        remark = _around(boxes, reaches) if box else ""
        if boxes.at.cost < ways[0].at.cost - UNNOTICED:
            reaches = profile_reaches(likelihood, boxes.at)
    ways[0].at = boxes.at
    return result.Calibration.of(
        likelihood,
        ways,
        reaches,
        boxes=tuple(boxes.boxes),
        fit=boxes.fit,
        solution=boxes.solution,
        comparisons=likelihood.comparisons(boxes.at),
        remark=remark,
    )


def _around(boxes: BoxSearch, reaches: Mapping[str, result.Reach]) -> str:
    """Take a box around the optimum; a sentence that says why there is none."""
    likelihood = boxes.likelihood
    deviations = result.deviations_at(boxes.at, likelihood.variance(boxes.at))
    free = {
        *result.unidentified(likelihood.names, deviations),
        *(n for n, reach in reaches.items() if reach.free),
    }
    inside = {name: reaches[name] for name in likelihood.dynamic if name not in free}
    if not inside:
        return "there is no box around the optimum: the data identify no parameter"
    if len(inside) > MOST_END_PARAMETERS:
        return (
            f"there is no box around the optimum: it would have {count(len(inside), 'parameter')}, "
            f"and {MOST_END_PARAMETERS} are the most"
        )
    boxes.around(inside)
    return "" if boxes.fit is not None else "no box around the optimum could be solved"


# -----------------------------------------------------------------------------
# The box follows the fit: around the end of a search, and moved until the optimum is inside.
#
# All others are held where the search ended. The parameters that only observables and noise have
# stay free, so that what is left of the Jacobian beside their columns says what the data tell of
# the rest.


@dataclass(frozen=True)
class BoxTuning:
    """Tuning of boxes that follow a fit."""

    standard_deviations: float = 4.0
    """Half the width of the box."""
    largest_factor: float = 3.0
    """From the middle to an end, on logarithmic scales."""
    largest_share: float = MINOR
    """From the middle to an end in widths of the bounds, on linear scales."""
    least_share: float = 1e-4
    """Least half width, in widths of the bounds."""
    first_share: float = 1 / 8
    """Width of the first box in widths of the bounds, without logarithms."""
    least_factor: float = 0.02
    """Factor on the first width from which on boxes are not smaller."""
    most_factor: float = 2.0
    """Factor up to which they grow."""
    shrinking: float = 0.5
    """Factor on a box that is not solved, or holds the optimum."""
    growing: float = 1.5
    """Factor on a box at whose side the fit ended."""
    tightening: float = MINOR
    """Factor on the tolerance where they differ by more."""
    least_tolerance: float = 1e-8
    """Least tolerance of a solution on a box."""
    most_boxes: int = 30
    """Most boxes of one start."""
    most_end_boxes: int = 6
    """Boxes around an optimum that are tried."""
    insensitive: float = COARSE
    """Share of the largest sensitivity below which a parameter is not in a box."""
    far: float = 2.0
    """Side of the box around the optimum, in lengths to a close end of the interval."""
    near: float = 1.25
    """The same for an end that is far."""
    least_end: float = 0.05
    """Least width of such a box, in first widths."""
    most_end: float = 0.7
    """Largest one, unless the interval is longer."""
    margin: float = COARSE
    """Half the width of a condition that all experiments share, relative."""


TUNING = BoxTuning()


def box_around(
    free: FreeParameters,
    jacobian: Array,
    values: Mapping[str, float],
    active: Sequence[str],
    names: Sequence[str] | None = None,
) -> dict[str, Interval]:
    """Intervals around values, for some of the ``active`` parameters, or those of the names.

    ``jacobian`` (r, n) is that of the residuals by coordinates of the free parameters.

    The parameters are chosen by pivoted columns of the Jacobian: each adds most to those before
    (Golub & Van Loan, Matrix Computations, 5.4).
    """
    listed = [name for name in free.names if name in active] if names is None else [*names]
    if not listed:
        raise OptionError("no estimated parameter is in a rate or an initial value")
    others = [name not in active for name in free.names]
    columns = [free.names.index(name) for name in listed]
    rest = _beside_others(jacobian, np.array(others))[:, columns]
    order, count = np.arange(len(listed)), len(listed)
    if names is None:
        _, r, order = scipy.linalg.qr(rest, mode="economic", pivoting=True)
        sizes = np.abs(np.diag(r))[:MOST_PARAMETERS]
        count = max(int(np.sum(sizes > TUNING.insensitive * sizes[0])), 1)
    chosen = order[:count]
    spreads = np.sqrt(np.diag(result.covariance_of(rest[:, chosen])))
    deviations = dict(zip(chosen.tolist(), spreads.tolist(), strict=True))
    return {
        name: _interval(free, name, values[name], deviations[j])
        for j, name in enumerate(listed)
        if j in deviations
    }


def _beside_others(jacobian: Array, others: NDArray[np.bool_]) -> Array:
    """The Jacobian by z, without what parameters of observables and noise can do as well."""
    if not others.any():
        return jacobian
    span = scipy.linalg.orth(jacobian[:, others])
    return np.asarray(jacobian - span @ (span.T @ jacobian))


def _interval(free: FreeParameters, name: str, value: float, deviation: float) -> Interval:
    """Some standard deviations (in z) to both sides, within the bounds."""
    j, largest = free.names.index(name), TUNING.largest_share
    if free.logarithmic[j]:
        largest = math.log(TUNING.largest_factor) / float(free.logarithms[j])
    half = min(max(TUNING.standard_deviations * deviation, TUNING.least_share), largest)
    middle = np.clip(value, free.lower, free.upper)
    sides = np.array([[-half], [half]])
    lower, upper = free.values(np.clip(free.places(middle) + sides, 0.0, 1.0))[:, j].tolist()
    return lower, upper


# -----------------------------------------------------------------------------
# The box follows the fit: solve on a box, fit in it, move it, until the optimum is inside.
#
# A box of few parameters stands around the best point so far, in the scales of the parameters.
# Where the fit ends at a side of the box that is no bound, the box moves there; where the solve
# does not reach its tolerance, the box shrinks. Each point that a fit gives is checked by
# trajectories, and is kept only if these say that it is better.


MOST_PARAMETERS = 4
"""Most parameters of a box that searches: its trajectories grow steeply with their number."""
_FIRST_WIDTH = math.log(10.0)  # Width of the first box in natural logarithms: one decade


@dataclass
class BoxSearch:
    """Boxes around the best point so far, which is ``at`` in the cube of the likelihood."""

    problem: Problem
    experiments: Sequence[Experiment]
    likelihood: OfExperiments
    at: least_squares.Expansion
    rtol: float
    bounds: Mapping[str, tuple[float | str, ...]] = field(default_factory=dict)
    boxes: list[result.Box] = field(default_factory=list)
    fit: Fit | None = None
    solution: Solution | None = None

    def search(self, most_parameters: int = MOST_PARAMETERS) -> bool:
        """Go from box to box; whether nothing promises a better likelihood in the end."""
        factor, before = 1.0, len(self.boxes)
        while True:
            taken = len(self.boxes) - before
            if taken and least_squares.bounded_step(self.at, 1.0)[1] <= UNNOTICED:
                return True
            if taken == TUNING.most_boxes or factor <= TUNING.least_factor:
                return False
            chosen = self._chosen(most_parameters, factor)
            half = {name: 0.5 * factor * self._unit(name) for name in chosen}
            box = self._taken({name: (each, each) for name, each in half.items()})
            grows = box.solved and not box.inside
            factor = min(
                factor * (TUNING.growing if grows else TUNING.shrinking), TUNING.most_factor
            )

    def around(self, reaches: Mapping[str, result.Reach]) -> None:
        """A box around the optimum that holds the intervals of some parameters.

        It shrinks until it is solved, and moves where the fit ends at one of its sides.
        """
        factor = 1.0
        for _ in range(TUNING.most_end_boxes):
            box = self._taken({n: self._end_sides(n, each, factor) for n, each in reaches.items()})
            if box.solved and box.inside:
                break
            factor *= 1.0 if box.solved else TUNING.shrinking
        if self.fit is not None:
            held = [name for name in self.likelihood.dynamic if name not in reaches]
            at = self.likelihood.named(self.at.z)
            self.fit = replace(self.fit, held={name: at[name] for name in held})

    def _end_sides(self, name: str, reach: result.Reach, factor: float) -> tuple[float, float]:
        """How far the box goes from the optimum to either side, in z."""
        z, unit = self.at.z[self.likelihood.names.index(name)], self._unit(name)
        lengths = np.maximum([z - reach.lower, reach.upper - z], 0.0)
        sides = np.minimum(
            TUNING.far * lengths, np.maximum(TUNING.near * lengths, 0.5 * TUNING.most_end * unit)
        )
        low, high = factor * np.maximum(sides, 0.5 * TUNING.least_end * unit)
        return float(low), float(high)

    def _unit(self, name: str) -> float:
        """The width of a parameter in the first box, in z."""
        free = self.likelihood.likelihood.free
        j = free.names.index(name)
        if free.logarithmic[j]:
            return min(_FIRST_WIDTH / float(free.logarithms[j]), 1.0)
        return TUNING.first_share

    def _chosen(self, most: int, factor: float) -> list[str]:
        """The parameters that matter most, and are told apart from each other.

        Columns of the Jacobian are chosen by pivoting: each adds most to those before (Golub & Van
        Loan, Matrix Computations, 5.4). They are weighed by the step that all parameters together
        promise: where it is short there is nothing to be gained.
        """
        names, dynamic = self.likelihood.names, self.likelihood.dynamic
        if len(dynamic) <= most:
            return list(dynamic)
        units = factor * np.array([self._unit(name) for name in dynamic])
        step, _ = least_squares.bounded_step(self.at, float(units.max()))
        columns = [names.index(name) for name in dynamic]
        weighed = self.at.jacobian[:, columns] * (np.abs(step[columns]) + 0.01 * units)
        _, r, order = scipy.linalg.qr(weighed, mode="economic", pivoting=True)
        sizes = np.abs(np.diag(r))[:most]
        sensitive = max(int(np.sum(sizes > TUNING.insensitive * sizes[0])), 1)
        return [dynamic[j] for j in sorted(order[:sensitive])]

    def _taken(self, sides: Mapping[str, tuple[float, float]]) -> result.Box:
        """Solve on the box that goes so far in z from the best point, and fit in it."""
        intervals = self._intervals(sides)
        solution = self._solved(intervals)
        box = result.Box(intervals, solution is not None, self.rtol)
        if solution is not None:
            box = self._fitted(solution, box)
        self.boxes.append(box)
        return box

    def _intervals(
        self, sides: Mapping[str, tuple[float, float]]
    ) -> dict[str, tuple[float, float]]:
        """The intervals of a box, moved inside the bounds."""
        free, at, intervals = self.likelihood.likelihood.free, self.at.z, {}
        for name, (below, above) in sides.items():
            j, width = free.names.index(name), below + above
            low = float(np.clip(at[j] - below, 0.0, max(1.0 - width, 0.0)))
            ends = np.repeat(at[None], 2, axis=0)
            ends[:, j] = low, min(low + width, 1.0)
            lower, upper = free.values(ends)[:, j].tolist()
            intervals[name] = lower, upper
        return intervals

    def _solved(self, intervals: Mapping[str, tuple[float, float]]) -> Solution | None:
        """The solution on a box, if it is a success; the other parameters are held."""
        free = self.likelihood.likelihood.free
        every = self.likelihood.parameters
        at = {**self.likelihood.named(self.at.z), **free.fixed}
        held = {name: at[name] for name in every if name in at and name not in intervals}
        logarithmic = dict(zip(free.names, free.logarithmic, strict=True))
        box: dict[str, tuple[float | str, ...]] = {
            name: (*ends, "log") if logarithmic[name] else ends for name, ends in intervals.items()
        }
        box |= {name: self._condition_range(name) for name in every if name not in (held | box)}
        try:
            problem = self.problem.set(held) if held else self.problem
            solution = compile_problem(problem).solve(self.rtol, parameters=box)
        except RankoneError:
            return None
        return solution if solution.success else None

    def _condition_range(self, name: str) -> tuple[float, float]:
        """From the least to the largest value of a parameter that experiments fix."""
        at = [trial.fixed[name] for trial in self.likelihood.likelihood.trials]
        low, high = min(at), max(at)
        margin = 0.0 if low < high else TUNING.margin * (abs(low) or 1.0)
        return low - margin, high + margin

    def _fitted(self, solution: Solution, box: result.Box) -> result.Box:
        """Fit in a box, and go where trajectories say that it is better."""
        at = self.likelihood.named(self.at.z)
        fit = fit_experiments(
            [(solution, each) for each in self.experiments],
            bounds=self.bounds or None,
            start={name: at[name] for name in box.intervals},
        )
        trial = self.likelihood.expanded(self.likelihood.places({**at, **fit.most_likely}))
        inside = all(self._is_inside(name, fit.x[name], box) for name in box.intervals)
        log_likelihood = self.likelihood.log_likelihood(trial)
        agrees = 2.0 * abs(log_likelihood - fit.log_likelihood) <= UNNOTICED
        if inside and not agrees:
            self.rtol = max(TUNING.tightening * self.rtol, TUNING.least_tolerance)
        if trial.cost <= self.at.cost + UNNOTICED:
            self.fit, self.solution = fit, solution
        if trial.cost < self.at.cost:
            self.at = trial
        return box._replace(log_likelihood=log_likelihood, inside=inside and agrees)

    def _is_inside(self, name: str, x: float, box: result.Box) -> bool:
        """Whether a fit is away from the sides of a box, or at a bound."""
        free = self.likelihood.likelihood.free
        j = free.names.index(name)
        low, high = box.intervals[name]
        near = SAME * (high - low)
        below = x > low + near or low <= free.lower[j] + near
        return bool(below and (x < high - near or high >= free.upper[j] - near))
