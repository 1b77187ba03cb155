"""Scales of a parameter, and the intervals that have one.

Every scale ascends, so that intervals, elements and nodes keep their order. A parameter over
decades is smooth in its logarithm, and one that divides in its reciprocal.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.precision import EPSILON
from rankone.support.wording import did_you_mean, quote, shown

__all__ = [
    "IDENTITY",
    "SCALES",
    "Identity",
    "Logarithm",
    "Reciprocal",
    "Scale",
    "first_scale",
]

# Ratio of the ends of an interval above which its decades are all looked at: its logarithm is the
# first coordinate, and another one has to be better
_DECADES_RATIO = 10.0

_MOST_SLOPE_MODES = 200  # Modes looked at for the slope of a scale: it is analytic on an interval
_NOISE_MODES = 20  # Highest modes, which show the rounding errors of the others
_NOISE_FACTOR = 8.0  # Size of the modes that are left out, over these rounding errors


@dataclass(frozen=True)
class Scale(ABC):
    """A smooth, ascending coordinate s = g(x) of a parameter x."""

    kind: ClassVar[str]

    @abstractmethod
    def to_scale(self, x: Array) -> Array:
        """The coordinate s = g(x), of the shape of x."""

    @abstractmethod
    def from_scale(self, s: Array) -> Array:
        """The parameter x at coordinates s, of their shape."""

    @abstractmethod
    def slope(self, x: Array) -> Array:
        """The derivative ds/dx at x, positive, of the shape of x."""

    def allows(self, lower: float, upper: float) -> bool:
        """Whether the coordinate is finite on the whole interval."""
        return lower < upper

    @property
    def is_identity(self) -> bool:
        return False

    def slope_modes(self, lower: float, upper: float, inverse: bool = False) -> int:
        """Number of modes in s on an interval that the slope ds/dx needs, to rounding.

        ``inverse`` stands for dx/ds, the density of x over s.
        """
        if self.is_identity:
            return 1
        start, end = self.to_scale(np.array([lower, upper]))
        angles = np.pi * (np.arange(_MOST_SLOPE_MODES) + 0.5) / _MOST_SLOPE_MODES
        slopes = self.slope(self.from_scale(start + 0.5 * (end - start) * (1.0 + np.cos(angles))))
        modes = np.cos(np.arange(_MOST_SLOPE_MODES)[:, None] * angles)
        spectrum = np.abs(modes @ (1.0 / slopes if inverse else slopes))
        noise = _NOISE_FACTOR * spectrum[-_NOISE_MODES:].max()
        significant = spectrum > max(4.0 * EPSILON * spectrum.max(), noise)
        return int(np.flatnonzero(significant)[-1]) + 1


@dataclass(frozen=True)
class Identity(Scale):
    """The parameter itself."""

    kind = "linear"

    def to_scale(self, x: Array) -> Array:
        return x

    def from_scale(self, s: Array) -> Array:
        return s

    def slope(self, x: Array) -> Array:
        return np.ones_like(x)

    @property
    def is_identity(self) -> bool:
        return True


@dataclass(frozen=True)
class Logarithm(Scale):
    """The natural logarithm of a positive parameter."""

    kind = "log"

    def to_scale(self, x: Array) -> Array:
        return np.asarray(np.log(x))

    def from_scale(self, s: Array) -> Array:
        return np.asarray(np.exp(s))

    def slope(self, x: Array) -> Array:
        return 1.0 / x

    def allows(self, lower: float, upper: float) -> bool:
        return 0.0 < lower < upper


@dataclass(frozen=True)
class Reciprocal(Scale):
    """Minus one over a parameter that does not change its sign: the minus makes it ascend."""

    kind = "reciprocal"

    def to_scale(self, x: Array) -> Array:
        return -1.0 / x

    def from_scale(self, s: Array) -> Array:
        return -1.0 / s

    def slope(self, x: Array) -> Array:
        return 1.0 / (x * x)

    def allows(self, lower: float, upper: float) -> bool:
        return 0.0 < lower < upper or lower < upper < 0.0


IDENTITY = Identity()
SCALES: dict[str, Scale] = {each.kind: each for each in (IDENTITY, Logarithm(), Reciprocal())}
"""The scales by the words that users write."""


def first_scale(lower: float, upper: float) -> Scale:
    """The coordinate in which a parameter is looked at before anything else is known of it."""
    decades = lower > 0.0 and upper > _DECADES_RATIO * lower
    return Logarithm() if decades else IDENTITY


# -----------------------------------------------------------------------------
# Intervals with a scale: a parameter that is uniform in its logarithm or its reciprocal.
#
# ``(1e-3, 10, "log")`` means the measure: decades are equally likely. It travels as the text of the
# distribution of scipy.stats that says the same, and its word is the scale of the coordinate.


LINEAR, LOG, RECIPROCAL = Identity.kind, Logarithm.kind, Reciprocal.kind

Interval = tuple[float, float]

# Distributions as `measure_text` writes them
_WRITTEN = {
    LOG: re.compile(r"loguniform\([^,=()]+, [^,=()]+\)"),
    RECIPROCAL: re.compile(r"truncpareto\(1\.0, [^,=()]+, 0\.0, [^,=()]+\)"),
}


def split(bounds: object) -> tuple[object, str | None]:
    """The bounds of an interval as a user writes it, and the word of a scale at its end."""
    if isinstance(bounds, tuple | list) and len(bounds) == 3 and isinstance(bounds[2], str):
        return bounds[:2], bounds[2]
    return bounds, None


def check_scale(parameter: str, interval: Interval, word: str) -> str:
    """The word of a scale that an interval can have; an OptionError otherwise."""
    lower, upper = interval
    subject = f"the scale of parameter {quote(parameter)}"
    if word not in SCALES:
        raise OptionError(
            f"{subject} is {shown(word)}{did_you_mean(word, SCALES)}",
            term=word,
            remedy=f"write {LINEAR!r}, {LOG!r} or {RECIPROCAL!r}",
        )
    if word != LINEAR and lower <= 0.0:
        raise OptionError(
            f"{subject} is {word!r}, but its interval ({lower:g}, {upper:g}) is not above zero",
            term=word,
            remedy="let it begin above zero, or leave the scale out",
        )
    return word


def measure_text(word: str, interval: Interval) -> str | None:
    """The distribution that is uniform in a scale, as text of scipy.stats; None if it is plain.

    The density of a uniform logarithm is 1/x, that of a uniform reciprocal 1/x^2.
    """
    lower, upper = map(float, interval)
    if word == LOG:
        return f"loguniform({lower!r}, {upper!r})"
    if word == RECIPROCAL:
        return f"truncpareto(1.0, {upper / lower!r}, 0.0, {lower!r})"
    return None


def written_scale(text: str | None) -> str | None:
    """The word for the measure that a text names; None for another distribution or no text."""
    words = (word for word, form in _WRITTEN.items() if text and form.fullmatch(text))
    return next(words, None)


def with_measure(text: str, distribution: str | None) -> str:
    """``k in [1, 2]`` with its scale behind it, or with its distribution."""
    if not distribution:
        return text
    word = written_scale(distribution)
    return f"{text} ({word})" if word else f"{text} ~ {distribution}"


def moved_measures(
    distributions: Iterable[tuple[str, str]],
    intervals: Mapping[str, Interval],
    words: Mapping[str, str],
) -> tuple[tuple[str, str], ...]:
    """Distributions by parameter after a move to other intervals, some with a word of their own.

    A scale stays on another interval above zero, and is dropped on one that is not; other
    distributions stay as they are, to be cut.
    """
    texts = dict(distributions)
    moved: list[tuple[str, str]] = []
    for name, interval in intervals.items():
        text = texts.get(name)
        word = words.get(name, written_scale(text))
        if word is not None:
            text = measure_text(word if interval[0] > 0.0 else LINEAR, interval)
        if text is not None:
            moved.append((name, text))
    return tuple(moved)


def evenly_on_scale(scale: Scale, interval: Interval, count: int) -> Array:
    """Values (count,) that are evenly spaced on a scale, both ends included."""
    if scale.is_identity:
        return np.linspace(*interval, count)
    return on_scale(scale, interval, np.linspace(0.0, 1.0, count))


def on_scale(scale: Scale, interval: Interval, shares: Array) -> Array:
    """Values at shares in [0, 1] of an interval in the coordinate of a scale, ends included."""
    lower, upper = interval
    if scale.is_identity:
        return np.asarray(lower + (upper - lower) * shares)
    first, last = scale.to_scale(np.array(interval, dtype=float))
    points = np.clip(scale.from_scale(first + (last - first) * shares), lower, upper)
    return np.asarray(np.where(shares == 1.0, upper, np.where(shares == 0.0, lower, points)))
