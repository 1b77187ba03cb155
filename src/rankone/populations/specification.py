"""What users say of a population: random parameters, correlations, covariates, checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rankone.estimation.formulas import formula_of
from rankone.estimation.tables import label_of, numbers_of
from rankone.populations.layout import Effect, Layout, correlated_groups
from rankone.populations.scales import LOG_NORMAL, scale_of, search_scale
from rankone.populations.subjects import SUBJECT, Subjects
from rankone.statistics.joint_distribution import by_name
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import count, did_you_mean, listing, quote

Correlated = bool | Sequence[Sequence[Any]]
"""Whether all random parameters correlate, or groups of those that do."""


def layout_of(
    subjects: Subjects,
    columns: Mapping[str, Any],
    random: object,
    covariates: object,
    correlated: Correlated,
) -> Layout:
    """The population parameters that a user asks for."""
    solution = subjects.solution
    box = solution.parameters
    names = tuple(name for name in box if name not in subjects.held)
    asked = _random(random, tuple(box))
    for name in asked:
        if name in subjects.held:
            raise OptionError(
                f"random: {quote(name)} is fixed by the table or by `fixed`",
                term=name,
                remedy="leave it out of one of them",
            )
    scales = tuple(
        scale_of(asked[name], name, box[name]) if name in asked else search_scale(box[name])
        for name in names
    )
    positions = tuple(e for e, name in enumerate(names) if name in asked)
    order = [names[e] for e in positions]
    return Layout(
        names,
        scales,
        positions,
        tuple(_effects(subjects, names, columns, covariates)),
        _groups(correlated, order),
        subjects.levels,
        len(subjects.names),
    )


def _random(given: object, names: tuple[str, ...]) -> dict[str, object]:
    """The distribution of each random parameter by name; a list alone means log-normal ones."""
    if isinstance(given, list | tuple):
        return _random(dict.fromkeys(given, LOG_NORMAL.name), names)
    asked: dict[str, object] = by_name("random", given, names)  # type: ignore[arg-type]
    if not asked:
        raise OptionError(
            "random is empty: no parameter differs between subjects",
            remedy='give random={"V": "log-normal"}, or use solution.fit',
        )
    return asked


def _groups(correlated: Correlated, names: Sequence[str]) -> tuple[tuple[int, ...], ...]:
    """Which random parameters correlate, as positions among them."""
    if isinstance(correlated, bool):
        return correlated_groups([range(len(names))] if correlated else [], len(names))
    groups = []
    for group in correlated:
        if isinstance(group, str) or not isinstance(group, Sequence):
            raise OptionError(
                f"correlated: {quote(group)} is not a group of parameters",
                term=group,
                remedy="give correlated=True for all, or groups such as [(V, CL)]",
            )
        members = by_name("correlated", dict.fromkeys(group, True), names)
        groups.append([names.index(name) for name in members])
    listed = [position for group in groups for position in group]
    if len(set(listed)) < len(listed):
        raise OptionError("correlated: a parameter is in two groups", remedy="join the groups")
    return correlated_groups(groups, len(names))


# --- covariates ----------------------------------------------------------------------------------


def _effects(
    subjects: Subjects, names: tuple[str, ...], columns: Mapping[str, Any], given: object
) -> list[Effect]:
    """The effects of covariates, each evaluated for every subject."""
    effects = []
    every: dict[str, Any] = by_name(
        "covariates",
        given,  # type: ignore[arg-type]
        tuple(subjects.solution.parameters),
    )
    for name, texts in every.items():
        if name not in names:
            raise OptionError(f"covariates: {quote(name)} is fixed", term=name)
        for text, coefficient in _coefficients(texts).items():
            x = _covariate(subjects, columns, name, text)
            effects.append(Effect(f"{name}~{text}", names.index(name), x, coefficient))
    return effects


def covariate_columns(given: object) -> set[str]:
    """Names of the columns that covariates need."""
    every = given.values() if isinstance(given, Mapping) else ()
    texts = [text for own in every for text in _coefficients(own)]
    return {name for text in texts for name in formula_of(text).names}


def _coefficients(given: object) -> dict[Any, float | None]:
    """Expressions of covariates with their coefficients, None where these are estimated."""
    if isinstance(given, Mapping):
        return {text: float(coefficient) for text, coefficient in given.items()}
    return dict.fromkeys(given if isinstance(given, list | tuple) else [given], None)


def _covariate(
    subjects: Subjects, columns: Mapping[str, Any], parameter: str, given: object
) -> Array:
    """An expression of columns for each subject (n,)."""
    formula = formula_of(given)
    for name in formula.names:
        if name not in columns:
            raise OptionError(
                f"covariates of {quote(parameter)}: the table has no column {quote(name)}"
                f"{did_you_mean(name, columns)}",
                term=name,
                remedy=f"its columns are {listing(columns)}",
            )
    at = {name: numbers_of(name, columns[name]) for name in formula.names}
    with np.errstate(all="ignore"):
        rows = np.broadcast_to(formula(at), len(columns[SUBJECT]))
    owners = np.array([label_of(entry) for entry in columns[SUBJECT]])
    x = np.array([_of_subject(each, rows[owners == each], given) for each in subjects.names])
    _check_varied(given, x)
    return x


def _of_subject(subject: str, rows: Array, given: object) -> float:
    """The one value that the rows of a subject have; some may be empty."""
    own = rows[~np.isnan(rows)]
    if not own.size or not np.isfinite(own).all():
        raise OptionError(
            f"covariates: {quote(given)} has no value for the subject {quote(subject)}",
            term=given,
            remedy="fill its cells, or leave the subject out",
        )
    if np.ptp(own) > 1e-9 * np.abs(own).max():
        raise OptionError(
            f"covariates: {quote(given)} changes within the subject {quote(subject)}",
            term=given,
            remedy="give one number a subject; what changes in time belongs in the problem",
        )
    return float(own[0])


def _check_varied(given: object, x: Array) -> None:
    """Raise an OptionError for a covariate that is the same for all subjects."""
    if x.size > 1 and np.ptp(x) <= 1e-9 * max(float(np.abs(x).max()), 1e-300):
        raise OptionError(
            f"covariates: {quote(given)} is {x[0]:g} for all {count(x.size, 'subject')}",
            term=given,
            remedy="leave it out: the mean has its effect",
        )
