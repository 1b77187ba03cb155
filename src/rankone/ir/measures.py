"""Intervals with a scale: a parameter that is uniform in its logarithm or its reciprocal.

``(1e-3, 10, "log")`` means the measure: decades are equally likely. It travels as the text of the
distribution of scipy.stats that says the same, and its word is the scale of the coordinate.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

import numpy as np

from rankone.discretization.scales import SCALES, Identity, Logarithm, Reciprocal, Scale
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import did_you_mean, quote, shown

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
