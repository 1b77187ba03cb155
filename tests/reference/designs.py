"""Twelve experiments whose printed intervals are counted: models, truths, boxes and data sets.

Curves are closed forms and data have fixed seeds, so nothing here takes anything of rankone. Six
designs are poorly identified. What the data say of a parameter follows from the expected
information F = J^T J / sigma^2 at the truth, where J holds the derivatives of the curve by
coordinates in widths of the box (of the logarithm for boxes over decades):

- marginal deviation: the root of the diagonal of (F + 12 I)^-1. The variance of a uniform
  distribution over the box is 1/12 of its squared width;
- reach of an end of the box: the root of the least sum of squares between the curve at the truth
  and curves in the box with the parameter at that end, in standard deviations;
- undetermined: the marginal deviation is above half of that of the box, sqrt(1/12)/2, or both ends
  are within a reach of 1.96;
- limited: determined, but with the help of the box, so an interval may cover more than it says. The
  box takes more than a tenth of the deviation that F alone gives, or an end of the box of the
  parameter, or of one that is correlated with it by more than 0.3, is within a reach of 4;
- determined: all others.

Of no parameter is the marginal deviation within a tenth of the limit. Three more designs, of wide
bounds, are for calibrations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.special

SETS = 400
UNDETERMINED = 0.5 * np.sqrt(1.0 / 12.0)  # Marginal deviation in widths of the box
HELPED = 0.9  # Ratio of deviations with and without the box below which the box limits
CORRELATED = 0.3
CLOSE, NEAR = 1.96, 4.0  # Reaches of an end of the box
_STEP = 1e-5  # Of central differences, in widths of the box

Array = np.ndarray[Any, np.dtype[np.float64]]


@dataclass(frozen=True, eq=False)
class Design:
    """A model, what is measured of it, and the noise.

    ``curve(t, **parameters)`` is the closed form of ``observed``. Data set k is the curve at the
    ``truth`` plus ``sigma`` times normal numbers of the seed (``seed``, k). ``told`` says whether a
    fit is given sigma.
    """

    name: str
    rates: Mapping[str, str]
    initial: Mapping[str, str]
    box: Mapping[str, tuple[Any, ...]]
    truth: Mapping[str, float]
    times: Array
    observed: str
    sigma: float
    seed: int
    curve: Callable[..., Array]
    poor: bool = False
    told: bool = True
    rtol: float = 1e-6

    @property
    def end(self) -> float:
        """The end of the horizon, which starts at 0."""
        return float(self.times[-1])

    def data(self, k: int) -> Array:
        """Data set k."""
        noise = np.random.default_rng([self.seed, k]).standard_normal(self.times.size)
        return np.asarray(self.curve(self.times, **self.truth) + self.sigma * noise)

    def place(self, name: str, x: float) -> float:
        """The coordinate of a value of a parameter: 0 to 1 over its box."""
        low, high, *log = self.box[name]
        if log:
            return float(np.log(x / low) / np.log(high / low))
        return float((x - low) / (high - low))

    def value(self, name: str, z: float) -> float:
        """The value of a parameter at a coordinate."""
        low, high, *log = self.box[name]
        return float(low * (high / low) ** z if log else low + z * (high - low))

    @cached_property
    def information(self) -> Array:
        """The expected information (n, n) at the truth, in widths of the box."""
        columns = []
        for name in self.box:
            z = self.place(name, self.truth[name])
            moved = [
                self.curve(self.times, **{**self.truth, name: self.value(name, z + step)})
                for step in (_STEP, -_STEP)
            ]
            columns.append((moved[0] - moved[1]) / (2.0 * _STEP * self.sigma))
        jacobian = np.stack(columns, axis=1)
        return np.asarray(jacobian.T @ jacobian)

    @cached_property
    def covariance(self) -> Array:
        """Marginal covariance (n, n) with the box."""
        return np.asarray(np.linalg.inv(self.information + 12.0 * np.eye(len(self.box))))

    @cached_property
    def marginal(self) -> dict[str, float]:
        """Marginal deviation of each parameter with the box, in its widths."""
        return dict(zip(self.box, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @cached_property
    def alone(self) -> dict[str, float]:
        """The same of the data alone; 1e3 stands for the box of a direction without information."""
        free = np.linalg.inv(self.information + 1e-6 * np.eye(len(self.box)))
        return dict(zip(self.box, np.sqrt(np.diag(free)).tolist(), strict=True))

    @cached_property
    def conditional(self) -> dict[str, float]:
        """The same with the undetermined parameters held at the truth."""
        held = [name for name in self.box if self.says(name) == "undetermined"]
        free = [j for j, name in enumerate(self.box) if name not in held]
        inner = self.information[np.ix_(free, free)] + 12.0 * np.eye(len(free))
        deviations = np.sqrt(np.diag(np.linalg.inv(inner)))
        names = [name for name in self.box if name not in held]
        return dict(zip(names, deviations.tolist(), strict=True))

    def says(self, name: str) -> str:
        """What the data say of a parameter: determined, limited or undetermined."""
        if self.marginal[name] > UNDETERMINED or max(self.reaches[name]) < CLOSE:
            return "undetermined"
        names, j = list(self.box), list(self.box).index(name)
        scale = np.sqrt(np.diag(self.covariance))
        correlations = np.abs(self.covariance[j] / scale / scale[j])
        partners = [other for other, c in zip(names, correlations, strict=True) if c > CORRELATED]
        near = any(min(self.reaches[other]) < NEAR for other in partners)
        return (
            "limited" if near or self.marginal[name] < HELPED * self.alone[name] else "determined"
        )

    @cached_property
    def reaches(self) -> dict[str, tuple[float, float]]:
        """The reach of both ends of the box of each parameter."""
        return {name: (self._reach(name, 0.0), self._reach(name, 1.0)) for name in self.box}

    def _reach(self, name: str, end: float) -> float:
        others = [other for other in self.box if other != name]
        exact = self.curve(self.times, **self.truth)

        def residuals(z: Array) -> Array:
            at = {other: self.value(other, each) for other, each in zip(others, z, strict=True)}
            at[name] = self.value(name, end)
            return np.asarray((self.curve(self.times, **at) - exact) / self.sigma)

        truth = np.array([self.place(other, self.truth[other]) for other in others])
        starts = [np.clip(truth, 0.01, 0.99), *(np.full(len(others), x) for x in (0.2, 0.5, 0.8))]
        ends = [scipy.optimize.least_squares(residuals, z, bounds=(0.0, 1.0)) for z in starts]
        return float(np.sqrt(2.0 * min(each.cost for each in ends)))


# --- closed forms --------------------------------------------------------------------------------


def _decay(t: Array, k: float, a: float) -> Array:
    return np.asarray(a * np.exp(-k * t))


def _oral(t: Array, ka: float, ke: float, V: float) -> Array:
    """The concentration after a dose of 100 by mouth, also where both rates are equal."""
    d = ka - ke
    share = t if d == 0.0 else -np.expm1(-d * t) / d
    return np.asarray(100.0 * ka / V * np.exp(-ke * t) * share)


def _logistic(t: Array, r: float, K: float, x0: float) -> Array:
    return np.asarray(K / (1.0 + (K / x0 - 1.0) * np.exp(-r * t)))


def _oscillator(t: Array, w: float, d: float) -> Array:
    """x'' + 2 d x' + w^2 x = 0 from x = 1 at rest."""
    turns = np.sqrt(w**2 - d**2)
    return np.asarray(np.exp(-d * t) * (np.cos(turns * t) + d / turns * np.sin(turns * t)))


