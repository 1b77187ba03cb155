"""``fit_population``: nonlinear mixed effects on a solution."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rankone.inference.estimation.experiments import Experiment
from rankone.inference.estimation.free_parameters import SAME, ParameterValues
from rankone.inference.estimation.intervals import checked_level
from rankone.inference.estimation.likelihood import UNNOTICED
from rankone.inference.estimation.observations import Sigma
from rankone.inference.estimation.tables import Tabular, columns_of, doses_in, is_empty, is_table
from rankone.inference.populations import population_layout
from rankone.inference.populations.individuals import EmpiricalBayes, Start
from rankone.inference.populations.marginal import (
    Marginal,
    Optimum,
    expectation_steps,
    minimum,
    start_of,
)
from rankone.inference.populations.population_fit import PopulationFit
from rankone.inference.populations.subjects import SUBJECT, Subjects, subjects_of
from rankone.solution.evaluation.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import count, did_you_mean, listing, quote, shown
from rankone.tensors.bases.joint_distribution import by_name

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
    level: float = 0.95,
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
