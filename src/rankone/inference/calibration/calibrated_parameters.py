"""Parameters of a calibration problem, and the checked records of its tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import scipy

from rankone.inference.estimation.formulas import Formula
from rankone.problem.models.model import Model
from rankone.support.arrays import Array

Assigned: TypeAlias = "float | str"
"""A number, or the name of a parameter."""


@dataclass(frozen=True)
class Condition:
    """What a condition gives ids of the model; None where it leaves them as they are."""

    name: str
    assigned: Mapping[str, Assigned | None]


@dataclass(frozen=True)
class SimulatedExperiment:
    """A condition that is simulated, and the one whose steady state it starts at, if there is one.

    What was measured is in :class:`Series`.
    """

    condition: Condition
    before: Condition | None

    @property
    def name(self) -> str:
        """``before -> condition``, or the condition alone."""
        name = self.condition.name
        return name if self.before is None else f"{self.before.name} -> {name}"


@dataclass(frozen=True)
class Observable:
    """An observable: its formula, and the distribution of its noise.

    ``transformation`` is that of the measurements whose noise is normal or of Laplace's
    distribution; the noise formula gives the standard deviation or the scale of it.
    """

    name: str
    formula: Formula
    noise: Formula
    transformation: str
    distribution: str


@dataclass(frozen=True, eq=False)
class Series:
    """The m measurements of one observable, over all experiments.

    ``rows`` are their places in the table, ``experiments`` (m,) the positions of their experiments,
    ``times`` (m,) may be infinite. ``placeholders`` give m numbers or parameters by name.
    """

    observable: Observable
    rows: Sequence[int]
    experiments: Array
    times: Array
    measurements: Array
    placeholders: Mapping[str, Sequence[Assigned]]


@dataclass(frozen=True, eq=False)
class Records:
    """A calibration problem as its files have it.

    ``starts`` has the parameter of the model by which each id is set that conditions or the table
    of parameters may set.
    """

    name: str
    model: Model
    starts: Mapping[str, str]
    parameters: tuple[Parameter, ...]
    experiments: tuple[SimulatedExperiment, ...]
    series: tuple[Series, ...]

    @property
    def last_time(self) -> float:
        """The last finite time of a measurement; 0 without any."""
        times = np.concatenate([series.times for series in self.series])
        return float(np.max(times[np.isfinite(times)], initial=0.0))


# -----------------------------------------------------------------------------
# Parameters of a calibration problem: their scales, bounds and priors.


_LOG10 = math.log(10.0)
SCALES = ("lin", "log", "log10")
"""The coordinates in which a parameter may be estimated."""


@dataclass(frozen=True)
class Prior:
    """A prior density of a parameter, in one coordinate of it.

    Attributes
    ----------
    shape : {"uniform", "normal", "laplace"}
    scale : {"lin", "log", "log10"}
        The coordinate z in which the density has this shape.
    location, width : float
        Mean and standard deviation of a normal density, centre and scale of a Laplace density,
        both ends of a uniform one.
    of_value : bool
        Whether it is a density of the value, as a log-normal one is, and not of z.
    """

    shape: str
    scale: str
    location: float
    width: float
    of_value: bool

    def distribution(self) -> Any:
        """The prior as a frozen distribution of scipy.stats over the value."""
        unit = {"lin": 0.0, "log": 1.0, "log10": _LOG10}[self.scale]
        first, second = unit * self.location, unit * self.width
        match self.shape, unit:
            case "uniform", 0.0:
                return scipy.stats.uniform(self.location, self.width - self.location)
            case "normal", 0.0:
                return scipy.stats.norm(self.location, self.width)
            case "laplace", 0.0:
                return scipy.stats.laplace(self.location, self.width)
            case "uniform", _:
                return scipy.stats.loguniform(math.exp(first), math.exp(second))
            case "normal", _:
                return scipy.stats.lognorm(second, scale=math.exp(first))
        return scipy.stats.loglaplace(1.0 / second, scale=math.exp(first))

    def penalty(self) -> Any:
        """A distribution over the value whose density is what the objective has, up to a factor.

        It is that of :meth:`distribution` where the prior is one of the value. Where it is one of
        the logarithm z, its density is a function of z: a log-normal density with a mean of z that
        is larger by the variance is proportional to it. None if there is no such distribution.
        """
        if self.of_value or self.scale == "lin":
            return self.distribution()
        unit = 1.0 if self.scale == "log" else _LOG10
        first, second = unit * self.location, unit * self.width
        if self.shape == "uniform":
            lower, upper = math.exp(first), math.exp(second)
            return scipy.stats.uniform(lower, upper - lower)
        if self.shape == "normal":
            return scipy.stats.lognorm(second, scale=math.exp(first + second**2))
        return None

    def logpdf(self, values: Array) -> Array:
        """What the objective subtracts at values (...)."""
        costs = [self.cost(value)[0] for value in values.ravel().tolist()]
        return -np.reshape(costs, values.shape)

    def cost(self, value: float) -> tuple[float, float]:
        """Minus the logarithm of the density at a value, and its derivative by the value."""
        z = scaled(value, self.scale)
        if not math.isfinite(z):
            return math.inf, 0.0
        slope = 1.0 / slope_of_scale(value, self.scale)
        if self.shape == "uniform":
            inside = self.location <= z <= self.width
            return (math.log(self.width - self.location) if inside else math.inf), 0.0
        away = (z - self.location) / self.width
        if self.shape == "normal":
            cost = 0.5 * away**2 + math.log(self.width * math.sqrt(2.0 * math.pi))
            gradient = away / self.width * slope
        else:
            cost = abs(away) + math.log(2.0 * self.width)
            gradient = math.copysign(1.0, away) / self.width * slope
        if self.of_value and self.scale != "lin":
            cost, gradient = cost - math.log(slope), gradient + 1.0 / value
        return cost, gradient


@dataclass(frozen=True)
class Parameter:
    """A parameter of a calibration problem; all numbers are values, and not on its scale.

    Attributes
    ----------
    name : str
    scale : {"lin", "log", "log10"}
        The coordinate in which it is estimated.
    lower, upper : float
        Bounds; NaN where a parameter that is not estimated has none.
    nominal : float
        The value of the file; NaN if it has none.
    estimated : bool
    prior : Prior or None
        What the objective adds for it.
    """

    name: str
    scale: str
    lower: float
    upper: float
    nominal: float
    estimated: bool
    prior: Prior | None = None

    def scaled(self, value: float) -> float:
        """The coordinate of a value: itself, its logarithm, or that to base 10."""
        return scaled(value, self.scale)

    def value(self, coordinate: float) -> float:
        """The value at a coordinate."""
        if self.scale == "lin":
            return coordinate
        return math.exp(coordinate) if self.scale == "log" else 10.0**coordinate

    def slope(self, value: float) -> float:
        """The derivative of the value by its coordinate."""
        return slope_of_scale(value, self.scale)

    @property
    def width(self) -> float:
        """Width of the bounds in the coordinate."""
        return self.scaled(self.upper) - self.scaled(self.lower)

    @property
    def distribution(self) -> Prior | None:
        """Its prior, unless that is the same everywhere; see :class:`~.likelihood.Prior`."""
        return None if self.prior is None or self.prior.shape == "uniform" else self.prior


def scaled(value: float, scale: str) -> float:
    """The coordinate of a value on a scale; minus infinity or NaN where it has none."""
    if scale == "lin":
        return value
    if value <= 0.0:
        return -math.inf if value == 0.0 else math.nan
    return math.log(value) if scale == "log" else math.log10(value)


def slope_of_scale(value: float, scale: str) -> float:
    """The derivative of a value by its coordinate on a scale."""
    return {"lin": 1.0, "log": value, "log10": value * _LOG10}[scale]


def parameter_rows(parameters: Sequence[Parameter]) -> list[list[str]]:
    """Cells of a table: name, scale, bounds, nominal value, and whether it is estimated."""
    return [
        [p.name, p.scale, f"{p.lower:g}", f"{p.upper:g}", f"{p.nominal:.6g}",
         "yes" if p.estimated else "no"]
        for p in parameters
    ]  # fmt: skip