def _enzyme(t: Array, Vmax: float, Km: float) -> Array:
    """Michaelis-Menten from a substrate of 4, by Lambert's function."""
    return np.asarray(Km * scipy.special.lambertw(4.0 / Km * np.exp((4.0 - Vmax * t) / Km)).real)


def _reversible(t: Array, k1: float, k2: float) -> Array:
    return np.asarray((k2 + k1 * np.exp(-(k1 + k2) * t)) / (k1 + k2))


def _relaxation(t: Array, k: float, a: float, c: float) -> Array:
    return np.asarray(c + (a - c) * np.exp(-k * t))


def _cascade(t: Array, k1: float, k2: float, k3: float) -> Array:
    """The third of a chain of three that begins with one in the first."""
    rates = np.array([[-k1, 0.0, 0.0], [k1, -k2, 0.0], [0.0, k2, -k3]])
    return np.asarray(scipy.linalg.expm(t[:, None, None] * rates)[:, 2, 0])


def _fed(t: Array, k: float, a: float, r: float) -> Array:
    return np.asarray(r / k + (a - r / k) * np.exp(-k * t))


def _product(t: Array, p: float, q: float, a: float) -> Array:
    return _decay(t, p * q, a)


def _cleared(t: Array, CL: float, V: float, a: float) -> Array:
    return _decay(t, CL / V, a)


