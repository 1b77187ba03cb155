"""Estimated parameters as coordinates of the unit cube between their bounds, on their scales."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rankone.calibration.parameters import Parameter
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import listing


@dataclass(frozen=True, eq=False)
class Cube:
    """Parameters, and both ends (n,) of their coordinates."""

    parameters: tuple[Parameter, ...]
    lower: Array
    upper: Array

    @classmethod
    def of(cls, parameters: Sequence[Parameter]) -> Cube:
        """An OptionError if there is none, or bounds are not finite on their scale."""
        if not parameters:
            raise OptionError("no parameter of the table is estimated", remedy="set estimate to 1")
        ends = np.array([[p.scaled(p.lower), p.scaled(p.upper)] for p in parameters]).T
        endless = [
            p.name for p, e in zip(parameters, ends.T, strict=True) if not np.isfinite(e).all()
        ]
        if endless:
            raise OptionError(
                f"{listing(endless)} have no finite bounds on their scale",
                term=endless[0],
                remedy="give positive bounds, or the scale `lin`",
            )
        return cls(tuple(parameters), ends[0], ends[1])

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The parameters."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def width(self) -> Array:
        """Widths (n,) of the bounds on the scales."""
        return self.upper - self.lower

    def some(self, names: Sequence[str]) -> Cube:
        """The cube of some of the parameters."""
        which = [self.names.index(name) for name in names]
        return Cube(tuple(self.parameters[j] for j in which), self.lower[which], self.upper[which])

    def named(self, z: Array) -> dict[str, float]:
        """Values at z (n,)."""
        pairs = zip(self.parameters, (self.lower + self.width * z).tolist(), strict=True)
        return {p.name: min(max(p.value(coordinate), p.lower), p.upper) for p, coordinate in pairs}

    def places(self, values: Mapping[str, float]) -> Array:
        """The place z (n,) of values, or the nearest one in the cube."""
        scaled = np.array([p.scaled(values[p.name]) for p in self.parameters])
        width = np.where(self.width > 0.0, self.width, 1.0)
        return np.clip(np.nan_to_num((scaled - self.lower) / width), 0.0, 1.0)

    def slopes(self, values: Mapping[str, float]) -> Array:
        """Derivatives (n,) of values by z."""
        return np.array([p.slope(values[p.name]) for p in self.parameters]) * self.width

    def prior_rows(self, values: Mapping[str, float]) -> tuple[float, Array, Array]:
        """What q priors add: costs in all, pseudo-residuals (q,), their Jacobian (q, n) by z."""
        each = [parameter.prior_terms(values[parameter.name]) for parameter in self.parameters]
        bent = [j for j, prior in enumerate(each) if prior.slope]
        rows = np.zeros((len(bent), len(each)))
        rows[range(len(bent)), bent] = [each[j].slope * self.width[j] for j in bent]
        residuals = np.array([each[j].residual for j in bent])
        return sum(prior.cost for prior in each), residuals, rows
