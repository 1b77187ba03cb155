"""``fit_population``: nonlinear mixed effects on a solution, and whether to believe them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rankone.inference.estimation import estimates as results
from rankone.inference.estimation.experiments import Experiment, failure_of
from rankone.inference.estimation.free_parameters import ParameterValues
from rankone.inference.estimation.intervals import checked_level
from rankone.inference.estimation.likelihood import UNNOTICED
from rankone.inference.estimation.observations import Sigma
from rankone.inference.estimation.tables import Tabular, columns_of, doses_in, is_empty, is_table
from rankone.inference.populations import population_layout
from rankone.inference.populations import predictive_check as _check
from rankone.inference.populations.individuals import EmpiricalBayes, Start
from rankone.inference.populations.marginal import (
    Marginal,
    Optimum,
    expectation_steps,
    minimum,
    start_of,
)
from rankone.inference.populations.population_estimates import PopulationEstimates
from rankone.inference.populations.subjects import SUBJECT, Subjects, subjects_of
from rankone.solution.evaluation.core import SolutionCore
from rankone.support.arrays import SAME, Array, Table, Variables
from rankone.support.errors import (
    LISTED,
    OptionError,
    count,
    did_you_mean,
    listing,
    quote,
    shown,
    with_remedy,
)
from rankone.support.options import LEVEL
from rankone.tensors.joint_distribution import by_name

# Standard deviations of the random effects that a box should hold to either side
_BOX_SPREADS = 3.0
_HIGH_SHRINKAGE = 0.3  # Above it the estimates of subjects say little of the population


@dataclass(frozen=True, repr=False)
class PopulationFit(PopulationEstimates, results.Judged):
    """Means and variances of a population from data of several subjects.

    Attributes
    ----------
    level : float
        Default level of intervals.
    idle : tuple of str
        Standard deviations, of random effects or of noise, that the data show to be zero.
    """

    predictive_check = _check.predictive_check

    @cached_property
    def findings(self) -> tuple[str, ...]:
        """Reasons not to trust the fit, a sentence each."""
        return tuple(self._findings())

    def _findings(self) -> Iterator[str]:
        if not self.solution.success:
            yield failure_of(self.solution)
        if not self.converged:
            yield with_remedy("the search did not converge", "give a start, or fewer parameters")
        yield from self._at_ends()
        yield from self._not_identified()
        yield from self._error_of_solution()

    def _at_ends(self) -> Iterator[str]:
        """Parameters whose estimates are at an end of the box, for some subjects."""
        ends = self._search.at_ends(self._psi, self._optimum.individuals.eta[0])
        for e, name in enumerate(self.parameters):
            for side, word in ((-1, "lower"), (1, "upper")):
                at = np.flatnonzero(ends[:, e] == side)
                if not at.size:
                    continue
                end = self.solution.parameters[name][max(side, 0)]
                where = ""
                if e in self._layout.random:
                    names = [self.subjects[i] for i in at[:LISTED]]
                    more = f" and {at.size - len(names)} more" if at.size > len(names) else ""
                    noun = "subject" if at.size == 1 else "subjects"
                    where = f" of {noun} {', '.join(names)}{more}"
                low, high = self._suggested_box(e)
                yield with_remedy(
                    f"{quote(name)}{where} is at the {word} end of the box, {end:.4g}: means and "
                    "variances are not valid",
                    f"solve on a wider box, such as {name} in ({low:.3g}, {high:.3g})",
                )

    def _suggested_box(self, e: int) -> tuple[float, float]:
        """A box that holds the box so far and the random effects with room to spare."""
        box = self.solution.parameters[self.parameters[e]]
        scale = self._layout.scales[e]
        middle = self._layout.typical(self._psi[None])[0][:, e]
        ends = np.array([self._search.lower[e], self._search.upper[e]])
        room = 0.25 * (ends[1] - ends[0])
        if e in self._layout.random:
            q = self._layout.random.index(e)
            room = max(room, 4.0 * math.sqrt(self.omega[q, q]))
        low, high = scale.value(np.array([middle.min() - room, middle.max() + room]))
        return min(float(low), box[0]), max(float(high), box[1])

    def _not_identified(self) -> Iterator[str]:
        unseen = [name for name, identified in self.identifiable.items() if not identified]
        if not unseen:
            return
        yield with_remedy(
            f"the data do not identify {listing(unseen)}", "fix some, or measure more"
        )

    def _error_of_solution(self) -> Iterator[str]:
        """Where the error of the solution is not small beside the noise."""
        if not self.solution.success:
            return
        moved = self.predicted(self.individuals, self.solution.errors)
        for (one, prediction, sigma), (_, shifted, _) in zip(
            self.predicted(self.individuals), moved, strict=True
        ):
            error = np.abs(shifted - prediction)[one.present]
            noise = sigma[one.present]
            if one.noise.distribution == "log-normal":
                noise = noise * np.abs(prediction[one.present])
            yield from results.error_beside_noise(one.name, error, noise)

    @cached_property
    def checks(self) -> tuple[str, ...]:
        """What is worth knowing and no reason to distrust the fit, a sentence each."""
        return tuple(self._checks())

    def _checks(self) -> Iterator[str]:
        for name in self.idle:
            of = "noise" if name in self._layout.zero_levels else "variation between subjects"
            yield f"{quote(name)} is zero: the data show no such {of}"
        for q, e in enumerate(self._layout.random):
            reach = _BOX_SPREADS * math.sqrt(self.omega[q, q])
            middle = self._layout.typical(self._psi[None])[0][:, e]
            inside = self._search.lower[e] <= middle.min() - reach
            if not (inside and middle.max() + reach <= self._search.upper[e]):
                low, high = self._suggested_box(e)
                yield (
                    f"the box does not hold {_BOX_SPREADS:g} standard deviations of "
                    f"{quote(self.parameters[e])}: simulations need ({low:.3g}, {high:.3g})"
                )
        weak = {n: s for n, s in self.shrinkage.items() if n in self.random and s > _HIGH_SHRINKAGE}
        for name, share in weak.items():
            yield (
                f"the shrinkage of {quote(name)} is {100 * share:.0f} %: estimates of single "
                "subjects are drawn to the mean"
            )

    # --- display -------------------------------------------------------------------------------

    def _table(self) -> Table:
        """The estimates, a line each, and whether to believe them."""
        observed = ", ".join(one.name for one in self._subjects.measured)
        rows = []
        for name, (low, high) in self.interval().items():
            shrunk = self.shrinkage.get(name.removeprefix("omega_")) if "omega_" in name else None
            identified = self.identifiable[name] and not math.isnan(low)
            rows.append(
                [
                    name,
                    f"{self.x[name]:.5g}",
                    f"{self.std[name]:.3g}" if identified else "",
                    f"[{low:.5g}, {high:.5g}]" if identified else "",
                    "" if shrunk is None else f"{100 * shrunk:.0f} %",
                ]
            )
            if not self.identifiable[name]:
                rows[-1][1:4] = ["not identified", "", ""]
        return Table(
            f"Population of {count(len(self.subjects), 'subject')}: {count(self.size, 'value')} of "
            f"{observed}, log-likelihood {self.log_likelihood:.5g}",
            ["parameter", "estimate", "std error", f"{100 * self.level:g} % interval", "shrinkage"],
            rows,
            self._remarks,
        )

    def _variables(self) -> Variables:
        """Estimates with errors and intervals."""
        intervals = self.interval()
        low, high = np.array(list(intervals.values())).T
        columns = {
            "estimate": [self.x[name] for name in intervals],
            "std": [self.std[name] for name in intervals],
            "lower": low,
            "upper": high,
            "identified": [self.identifiable[name] for name in intervals],
        }
        return results.by_parameter(columns, list(intervals))


# -----------------------------------------------------------------------------
# ``fit_population``: nonlinear mixed effects on a solution.


_FAR_SMALLER = 3.0  # Change of a logarithm that makes a standard deviation practically zero
_MOST_RESTARTS = 3


def fit_population(
    self: SolutionCore,
    table: object,
    *,
    random: object,
    covariates: object = None,
    correlated: population_layout.Correlated = False,
    observe: object = None,
    sigma: Sigma = None,
    noise: object = None,
    fixed: Mapping[Any, Any] | None = None,
    doses: Mapping[Any, str] | None = None,
    start: ParameterValues = None,
    subject: str = SUBJECT,
    level: float = LEVEL,
) -> PopulationFit:
    """Means, variances and subjects of a population: nonlinear mixed effects.

    Each subject has parameters of its own, drawn from a distribution; the fit maximises the
    marginal likelihood of the distribution by Laplace's method: first-order conditional estimation
    with interaction.

    Parameters
    ----------
    table : table or mapping
        A pandas DataFrame, or a mapping from names to columns: a row for each time, with a column
        of subjects, one of time, and one for each unknown or observable. Cells may be empty.
        Columns named like parameters hold values of them: doses.
    random : mapping or list
        The parameters that differ between subjects with their distributions, ``"log-normal"``,
        ``"normal"`` or ``"logit-normal"``; a list of parameters means log-normal ones. All others
        that the table does not hold are the same for all subjects, and estimated as well.
    covariates : mapping, optional
        For some parameters expressions of columns that shift them, on the scale on which they are
        normal: ``{CL: "log(weight/70)"}`` for a power of the weight. Several in a list; a mapping
        ``{CL: {"log(weight/70)": 0.75}}`` gives coefficients that are not estimated.
    correlated : bool or list of groups
        Whether random effects correlate: all of them, or groups such as ``[(V, CL)]``.
    observe, sigma, noise
        What was measured, and its noise; see :meth:`Solution.fit`. Without sigma and noise it is
        constant, with a level that is estimated for each observable.
    fixed : mapping, optional
        Values of known parameters; perhaps mappings by subject.
    doses : mapping, optional
        The parameter that is the amount of a dose, with the column of amounts: ``{dose: "amt"}``.
        The table then has a row for each dose of a subject, at its time, beside those of data, and
        perhaps the columns ``evid``, ``mdv``, ``addl`` and ``ii`` of NONMEM. The solution is that
        of one dose at its start. Those of several add up: this takes a linear system.
    start : mapping, optional
        Typical values of some parameters to start from.
    subject : str
        The column of subjects.
    level : float
        Probability of the intervals.

    Returns
    -------
    PopulationFit
        With ``x``, ``std``, ``interval()``, ``omega``, ``individuals``, ``effects``,
        ``shrinkage``, ``success`` and ``message``. It is a success if the search converged, no
        subject is at an end of the box, every parameter is identified, and the error of the
        solution is small beside the noise.

    Raises
    ------
    OptionError
        If names, distributions or columns are unknown or do not fit, or there are too few data.
    EvaluationError
        If a time is outside the horizon, or a value outside the box.
    """
    self._evaluator  # noqa: B018 - raises if nothing was solved
    level = checked_level(level)
    if not (is_table(table) or isinstance(table, Mapping)):
        raise OptionError(
            f"{shown(table)} is not a table",
            term=table,
            remedy="give a pandas DataFrame, or a mapping from names to columns",
        )
    columns = _columns(table, subject)
    if noise is None and sigma is None and not any(name.startswith("sigma") for name in columns):
        noise = "constant"
    rows, by_subject, held = _without_covariates(self, columns, covariates), None, dict(fixed or {})
    if doses is not None:
        by_subject, rows = doses_in(self, rows, doses, observe)
        held = by_subject.with_reference(self, held)
    experiment = Experiment(columns, fixed=held, observe=observe, sigma=sigma, noise=noise)
    subjects = subjects_of(self, experiment, rows, by_subject)
    if by_subject is not None:
        by_subject.check_observables((m.name, m.formula, m.noise) for m in subjects.measured)
    layout = population_layout.layout_of(subjects, columns, random, covariates, correlated)
    _check_size(subjects, layout)
    marginal = Marginal(EmpiricalBayes(subjects, layout))
    named = by_name("start", start, tuple(self.parameters))
    psi, begin = start_of(subjects, marginal.search, _start_coordinates(self, layout, named))
    try:
        optimum = _settled(marginal, *expectation_steps(marginal, psi, begin))
        marginal, optimum, idle = _without_idle(marginal, optimum)
    except np.linalg.LinAlgError:
        names = [layout.names[e] for e in layout.random]
        raise OptionError(
            f"the search for the covariance of the random effects of {listing(names)} broke down: "
            "a matrix became singular",
            remedy="give a start, make fewer parameters random, or measure each subject more often",
        ) from None
    return PopulationFit(level, marginal, optimum, idle)


def _columns(table: Tabular | Mapping[Any, Any], subject: str) -> dict[str, Any]:
    """The columns of a table; the column of subjects gets its usual name."""
    columns = columns_of(table)
    if subject not in columns:
        raise OptionError(
            f"the table has no column {quote(subject)} of subjects{did_you_mean(subject, columns)}",
            term=list(columns),
            remedy=f"name it, subject=...; the columns are {listing(columns)}",
        )
    columns[SUBJECT] = columns.pop(subject)
    for row, entry in enumerate(columns[SUBJECT], 1):
        if is_empty(entry):
            raise OptionError(
                f"row {row} of the table: {quote(subject)} is empty",
                term=subject,
                remedy="fill it, or drop the row",
            )
    return columns


def _without_covariates(
    solution: SolutionCore, columns: Mapping[str, Any], covariates: object
) -> dict[str, Any]:
    """The columns without those that are covariates alone."""
    kept = {*solution.parameters, *solution.states, solution.metadata.time, "time", SUBJECT}
    alone = population_layout.covariate_columns(covariates) - kept
    return {name: column for name, column in columns.items() if name not in alone}


def _check_size(subjects: Subjects, layout: population_layout.Layout) -> None:
    """Raise an OptionError where there are too few subjects or data."""
    n = len(subjects.names)
    if n < 2:
        raise OptionError(
            f"the table has {count(n, 'subject')}: variances need several",
            remedy="use solution.fit for one",
        )
    if subjects.size <= layout.size:
        raise OptionError(
            f"there are {count(subjects.size, 'value')} for {layout.size} parameters of the "
            "population",
            remedy="measure more, or fix parameters: fixed={name: value}",
        )


def _start_coordinates(
    solution: SolutionCore, layout: population_layout.Layout, named: Mapping[str, float]
) -> dict[int, float]:
    """Coordinates of a start by position."""
    coordinates = {}
    for name, x in named.items():
        if name not in layout.names:
            raise OptionError(f"start: {quote(name)} is fixed", term=name)
        e = layout.names.index(name)
        position = list(solution.parameters).index(name) + 1
        inside = solution._coordinates.checked(position, x)
        coordinates[e] = float(layout.scales[e].coordinate(inside))
    return coordinates


def _settled(marginal: Marginal, psi: Array, start: Start) -> Optimum:
    """The optimum, from which no subject has a better mode near the mean."""
    optimum = minimum(marginal, psi, start)
    for _ in range(_MOST_RESTARTS):
        here = optimum.individuals
        _, other = marginal.at(optimum.psi[None], Start.at(np.zeros(start.eta.shape)))
        gain = here.at.cost + here.penalty - other.at.cost - other.penalty
        better = gain[0] > SAME
        if not better.any():
            break
        eta = np.where(better[:, None], other.eta[0], here.eta[0])
        optimum = minimum(marginal, optimum.psi, Start.at(eta))
    return optimum


def _without_idle(
    marginal: Marginal, optimum: Optimum
) -> tuple[Marginal, Optimum, tuple[str, ...]]:
    """The optimum without standard deviations that are zero, and the names of these."""
    idle: tuple[str, ...] = ()
    while True:
        layout, psi = marginal.search.layout, optimum.psi
        name, smaller, kept = _first_idle(marginal, optimum)
        if name is None:
            return marginal, optimum, idle
        idle = (*idle, name)
        eta = optimum.individuals.eta[0]
        removed = [q for q, e in enumerate(layout.random) if e not in smaller.random]
        eta = np.delete(eta, removed, axis=1)
        marginal = Marginal(EmpiricalBayes(marginal.search.subjects, smaller))
        optimum = _settled(marginal, psi[kept], Start.at(eta))


def _first_idle(
    marginal: Marginal, optimum: Optimum
) -> tuple[str | None, population_layout.Layout, NDArray[np.intp]]:
    """The first standard deviation that may as well be zero, the layout without it, and what stays.

    The last is the positions of the other population parameters.
    """
    layout = marginal.search.layout
    trials = [*_without_effects(layout, optimum.psi), *_without_levels(layout, optimum.psi)]
    if trials:
        psi = np.array([trial.psi for trial in trials])
        values = marginal.values(psi, optimum.individuals.start())
        for trial, value in zip(trials, values, strict=True):
            if value <= optimum.value + UNNOTICED:
                return trial.name, trial.layout, trial.kept
    return None, layout, np.arange(layout.size)


class _Trial(NamedTuple):
    """A standard deviation that is practically zero at psi, and the layout without it."""

    name: str
    psi: Array
    layout: population_layout.Layout
    kept: NDArray[np.intp]


def _without_effects(layout: population_layout.Layout, psi: Array) -> Iterator[_Trial]:
    """Each random effect in turn is left out, unless it is the only one."""
    for q, e in enumerate(layout.random if len(layout.random) > 1 else ()):
        gone = [k for k, entry in enumerate(layout.entries) if q in entry]
        trial = psi.copy()
        trial[layout.factors][gone] = 0.0
        trial[layout.factors.start + q] = psi[layout.factors.start + q] - _FAR_SMALLER
        others = [p for p in range(len(layout.random)) if p != q]
        groups = [[others.index(p) for p in group if p != q] for group in layout.groups]
        smaller = replace(
            layout,
            random=tuple(layout.random[p] for p in others),
            groups=tuple(tuple(group) for group in groups if group),
        )
        kept = np.setdiff1d(np.arange(layout.size), layout.factors.start + np.array(gone))
        yield _Trial(f"omega_{layout.names[e]}", trial, smaller, kept)


def _without_levels(layout: population_layout.Layout, psi: Array) -> Iterator[_Trial]:
    """Each level of noise in turn is left out, unless it is the only one."""
    for j, level in enumerate(layout.levels if len(layout.levels) > 1 else ()):
        trial = psi.copy()
        trial[layout.noise.start + j] -= _FAR_SMALLER
        rest = tuple(name for name in layout.levels if name != level)
        smaller = replace(layout, levels=rest, zero_levels=(*layout.zero_levels, level))
        kept = np.delete(np.arange(layout.size), layout.noise.start + j)
        yield _Trial(level, trial, smaller, kept)