_ORAL = {"A": "-ka*A", "C": "ka*A/V - ke*C"}
_ORAL_START = {"A": "100", "C": "0"}
_HOURS = np.array([0.25, 0.5, 0.75, 1, 1.5, 2, 3, 4, 5, 6, 8, 10, 12, 14, 16, 20])

DESIGNS = (
    Design(
        "decay",
        {"u": "-k*u"},
        {"u": "a"},
        {"k": (0.3, 3), "a": (0.5, 1.5)},
        {"k": 1.0, "a": 1.0},
        np.linspace(0.15, 3.0, 20),
        "u",
        0.02,
        5101,
        _decay,
    ),
    Design(
        "oral dose",
        _ORAL,
        _ORAL_START,
        {"ka": (0.6, 4), "ke": (0.1, 0.5), "V": (4, 25)},
        {"ka": 1.5, "ke": 0.3, "V": 10.0},
        _HOURS,
        "C",
        0.15,
        5102,
        _oral,
    ),
    Design(
        "logistic growth",
        {"x": "r*x*(1 - x/K)"},
        {"x": "x0"},
        {"r": (0.4, 1.6), "K": (5, 15), "x0": (0.2, 1.5)},
        {"r": 0.9, "K": 10.0, "x0": 0.7},
        np.linspace(0.5, 10.0, 20),
        "x",
        0.2,
        5103,
        _logistic,
    ),
    Design(
        "damped oscillator",
        {"x": "v", "v": "-2*d*v - w**2*x"},
        {"x": "1", "v": "0"},
        {"w": (1.5, 3), "d": (0.05, 0.6)},
        {"w": 2.2, "d": 0.2},
        np.linspace(0.25, 6.0, 24),
        "x",
        0.05,
        5104,
        _oscillator,
    ),
    Design(
        "enzyme, saturated at first",
        {"S": "-Vmax*S/(Km + S)"},
        {"S": "4"},
        {"Vmax": (0.5, 2), "Km": (0.3, 3)},
        {"Vmax": 1.0, "Km": 1.0},
        np.linspace(0.4, 8.0, 20),
        "S",
        0.05,
        5105,
        _enzyme,
    ),
    Design(
        "reversible reaction, sigma unknown",
        {"A": "-k1*A + k2*(1 - A)"},
        {"A": "1"},
        {"k1": (0.2, 2), "k2": (0.1, 1.5)},
        {"k1": 0.8, "k2": 0.5},
        np.linspace(0.25, 4.0, 16),
        "A",
        0.03,
        5106,
        _reversible,
        told=False,
    ),
    Design(
        "flip-flop, both rates nearly equal",
        _ORAL,
        _ORAL_START,
        {"ka": (0.5, 1.6), "ke": (0.4, 1.4), "V": (5, 16)},
        {"ka": 1.0, "ke": 0.95, "V": 10.0},
        _HOURS[:12],
        "C",
        0.15,
        5107,
        _oral,
        poor=True,
    ),
    Design(
        "relaxation to a level near zero",
        {"x": "-k*(x - c)"},
        {"x": "a"},
        {"k": (0.3, 3), "a": (0.5, 1.5), "c": (-0.05, 0.05)},
        {"k": 1.0, "a": 1.0, "c": 0.02},
        np.linspace(0.05, 1.0, 20),
        "x",
        0.02,
        5108,
        _relaxation,
        poor=True,
    ),
    Design(
        "sloppy cascade over decades",
        {"A": "-k1*A", "B": "k1*A - k2*B", "C": "k2*B - k3*C"},
        {"A": "1", "B": "0", "C": "0"},
        {"k1": (0.1, 10, "log"), "k2": (3, 300, "log"), "k3": (0.005, 0.5, "log")},
        {"k1": 0.8, "k2": 40.0, "k3": 0.025},
        np.linspace(0.5, 8.0, 16),
        "C",
        0.03,
        5109,
        _cascade,
        poor=True,
        rtol=1e-5,
    ),
    Design(
        "a feed of zero, the end of its box",
        {"x": "r - k*x"},
        {"x": "a"},
        {"k": (0.3, 3), "a": (0.5, 1.5), "r": (0, 0.5)},
        {"k": 1.0, "a": 1.0, "r": 0.0},
        np.linspace(0.2, 4.0, 20),
        "x",
        0.02,
        5110,
        _fed,
        poor=True,
    ),
    Design(
        "a product",
        {"x": "-p*q*x"},
        {"x": "a"},
        {"p": (0.5, 2), "q": (0.5, 2), "a": (0.5, 1.5)},
        {"p": 1.0, "q": 1.1, "a": 1.0},
        np.linspace(0.15, 3.0, 20),
        "x",
        0.02,
        5111,
        _product,
        poor=True,
    ),
    Design(
        "oral dose, late samples alone",
        _ORAL,
        _ORAL_START,
        {"ka": (0.8, 4), "ke": (0.1, 0.5), "V": (4, 25)},
        {"ka": 2.0, "ke": 0.2, "V": 10.0},
        np.linspace(6.0, 20.0, 15),
        "C",
        0.1,
        5112,
        _oral,
        poor=True,
    ),
)

