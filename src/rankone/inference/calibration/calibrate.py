"""``rankone.calibrate``: random starts over wide bounds, and a box around the optimum."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from rankone.inference.calibration.records import Interval
from rankone.inference.calibration.result import (
    Box,
    Calibration,
    Reach,
    covariance_of,
    deviations_at,
    unidentified,
)
from rankone.inference.calibration.trajectory_likelihood import OfExperiments, profile_reaches
from rankone.inference.estimation.experiments import Experiment
from rankone.inference.estimation.fit import Fit
from rankone.inference.estimation.free_parameters import Bounds, FreeParameters
from rankone.inference.estimation.least_squares import (
    MOST_STARTS,
    Descent,
    Expansion,
    bounded_step,
    descents,
    random_starts,
)
from rankone.inference.estimation.search import fit_experiments
from rankone.problem.problem import Problem
from rankone.solution.compiled import compile_problem
from rankone.solution.solution import Solution
from rankone.support.arrays import Array
from rankone.support.errors import OptionError, RankoneError, check_kind
from rankone.support.options import checked_number
from rankone.support.tasks import checked_executor
from rankone.support.wording import count, listing, quote, shown
from rankone.tensors.bases.joint_distribution import by_name

MOST_END_PARAMETERS = 6
"""Most parameters of the box around the optimum."""
_SEARCH_TOLERANCE = 1e-3  # Of solutions on boxes, until the optimum is inside of one
_SEARCHES = ("trajectories", "boxes")


def calibrate(
    problem: Problem,
    experiments: Experiment | Sequence[Experiment],
    *,
    bounds: Bounds = None,
    fixed: Mapping[Any, float] | None = None,
    starts: int = 10,
    seed: int = 0,
    search: str = "trajectories",
    box: bool = True,
    rtol: float = 1e-5,
    executor: Any = None,
) -> Calibration:
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
    starts = checked_number("starts", starts, 1, MOST_STARTS)
    wanted = None if executor is None else checked_executor("executor", executor)
    if wanted is not None and search == "boxes":
        raise OptionError(
            "search='boxes' takes no executor: each box begins where the one before led",
            term=executor,
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
    if search == "boxes":
        ways = _by_boxes(boxes, starts, seed)
    else:
        ways = descents(likelihood, starts, seed, executor=wanted)
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


def _by_boxes(boxes: BoxSearch, starts: int, seed: int) -> list[Descent]:
    """Ways down from box to box, the best first."""
    ways, rtol = [], boxes.rtol
    for z in random_starts(starts, len(boxes.likelihood.names), seed):
        boxes.at, before = boxes.likelihood.expanded(z), len(boxes.boxes)
        boxes.rtol = max(rtol, _SEARCH_TOLERANCE)
        way = Descent(boxes.at, z)
        if np.isfinite(boxes.at.cost):
            way.arrived = boxes.search()
        way.at, way.iterations = boxes.at, len(boxes.boxes) - before
        ways.append(way)
    boxes.rtol = rtol
    return sorted(ways, key=lambda way: way.at.cost)


def _result(boxes: BoxSearch, ways: list[Descent], box: bool) -> Calibration:
    """What is said of the best way, with a box around its end."""
    likelihood, boxes.at = boxes.likelihood, ways[0].at
    boxes.fit = boxes.solution = None
    remark, reaches = "", dict[str, Reach]()
    if np.isfinite(boxes.at.cost):
        reaches = profile_reaches(likelihood, boxes.at)
        remark = _around(boxes, reaches) if box else ""
        if boxes.at.cost < ways[0].at.cost - SETTLED:
            reaches = profile_reaches(likelihood, boxes.at)
    ways[0].at = boxes.at
    return Calibration.of(
        likelihood,
        ways,
        reaches,
        boxes=tuple(boxes.boxes),
        fit=boxes.fit,
        solution=boxes.solution,
        comparisons=likelihood.comparisons(boxes.at),
        remark=remark,
    )


def _around(boxes: BoxSearch, reaches: Mapping[str, Reach]) -> str:
    """Take a box around the optimum; a sentence that says why there is none."""
    likelihood = boxes.likelihood
    deviations = deviations_at(boxes.at, likelihood.variance(boxes.at))
    free = {
        *unidentified(likelihood.names, deviations),
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


MOST_AROUND = 4
"""Most parameters of a box around the end of a search, unless they are named."""
_STANDARD_DEVIATIONS = 4.0  # Half the width of the box
_LARGEST_FACTOR = 3.0  # From the middle to an end, on logarithmic scales
_LARGEST_SHARE = 0.1  # The same in widths of the bounds, on linear ones
_LEAST_SHARE = 1e-4  # Least half width, in widths of the bounds
_AROUND_INSENSITIVE = 1e-3  # Share of the largest sensitivity below which a parameter is left out


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
        sizes = np.abs(np.diag(r))[:MOST_AROUND]
        count = max(int(np.sum(sizes > _AROUND_INSENSITIVE * sizes[0])), 1)
    chosen = order[:count]
    spreads = np.sqrt(np.diag(covariance_of(rest[:, chosen])))
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
    j, largest = free.names.index(name), _LARGEST_SHARE
    if free.logarithmic[j]:
        largest = math.log(_LARGEST_FACTOR) / float(free.logarithms[j])
    half = min(max(_STANDARD_DEVIATIONS * deviation, _LEAST_SHARE), largest)
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
_FIRST_SHARE = 0.125  # The same in widths of the bounds, for parameters without logarithm
_LEAST_FACTOR, _MOST_FACTOR = 0.02, 2.0  # Factors on these widths between which boxes stay
_SHRINKING, _GROWING = 0.5, 1.5
_AGREEMENT = 0.02  # Accepted difference of -2 log L between a solution and trajectories
_TIGHTENING = 0.1  # Factor on the tolerance where they differ by more
_LEAST_TOLERANCE = 1e-8
_MOST_BOXES = 30  # Of one start
_MOST_END_BOXES = 6  # Boxes around an optimum that are tried
SETTLED = 0.02
"""Decrease of -2 log L that all parameters promise below which a search has arrived."""
_INSENSITIVE = 1e-4  # Share of the largest sensitivity below which a parameter is not in a box
# From the optimum to the sides of the box around it, in lengths to the ends of the interval, where
# these are short or long
_FAR, _NEAR = 2.0, 1.25
_LEAST_END, _MOST_END = 0.05, 0.7  # Factors on the first widths between which such boxes are
_SIDE = 1e-6  # Distance from a side, in widths of the box, that counts as at the side
_MARGIN = 1e-3  # Half the width of a condition that all experiments share, relative


@dataclass
class BoxSearch:
    """Boxes around the best point so far, which is ``at`` in the cube of the likelihood."""

    problem: Problem
    experiments: Sequence[Experiment]
    likelihood: OfExperiments
    at: Expansion
    rtol: float
    bounds: Mapping[str, tuple[float | str, ...]] = field(default_factory=dict)
    boxes: list[Box] = field(default_factory=list)
    fit: Fit | None = None
    solution: Solution | None = None

    def search(self, most_parameters: int = MOST_PARAMETERS) -> bool:
        """Go from box to box; whether nothing promises a better likelihood in the end."""
        factor, before = 1.0, len(self.boxes)
        while True:
            taken = len(self.boxes) - before
            if taken and bounded_step(self.at, 1.0)[1] <= SETTLED:
                return True
            if taken == _MOST_BOXES or factor <= _LEAST_FACTOR:
                return False
            chosen = self._chosen(most_parameters, factor)
            half = {name: 0.5 * factor * self._unit(name) for name in chosen}
            box = self._taken({name: (each, each) for name, each in half.items()})
            grows = box.solved and not box.inside
            factor = min(factor * (_GROWING if grows else _SHRINKING), _MOST_FACTOR)

    def around(self, reaches: Mapping[str, Reach]) -> None:
        """A box around the optimum that holds the intervals of some parameters.

        It shrinks until it is solved, and moves where the fit ends at one of its sides.
        """
        factor = 1.0
        for _ in range(_MOST_END_BOXES):
            box = self._taken({n: self._end_sides(n, each, factor) for n, each in reaches.items()})
            if box.solved and box.inside:
                break
            factor *= 1.0 if box.solved else _SHRINKING
        if self.fit is not None:
            held = [name for name in self.likelihood.dynamic if name not in reaches]
            at = self.likelihood.named(self.at.z)
            self.fit = replace(self.fit, held={name: at[name] for name in held})

    def _end_sides(self, name: str, reach: Reach, factor: float) -> tuple[float, float]:
        """How far the box goes from the optimum to either side, in z."""
        z, unit = self.at.z[self.likelihood.names.index(name)], self._unit(name)
        lengths = np.maximum([z - reach.lower, reach.upper - z], 0.0)
        sides = np.minimum(_FAR * lengths, np.maximum(_NEAR * lengths, 0.5 * _MOST_END * unit))
        low, high = factor * np.maximum(sides, 0.5 * _LEAST_END * unit)
        return float(low), float(high)

    def _unit(self, name: str) -> float:
        """The width of a parameter in the first box, in z."""
        free = self.likelihood.likelihood.free
        j = free.names.index(name)
        if free.logarithmic[j]:
            return min(_FIRST_WIDTH / float(free.logarithms[j]), 1.0)
        return _FIRST_SHARE

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
        step, _ = bounded_step(self.at, float(units.max()))
        columns = [names.index(name) for name in dynamic]
        weighed = self.at.jacobian[:, columns] * (np.abs(step[columns]) + 0.01 * units)
        _, r, order = scipy.linalg.qr(weighed, mode="economic", pivoting=True)
        sizes = np.abs(np.diag(r))[:most]
        sensitive = max(int(np.sum(sizes > _INSENSITIVE * sizes[0])), 1)
        return [dynamic[j] for j in sorted(order[:sensitive])]

    def _taken(self, sides: Mapping[str, tuple[float, float]]) -> Box:
        """Solve on the box that goes so far in z from the best point, and fit in it."""
        intervals = self._intervals(sides)
        solution = self._solved(intervals)
        box = Box(intervals, solution is not None, self.rtol)
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
        margin = 0.0 if low < high else _MARGIN * (abs(low) or 1.0)
        return low - margin, high + margin

    def _fitted(self, solution: Solution, box: Box) -> Box:
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
        agrees = 2.0 * abs(log_likelihood - fit.log_likelihood) <= _AGREEMENT
        if inside and not agrees:
            self.rtol = max(_TIGHTENING * self.rtol, _LEAST_TOLERANCE)
        if trial.cost <= self.at.cost + _AGREEMENT:
            self.fit, self.solution = fit, solution
        if trial.cost < self.at.cost:
            self.at = trial
        return box._replace(log_likelihood=log_likelihood, inside=inside and agrees)

    def _is_inside(self, name: str, x: float, box: Box) -> bool:
        """Whether a fit is away from the sides of a box, or at a bound."""
        free = self.likelihood.likelihood.free
        j = free.names.index(name)
        low, high = box.intervals[name]
        near = _SIDE * (high - low)
        below = x > low + near or low <= free.lower[j] + near
        return bool(below and (x < high - near or high >= free.upper[j] - near))
