"""Parameters that only observables and noise have, at their best values for given states.

Scales and offsets enter observables linearly, and a level of noise is the root mean square of its
residuals, so that the best values have closed forms (Loos, Krause & Hasenauer, Bioinformatics 34
(2018) 4266; Schmiester & al., Bioinformatics 36 (2020) 594). Where they have none (noise that grows
with the observable, logarithms of sums, priors), a few steps of least squares lead there, and no
trajectory is needed. Searches are left with the parameters that states depend on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from rankone.inference.calibration.calibrated_parameters import Series
from rankone.inference.calibration.calibration_likelihood import Evaluator, Simulated, Terms
from rankone.inference.calibration.descent import Descent, Expansion
from rankone.inference.calibration.starts import Cube
from rankone.inference.estimation.formulas import Formula
from rankone.support.arrays import Array
from rankone.support.errors import RankoneError

_MOST_ROUNDS = 20  # Of scales for given noise, and noise for given scales
_SAME = 1e-6  # Change of z from which they go on
_MOST_STEPS = 30  # Of least squares where there is no closed form


@dataclass(frozen=True, eq=False)
class Group:
    """Series, by their numbers, that share parameters, and these parameters.

    The ``scales`` (k,) are those that enter all of these observables linearly; the ``levels`` are
    standard deviations by themselves. Where closed forms are ``exact``, nothing else matters.
    """

    cube: Cube
    series: tuple[int, ...]
    scales: NDArray[np.bool_]
    levels: NDArray[np.bool_]
    exact: bool


class Nested:
    """The best values of all such parameters."""

    def __init__(self, evaluator: Evaluator, cube: Cube) -> None:
        active = evaluator.settings.active
        self.evaluator, self.cube = evaluator, cube
        self.names = tuple(name for name in cube.names if name not in active)
        self.groups = tuple(self._group(*each) for each in self._connected())

    def best(self, simulated: Simulated, values: Mapping[str, float]) -> dict[str, float]:
        """All values, with the best ones of these parameters for simulated states."""
        best = dict(values)
        for group in self.groups:
            best |= _Conditional(self.evaluator, group, simulated, best).best()
        return best

    def _connected(self) -> list[tuple[list[str], list[int]]]:
        """Sets of parameters with the numbers of the series that depend on them."""
        sets: list[tuple[list[str], list[int]]] = []
        for k, series in enumerate(self.evaluator.records.series):
            own = [name for name in self.names if name in self._parameters_of(series)]
            if not own:
                continue
            touching = [each for each in sets if set(own) & set(each[0])]
            names = [name for each in touching for name in each[0]]
            positions = [position for each in touching for position in each[1]]
            sets = [each for each in sets if each not in touching]
            sets.append(([*dict.fromkeys([*names, *own])], [*positions, k]))
        return sets

    def _parameters_of(self, series: Series) -> set[str]:
        formulas = series.observable.formula, series.observable.noise
        each = [self.evaluator.outputs.parameters_of(series, f).values() for f in formulas]
        return {name for listed in each for names in listed for name in names}

    def _group(self, names: Sequence[str], numbers: Sequence[int]) -> Group:
        every = [self.evaluator.records.series[k] for k in numbers]
        linear, noisy = list[str](), set[str]()
        levels = {name for name in names if all(self._is_level(name, s) for s in every)}
        for name in names:
            observed = any(self._names_with(name, s, s.observable.formula) for s in every)
            if observed and all(self._is_linear([*linear, name], s) for s in every):
                linear.append(name)
        for series in every:
            noise = self.evaluator.outputs.parameters_of(series, series.observable.noise)
            noisy |= {name for listed in noise.values() for name in listed}
        cube = self.cube.some(names)
        plain = all(
            s.observable.distribution == "normal" and s.observable.transformation == "lin"
            for s in every
        )
        unmixed = not any(name in noisy for name in linear) and (plain or not linear)
        covered = len(linear) + len(levels) == len(names)
        alike = len({s.observable.distribution for s in every}) == 1
        priors = any(parameter.prior is not None for parameter in cube.parameters)
        return Group(
            cube,
            tuple(numbers),
            np.array([name in linear for name in names]),
            np.array([name in levels for name in names]),
            exact=covered and unmixed and alike and not priors,
        )

    def _is_level(self, name: str, series: Series) -> bool:
        """Whether a parameter is nothing in a series but the noise itself."""
        in_noise = self._names_with(name, series, series.observable.noise)
        in_value = self._names_with(name, series, series.observable.formula)
        return not in_value and (not in_noise or series.observable.noise.is_name)

    def _is_linear(self, names: Sequence[str], series: Series) -> bool:
        formula = series.observable.formula
        inside = {own for name in names for own in self._names_with(name, series, formula)}
        return formula.degree(inside) <= 1.0

    def _names_with(self, name: str, series: Series, formula: Formula) -> list[str]:
        """The names of a formula that are a parameter in some row."""
        behind = self.evaluator.outputs.parameters_of(series, formula)
        return [own for own, parameters in behind.items() if name in parameters]


@dataclass(frozen=True, eq=False)
class _Conditional:
    """-2 log L of the series of a group for given states, by the parameters of the group."""

    evaluator: Evaluator
    group: Group
    simulated: Simulated
    values: Mapping[str, float]

    @property
    def names(self) -> tuple[str, ...]:
        return self.group.cube.names

    @property
    def nested(self) -> NDArray[np.bool_]:
        return np.zeros(len(self.names), dtype=bool)

    def best(self) -> dict[str, float]:
        """The best values of the parameters of the group; those given where nothing has any."""
        cube = self.group.cube
        start = cube.places(self.values)
        closed = self._closed(start)
        if self.group.exact:
            return cube.named(closed)
        at = min((self.expanded(z) for z in (start, closed)), key=lambda at: at.cost)
        if not np.isfinite(at.cost):
            return cube.named(closed)
        descent = Descent(at, at.z, radius=1.0, largest=1.0)
        descent.go(self, _MOST_STEPS)
        return cube.named(descent.at.z)

    def expanded(self, z: Array) -> Expansion:
        """At z (k,); see :class:`~rankone.inference.calibration.descent.Expandable`."""
        values = self.group.cube.named(z)
        with np.errstate(all="ignore"):
            try:
                each = [added for added, *_ in self._terms(values)]
            except RankoneError:
                return Expansion(z, np.inf, np.zeros(1), np.zeros((1, z.size)))
            cost, prior, rows = self.group.cube.prior_rows(values)
            slopes = self.group.cube.slopes(values)
            jacobian = np.concatenate([*(added.jacobian * slopes for added in each), rows])
        residuals = np.concatenate([*(added.residuals for added in each), prior])
        total = cost + sum(float(added.costs.sum()) for added in each)
        finite = np.isfinite(total) and np.isfinite(jacobian).all()
        return Expansion(z, 2.0 * total if finite else np.inf, residuals, jacobian)

    def _terms(self, values: Mapping[str, float]) -> list[tuple[Terms, Array, Array]]:
        """What each series adds, its predictions and their noise."""
        every, series = {**self.values, **values}, self.evaluator.records.series
        return [
            self.evaluator.terms(
                series[k], self.simulated.widened(k, self.names), every, self.names
            )
            for k in self.group.series
        ]

    def _closed(self, z: Array) -> Array:
        """Scales and levels of noise (k,) at their best, in turn."""
        for _ in range(_MOST_ROUNDS):
            before = z
            with np.errstate(all="ignore"):
                for step in (self._scales, self._levels):
                    z = step(z)
            if np.abs(z - before).max(initial=0.0) <= _SAME:
                break
        return z

    def _scales(self, z: Array) -> Array:
        """The scales at their best for the noise at z, the others as they are."""
        which = np.flatnonzero(self.group.scales)
        if not which.size:
            return z
        values = self.group.cube.named(z)
        at = np.array([values[self.names[j]] for j in which])
        try:
            weighed = [self._weighed(k, values, which, at) for k in self.group.series]
        except RankoneError:
            return z
        design, right = (np.concatenate(each) for each in zip(*weighed, strict=True))
        ends = np.array([[p.lower, p.upper] for p in self.group.cube.parameters])[which]
        return self._moved(z, which, bounded_least_squares(design, right, ends, at))

    def _weighed(
        self, k: int, values: Mapping[str, float], which: NDArray[np.intp], at: Array
    ) -> tuple[Array, Array]:
        """The design (m, s) of a series in s scales, and what it has to give (m,), over the noise.

        Noise of logarithms is relative to what was measured.
        """
        series = self.evaluator.records.series[k]
        states, every = self.simulated.widened(k, self.names), {**self.values, **values}
        value, noise = self.evaluator.outputs.predicted(series, states, every, self.names)
        size = noise.value
        if series.observable.transformation != "lin":
            size = size * series.measurements
        slope = value.slope[:, which]
        rest = series.measurements - value.value + slope @ at
        return slope / size[:, None], rest / size

    def _levels(self, z: Array) -> Array:
        """The levels of noise at their best for the scales at z."""
        which = np.flatnonzero(self.group.levels)
        if not which.size:
            return z
        try:
            each = self._terms(self.group.cube.named(z))
        except RankoneError:
            return z
        # The Jacobian by a level is not zero in the rows that have this level
        rows = np.concatenate([added.jacobian[added.costs.size :] != 0.0 for added, *_ in each])
        away = np.concatenate([np.abs(added.standardised * noise) for added, _, noise in each])
        series = self.evaluator.records.series[self.group.series[0]]
        power = 2.0 if series.observable.distribution == "normal" else 1.0
        means = [np.mean(away[rows[:, j]] ** power) ** (1.0 / power) for j in which]
        return self._moved(z, which, np.array(means))

    def _moved(self, z: Array, which: NDArray[np.intp], best: Array) -> Array:
        """The place z (k,) with other values of some parameters, if they are finite."""
        names = [self.names[j] for j in which]
        finite = {n: x for n, x in zip(names, best.tolist(), strict=True) if np.isfinite(x)}
        cube = self.group.cube
        moved, places = z.copy(), cube.places({**cube.named(z), **finite})
        moved[which] = places[which]
        return moved


def bounded_least_squares(design: Array, right: Array, ends: Array, at: Array) -> Array:
    """The best x (k,) between both ``ends`` (k, 2); as they are ``at`` where x does not matter."""
    x, sizes = at.copy(), np.linalg.norm(design, axis=0)
    free = (sizes > 0.0) & (ends[:, 0] < ends[:, 1])
    if not free.any() or not (np.isfinite(design).all() and np.isfinite(right).all()):
        return x
    rest = right - design[:, ~free] @ at[~free]
    scaled, (lower, upper) = design[:, free] / sizes[free], ends[free].T * sizes[free]
    if free.sum() == 1:
        best = np.clip(scaled.T @ rest, lower, upper)
    else:
        best = scipy.optimize.lsq_linear(scaled, rest, (lower, upper), method="bvls").x
    x[free] = best / sizes[free]
    return x
