"""The minimum that a fit reports, and what is said of it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from rankone.inference.estimation.estimates import leverages_of
from rankone.inference.estimation.fit import Fit
from rankone.inference.estimation.identification import Best, degrees_of_freedom, identify
from rankone.inference.estimation.intervals import quantile_of
from rankone.inference.estimation.least_squares import Minima, minima, squares_of
from rankone.inference.estimation.likelihood import Likelihood
from rankone.inference.estimation.prediction_jumps import jumps_within
from rankone.inference.estimation.ranges import level_uncertainty
from rankone.support.arrays import Array

_DISTINCT_DISTANCE = 1e-2  # Distance in the cube above which minima are different ones
_EQUAL_COST_SHARE = 1e-3  # Difference of costs, in shares of the mean square, that counts as none
_SAME_DISTANCE = 1e-3  # Distance in the cube below which minima are the same
_LEAST_FREEDOM = 0.5  # Least degrees of freedom of a level of noise that is corrected for them


def chosen(problem: Likelihood, ends: Minima) -> int:
    """The best minimum; among equally good ones the farthest from the bounds."""
    best = int(ends.cost.argmin())
    mean = float(squares_of(ends.residuals[best : best + 1])[0]) / problem.size
    good = np.flatnonzero(ends.cost <= ends.cost.min() + _EQUAL_COST_SHARE * mean)
    inside = np.minimum(ends.z[good], 1.0 - ends.z[good]).min(axis=1)
    apart = np.abs(ends.z[good] - ends.z[best]).max(axis=1)
    if apart.max() <= _SAME_DISTANCE:
        return best
    return int(good[np.argmax(inside)])


def judged(problem: Likelihood, ends: Minima, k: int, level: float, points: Array) -> Fit:
    """The fit at one of the minima: what is identified there, and what else fits."""
    z, cost, jacobian = ends.z[k], float(ends.cost[k]), ends.jacobian[k]
    dof = degrees_of_freedom(problem, cost, jacobian)
    least = max(dof, 1.0)
    noise_given = problem.unit_known and not problem.levels
    unit = 1.0 if problem.unit_known else math.sqrt(cost / least)
    q = quantile_of(level, noise_given, least)
    reported, freedom = _corrected(problem, z, jacobian)
    centre = Best(z, cost, np.zeros((z.size, 0)))
    if problem.levels:
        jacobian = problem.linearised(reported[None], settle=False).jacobian[0]
        centre = _at_levels(problem, reported)
    identification, levels = identify(problem, centre, jacobian, q, unit), None
    centre = replace(centre, root=identification.root)
    if problem.levels:
        levels = level_uncertainty(problem, jacobian, identification.seen, freedom)
        identification = identification.enlarged(levels)
    limit = problem.size * math.log1p(q**2 / least) if problem.levels else (q * unit) ** 2
    distinct = () if identification.flat else _others(problem, ends, k, limit)
    jumps = jumps_within(problem, reported, q * identification.root, jacobian / (unit or 1.0))
    return Fit(
        level=level,
        converged=bool(ends.converged[k]),
        stuck=bool(ends.stuck[k]),
        kinked=bool(ends.kinked[k]),
        dof=dof,
        _problem=problem,
        _best=Best(z, cost, identification.root),
        _centre=centre,
        _z=reported,
        _identification=identification,
        _freedom=freedom,
        _levels=levels,
        others=distinct,
        jumps=jumps,
        sizes=_sizes(problem, points),
    )


def _at_levels(problem: Likelihood, reported: Array) -> Best:
    """The best point with the levels of noise that are reported, from which profiles go."""
    held = np.zeros((1, reported.size), dtype=bool)
    held[:, list(problem.levels)] = True
    ends = minima(problem, reported[None], held)
    return Best(ends.z[0], float(ends.cost[0]), np.zeros((reported.size, 0)))


def _corrected(problem: Likelihood, z: Array, jacobian: Array) -> tuple[Array, dict[int, float]]:
    """The estimate z (n,) with levels of noise corrected for the degrees of freedom used.

    With it the share of the data that is left to estimate each level, by its position.

    The mean square of n residuals is too small by the sum of their leverages h (Patterson &
    Thompson, "Recovery of inter-block information", 1971, to first order): its expectation is
    (n - h) sigma^2.
    """
    if not problem.groups:
        return z, {}
    leverages = leverages_of(problem, jacobian)
    values, shares = problem.free.values(z), {}
    for group in problem.groups:
        names = {problem.free.names[j] for j in group}
        own = [
            here
            for trial, i, here in problem.blocks
            if names & set(trial.observations.noises[i].levels)
        ]
        size = sum(here.stop - here.start for here in own)
        freedom = size - sum(float(leverages[here].sum()) for here in own)
        if freedom >= _LEAST_FREEDOM:
            for j in group:
                shares[j] = freedom / size
                values[j] = min(values[j] * math.sqrt(size / freedom), problem.free.upper[j])
    return problem.free.places(values), shares


def _sizes(problem: Likelihood, points: Array) -> tuple[dict[str, float], ...]:
    """For each trial the largest values of its states over points (N, n) of the cube."""
    at = problem.at(problem.free.values(points))
    sizes = []
    for trial in problem.trials:
        states = np.abs(trial.states(at))
        largest = states[np.isfinite(states).all(axis=1)].max(axis=0, initial=0.0)
        own: dict[str, float] = {}
        begin = 0
        for i, rows in enumerate(trial.rows):
            size = trial.observations.noises[i].spread.size
            for row in rows:
                top = float(largest[begin : begin + size].max(initial=0.0))
                own[row] = max(own.get(row, 0.0), top)
                begin += size
        sizes.append(own)
    return tuple(sizes)


def _others(
    problem: Likelihood, ends: Minima, k: int, limit: float
) -> tuple[dict[str, float], ...]:
    """Minima apart from the chosen one whose costs are within a limit of it.

    Other levels of noise alone are no other values.
    """
    chosen = [ends.z[k]]
    values = [j for j in range(len(problem.free.names)) if j not in problem.levels]
    margin = max(limit, 1e-9 * abs(float(ends.cost[k])))
    for z, cost, ended in zip(ends.z, ends.cost, ends.converged, strict=True):
        apart = all(
            np.abs(z - minimum)[values].max(initial=0.0) > _DISTINCT_DISTANCE for minimum in chosen
        )
        if ended and apart and cost <= ends.cost[k] + margin:
            chosen.append(z)
    levels = {problem.free.names[j] for j in problem.levels}
    return tuple(
        {name: x for name, x in problem.free.named(z).items() if name not in levels}
        for z in chosen[1:]
    )
