"""Quantities of parameters, with derivatives: functions of a dictionary, text, or symbols."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import numpy as np

from rankone.estimation.duals import Dual, slope_of
from rankone.estimation.formulas import Formula, formula_of
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import did_you_mean, listing, quote

# Step of differences, in shares of the interval of a parameter: truncation near rounding
_STEP_SHARE = 1e-5


class Quantity(Protocol):
    """A number that depends on parameters."""

    def value(self, point: Mapping[str, float]) -> float:
        """The number at a point."""

    def gradient(self, point: Mapping[str, float], widths: Mapping[str, float]) -> Array:
        """Derivatives (n,) with respect to the parameters of ``widths``.

        ``widths`` are the lengths of their intervals.
        """


class _OfFormula:
    def __init__(self, formula: Formula) -> None:
        self.formula = formula

    def value(self, point: Mapping[str, float]) -> float:
        with np.errstate(all="ignore"):
            return float(self.formula({name: np.float64(x) for name, x in point.items()}))

    def gradient(self, point: Mapping[str, float], widths: Mapping[str, float]) -> Array:
        seeds = dict(zip(widths, np.eye(len(widths)), strict=True))
        at = {
            name: Dual(np.array(x), seeds[name]) if name in seeds else x
            for name, x in point.items()
        }
        with np.errstate(all="ignore"):
            return slope_of(self.formula(at), len(widths))


class _OfFunction:
    def __init__(self, function: Callable[[dict[str, float]], float]) -> None:
        self.function = function

    def value(self, point: Mapping[str, float]) -> float:
        return float(self.function(dict(point)))

    def gradient(self, point: Mapping[str, float], widths: Mapping[str, float]) -> Array:
        """By central differences of fourth order."""
        slopes = []
        for name, width in widths.items():
            h = _STEP_SHARE * width

            def at(shift: float, name: str = name) -> float:
                return self.value({**point, name: point[name] + shift})

            near, far = at(h) - at(-h), at(2.0 * h) - at(-2.0 * h)
            slopes.append((8.0 * near - far) / (12.0 * h))
        return np.array(slopes)


def quantity(given: object, names: Sequence[str]) -> Quantity:
    """A quantity of the parameters by name, from a function, text or an expression."""
    symbolic = hasattr(given, "free_symbols")
    if isinstance(given, str) or symbolic:
        formula = formula_of(given)
        for name in sorted(formula.names):
            if name not in names:
                raise OptionError(
                    f"{quote(given)}: there is no parameter {quote(name)}"
                    f"{did_you_mean(name, names)}",
                    term=given,
                    remedy=f"known are {listing(names)}",
                )
        return _OfFormula(formula)
    if callable(given):
        return _OfFunction(given)
    raise OptionError(
        f"{given!r} is not a quantity of the parameters",
        term=given,
        remedy="give text, an expression of the parameters, or a function of a dictionary",
    )
