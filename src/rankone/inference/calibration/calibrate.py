"""``rankone.calibrate``: random starts over wide bounds, and a box around the optimum."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rankone.inference.calibration.boxes import SETTLED, BoxSearch
from rankone.inference.calibration.descent import Descent
from rankone.inference.calibration.linearised import Reach, deviations_at, unidentified
from rankone.inference.calibration.profiles import profile_reaches
from rankone.inference.calibration.result import Calibration
from rankone.inference.calibration.searched import OfExperiments
from rankone.inference.calibration.starts import MOST_STARTS, descents, random_starts
from rankone.inference.estimation.experiments import Experiment
from rankone.inference.estimation.free_parameters import Bounds
from rankone.problem.problem import Problem
from rankone.solution.compiled import compile_problem
from rankone.support.errors import OptionError, check_kind
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
