"""Distributions of scipy.stats: what is one, its interval, and as text.

The text, such as ``norm(1.0, 0.1)`` or ``gamma(2.0, scale=0.5)``, is what a Python reader would
write; it is read as a name and numbers, and nothing is executed.
"""

from __future__ import annotations

import ast
import math
from typing import Any

import numpy as np
import scipy.stats

from rankone.support.errors import OptionError
from rankone.support.wording import did_you_mean, quote

__all__ = ["as_text", "from_text", "interval_of", "is_frozen"]

_EXAMPLE = "give one of scipy.stats, for example scipy.stats.norm(1, 0.1)"


def is_frozen(distribution: Any) -> bool:
    """Whether this is one continuous distribution with all its parameters."""
    methods = all(hasattr(distribution, name) for name in ("pdf", "cdf", "sf", "ppf", "isf"))
    generic = isinstance(distribution, scipy.stats.rv_continuous)
    if not methods or (generic and not isinstance(distribution, scipy.stats.rv_histogram)):
        return False
    return np.ndim(distribution.ppf(0.5)) == 0


def interval_of(distribution: Any, tail: float) -> tuple[float, float]:
    """The support; where that has no end, from one quantile to another.

    Parameters
    ----------
    distribution : frozen continuous distribution
    tail : float
        The probability that is left out on either side of an unbounded support.

    Raises
    ------
    OptionError
        If the mean or the variance is not finite: where it is cut would decide about all moments.
    """
    moments = float(distribution.mean()), float(distribution.var())
    if not all(map(math.isfinite, moments)):
        raise OptionError(
            f"{quote(_shown(distribution))} has no finite mean and variance: where it is cut would "
            "decide about all statistics",
            term=distribution,
            remedy="give one with finite moments, or one that is cut, such as "
            "scipy.stats.truncnorm",
        )
    lower, upper = map(float, distribution.support())
    if math.isfinite(lower) and math.isfinite(upper):
        return lower, upper
    return float(distribution.ppf(tail)), float(distribution.isf(tail))


def as_text(distribution: Any) -> str:
    """A frozen distribution of scipy.stats as text.

    Raises
    ------
    OptionError
        If it is none with a name there.
    """
    family = getattr(distribution, "dist", None)
    name = getattr(family, "name", None)
    if not is_frozen(distribution) or not isinstance(family, scipy.stats.rv_continuous):
        raise OptionError(
            f"{distribution!r} is not a frozen continuous distribution",
            term=distribution,
            remedy=_EXAMPLE,
        )
    if type(family) is not type(getattr(scipy.stats, str(name), None)):
        raise OptionError(
            f"the distribution {quote(name)} is none that scipy.stats knows by name",
            term=distribution,
            remedy="give an interval, and the distribution with under={...} in the statistics",
        )
    return _shown(distribution)


def from_text(text: str) -> Any:
    """The frozen distribution of scipy.stats that a text stands for.

    Raises
    ------
    OptionError
        If it is no name of one with numbers.
    """
    try:
        name, numbers, named = _parsed(text)
    except (SyntaxError, ValueError, TypeError, RecursionError, MemoryError):
        raise OptionError(
            f"{quote(text)} is not the name of a distribution with numbers",
            term=text,
            remedy="write it like norm(1, 0.1), as in scipy.stats",
        ) from None
    family = getattr(scipy.stats, name, None)
    if not isinstance(family, scipy.stats.rv_continuous):
        raise OptionError(
            f"scipy.stats has no continuous distribution {quote(name)}"
            f"{did_you_mean(name, _names())}",
            term=text,
        )
    try:
        distribution = family(*numbers, **named)
        middle = float(distribution.ppf(0.5))
    except TypeError as error:
        raise OptionError(f"{quote(text)}: {error}", term=text) from None
    if not math.isfinite(middle):
        raise OptionError(
            f"{quote(text)} is not defined for these numbers",
            term=text,
            remedy=f"see scipy.stats.{name} for what they may be",
        )
    return distribution


def _names() -> list[str]:
    """Names of the continuous distributions."""
    found = vars(scipy.stats).items()
    return [name for name, value in found if isinstance(value, scipy.stats.rv_continuous)]


def _shown(distribution: Any) -> str:
    """Name and numbers, as far as they are known."""
    name = getattr(getattr(distribution, "dist", None), "name", None)
    if name is None:
        return repr(distribution)
    numbers = [repr(float(value)) for value in distribution.args]
    named = [f"{key}={float(value)!r}" for key, value in distribution.kwds.items()]
    return f"{name}({', '.join([*numbers, *named])})"


def _parsed(text: str) -> tuple[str, list[float], dict[str, float]]:
    """Name, numbers and named numbers."""
    call = ast.parse(text.strip(), mode="eval").body
    if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name):
        raise ValueError(text)
    numbers = [_number(value) for value in call.args]
    named = {str(item.arg): _number(item.value) for item in call.keywords if item.arg}
    if len(named) < len(call.keywords):
        raise ValueError(text)
    return call.func.id, numbers, named


def _number(node: ast.expr) -> float:
    value = ast.literal_eval(node)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(value)
    return float(value)
