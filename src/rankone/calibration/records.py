"""What the tables of a calibration problem say, checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from rankone.calibration.parameters import Parameter
from rankone.estimation.formulas import Formula
from rankone.models.model import Model
from rankone.support.arrays import Array

Assigned: TypeAlias = "float | str"
"""A number, or the name of a parameter."""


@dataclass(frozen=True)
class Condition:
    """What a condition gives ids of the model; None where it leaves them as they are."""

    name: str
    assigned: Mapping[str, Assigned | None]


@dataclass(frozen=True)
class Experiment:
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
    experiments: tuple[Experiment, ...]
    series: tuple[Series, ...]

    @property
    def last_time(self) -> float:
        """The last finite time of a measurement; 0 without any."""
        times = np.concatenate([series.times for series in self.series])
        return float(np.max(times[np.isfinite(times)], initial=0.0))