WIDE = (
    Design(
        "cascade over four decades",
        {"A": "-k1*A", "B": "k1*A - k2*B", "C": "k2*B - k3*C"},
        {"A": "1", "B": "0", "C": "0"},
        {"k1": (5, 5e4, "log"), "k2": (4e-4, 4, "log"), "k3": (0.001, 10, "log")},
        {"k1": 150.0, "k2": 1.0, "k3": 0.025},
        np.linspace(0.2, 6.0, 16),
        "C",
        0.012,
        5121,
        _cascade,
        poor=True,
    ),
    Design(
        "oral dose from wide bounds",
        _ORAL,
        _ORAL_START,
        {"ka": (0.3, 10, "log"), "ke": (0.01, 0.3, "log"), "V": (1, 100, "log")},
        {"ka": 0.6, "ke": 0.15, "V": 10.0},
        np.linspace(3.0, 12.0, 10),
        "C",
        0.4,
        5123,
        _oral,
        poor=True,
    ),
    Design(
        "a volume of which only the clearance over it is seen",
        {"A": "-CL/V*A"},
        {"A": "a"},
        {"CL": (0.1, 100, "log"), "V": (1, 1000, "log"), "a": (10, 1000, "log")},
        {"CL": 4.0, "V": 20.0, "a": 100.0},
        np.linspace(0.5, 10.0, 20),
        "A",
        2.0,
        5122,
        _cleared,
        poor=True,
    ),
)
