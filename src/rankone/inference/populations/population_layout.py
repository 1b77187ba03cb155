"""What users say of a population, and the population parameters in a row."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from rankone.inference.estimation.formulas import formula_of
from rankone.inference.estimation.tables import label_of, numbers_of
from rankone.inference.populations.subjects import SUBJECT, Subjects
from rankone.support.arrays import NEGLIGIBLE, TINY, Array
from rankone.support.errors import OptionError, count, did_you_mean, listing, quote, shown
from rankone.tensors.joint_distribution import by_name


@dataclass(frozen=True)
class Scale:
    """A parameter x as a function of its coordinate z on which it is normal, and back.

    ``slope`` is dx/dz as a function of x. Parameters are between ``least`` and ``most``.
    """

    name: str
    coordinate: Callable[[Array], Array]
    value: Callable[[Array], Array]
    slope: Callable[[Array], Array]
    least: float = -np.inf
    most: float = np.inf


NORMAL = Scale("normal", np.asarray, np.asarray, np.ones_like)
LOG_NORMAL = Scale("log-normal", np.log, np.exp, np.asarray, 0.0)
LOGIT_NORMAL = Scale(
    "logit-normal", special.logit, special.expit, lambda x: x * (1.0 - x), 0.0, 1.0
)
SCALES = {scale.name: scale for scale in (NORMAL, LOG_NORMAL, LOGIT_NORMAL)}
"""The scales by the names that ``random=`` takes."""
_OTHER_NAMES = {"lognormal": "log-normal", "logit": "logit-normal", "logitnormal": "logit-normal"}


def scale_of(given: object, parameter: str, box: tuple[float, float]) -> Scale:
    """The scale of a random parameter by its name; an OptionError if the box does not fit it."""
    name = _OTHER_NAMES.get(given, given) if isinstance(given, str) else None
    if name not in SCALES:
        raise OptionError(
            f"random: the distribution of {quote(parameter)} is {shown(given)}"
            f"{did_you_mean(str(given), SCALES)}",
            term=given,
            remedy=f"choose from {listing(SCALES)}",
        )
    scale = SCALES[name]
    if box[0] <= scale.least or box[1] >= scale.most:
        end = box[0] if box[0] <= scale.least else box[1]
        bounds = "positive" if scale.most == np.inf else "between 0 and 1"
        raise OptionError(
            f"{quote(parameter)} is {scale.name}, and so {bounds}, but the box of the solution "
            f"reaches to {end:g}",
            term=parameter,
            remedy='solve on a box inside of that, or choose "normal"',
        )
    return scale


def search_scale(box: tuple[float, float]) -> Scale:
    """The scale on which a parameter without random effect is searched: its logarithm if it can."""
    return LOG_NORMAL if box[0] > 0.0 else NORMAL


# -----------------------------------------------------------------------------
# What users say of a population: random parameters, correlations, covariates, checked.


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
    if np.ptp(own) > NEGLIGIBLE * np.abs(own).max():
        raise OptionError(
            f"covariates: {quote(given)} changes within the subject {quote(subject)}",
            term=given,
            remedy="give one number a subject; what changes in time belongs in the problem",
        )
    return float(own[0])


def _check_varied(given: object, x: Array) -> None:
    """Raise an OptionError for a covariate that is the same for all subjects."""
    if x.size > 1 and np.ptp(x) <= NEGLIGIBLE * max(float(np.abs(x).max()), TINY):
        raise OptionError(
            f"covariates: {quote(given)} is {x[0]:g} for all {count(x.size, 'subject')}",
            term=given,
            remedy="leave it out: the mean has its effect",
        )


# -----------------------------------------------------------------------------
# The population parameters in a row: means, effects of covariates, random effects, noise.
#
# Subject i has the parameters x = g(z), and its coordinates are z = mu + X_i beta + eta with the
# random effects eta ~ N(0, Omega).


@dataclass(frozen=True)
class Effect:
    """The effect of a covariate: ``x`` (n,) for each subject, on the parameter at ``position``.

    A coefficient that is ``held`` is not estimated.
    """

    name: str
    position: int
    x: Array
    held: float | None = None


@dataclass(frozen=True)
class Layout:
    """What a row of population parameters psi (P,) means.

    It has the means mu of the ``names`` (E), the coefficients of the ``effects`` (C), the entries
    of the Cholesky factor L of Omega, with logarithms on its diagonal, and the logarithms of the
    ``levels`` of noise; ``zero_levels`` are zero. ``random`` are the positions (q,) of the random
    parameters, ``groups`` which of those correlate, as positions among them.
    """

    names: tuple[str, ...]
    scales: tuple[Scale, ...]
    random: tuple[int, ...]
    covariates: tuple[Effect, ...]
    groups: tuple[tuple[int, ...], ...]
    levels: tuple[str, ...]
    subjects: int
    zero_levels: tuple[str, ...] = ()

    @cached_property
    def effects(self) -> tuple[Effect, ...]:
        """The effects of covariates whose coefficients are estimated."""
        return tuple(effect for effect in self.covariates if effect.held is None)

    @cached_property
    def entries(self) -> tuple[tuple[int, int], ...]:
        """Rows and columns of the entries of L: the diagonal, then what is below it."""
        q = len(self.random)
        below = [(i, j) for group in self.groups for i in group for j in group if j < i]
        return (*((i, i) for i in range(q)), *sorted(below))

    @property
    def means(self) -> slice:
        """The means and the coefficients of covariates: what shifts subjects."""
        return slice(0, len(self.names) + len(self.effects))

    @property
    def factors(self) -> slice:
        """The entries of L."""
        begin = self.means.stop
        return slice(begin, begin + len(self.entries))

    @property
    def noise(self) -> slice:
        """The levels of noise."""
        begin = self.factors.stop
        return slice(begin, begin + len(self.levels))

    @property
    def spreads(self) -> slice:
        """All that is no mean: L and the levels of noise."""
        return slice(self.means.stop, self.size)

    @property
    def size(self) -> int:
        """Number of population parameters."""
        return len(self.names) + len(self.effects) + len(self.entries) + len(self.levels)

    @cached_property
    def designs(self) -> Array:
        """Derivatives (n, E, E + C) of the coordinates of subjects with respect to the means."""
        designs = np.zeros((self.subjects, len(self.names), self.means.stop))
        designs[:, range(len(self.names)), range(len(self.names))] = 1.0
        for c, effect in enumerate(self.effects):
            designs[:, effect.position, len(self.names) + c] = effect.x
        return designs

    @cached_property
    def offsets(self) -> Array:
        """What held coefficients add to the coordinates of each subject, (n, E)."""
        offsets = np.zeros((self.subjects, len(self.names)))
        for effect in self.covariates:
            offsets[:, effect.position] += (effect.held or 0.0) * effect.x
        return offsets

    def selected(self, which: NDArray[np.intp]) -> Layout:
        """The layout for some of the subjects."""
        effects = tuple(replace(effect, x=effect.x[which]) for effect in self.covariates)
        return replace(self, covariates=effects, subjects=which.size)

    def typical(self, psi: Array) -> Array:
        """Coordinates (K, n, E) of subjects without random effects at psi (K, P)."""
        shifts = np.einsum("nep,kp->kne", self.designs, psi[:, self.means])
        return np.asarray(shifts + self.offsets)

    def cholesky(self, psi: Array) -> Array:
        """L (K, q, q) at psi (K, P)."""
        q = len(self.random)
        factor = np.zeros((len(psi), q, q))
        for column, (i, j) in zip(psi[:, self.factors].T, self.entries, strict=True):
            factor[:, i, j] = np.exp(column) if i == j else column
        return factor

    def covariance(self, psi: Array) -> Array:
        """Omega (q, q) at psi (P,)."""
        factor = self.cholesky(psi[None])[0]
        return np.asarray(factor @ factor.T)

    def factored(self, omega: Array) -> Array:
        """The entries of psi for an Omega (q, q); what does not correlate is left out."""
        kept = np.eye(len(omega), dtype=bool)
        for group in self.groups:
            kept[np.ix_(group, group)] = True
        factor = np.linalg.cholesky(np.where(kept, omega, 0.0))
        entries = [np.log(factor[i, i]) if i == j else factor[i, j] for i, j in self.entries]
        return np.array(entries)

    def values(self, coordinates: Array) -> Array:
        """Parameters (..., E) at coordinates (..., E)."""
        columns = [scale.value(coordinates[..., e]) for e, scale in enumerate(self.scales)]
        return np.stack(columns, axis=-1)

    def slopes(self, values: Array) -> Array:
        """Derivatives (..., E) of parameters with respect to their coordinates."""
        columns = [scale.slope(values[..., e]) for e, scale in enumerate(self.scales)]
        return np.stack(columns, axis=-1)

    def coordinates(self, values: Array) -> Array:
        """Coordinates (..., E) of parameters (..., E)."""
        columns = [scale.coordinate(values[..., e]) for e, scale in enumerate(self.scales)]
        return np.stack(columns, axis=-1)


def correlated_groups(groups: Sequence[Sequence[int]], q: int) -> tuple[tuple[int, ...], ...]:
    """Groups of positions that cover all q, those that are in none alone."""
    inside = {position for group in groups for position in group}
    alone = [(i,) for i in range(q) if i not in inside]
    return tuple(sorted([*(tuple(sorted(group)) for group in groups), *alone]))
