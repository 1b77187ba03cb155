"""Noise of measurements: its distribution, its standard deviation, and what a datum adds to a fit.

A fit minimises -2 log L over parameters theta. Beside it each datum has pseudo-residuals rho and
their Jacobian J such that J^T rho is half the gradient and J^T J the Fisher information. So a
Gauss-Newton step is a step of Fisher scoring, also where parameters move the standard deviation
(Seber & Wild, Nonlinear Regression, 1989, ch. 2.8 and 14).
"""

from __future__ import annotations

import ast
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from rankone.inference.estimation import formulas
from rankone.support.arrays import NEGLIGIBLE, Array
from rankone.support.errors import OptionError, did_you_mean, quote, shown

STUDENT_FREEDOM = 4.0
"""Degrees of freedom of Student's noise: heavy tails that still have a variance."""
# Scale of Student's distribution with standard deviation one
_STUDENT_SCALE = np.sqrt((STUDENT_FREEDOM - 2.0) / STUDENT_FREEDOM)

# The standard deviation of each kind by its levels and the prediction p
_STANDARD_DEVIATIONS = {
    "constant": "sigma",
    "proportional": "relative*abs(p)",
    "combined": "sqrt(sigma**2 + (relative*p)**2)",
    "log-normal": "sigma",
    "student": "sigma",
}
_LEVELS = ("sigma", "relative")
_PREDICTION = "p"
NOISES = tuple(_STANDARD_DEVIATIONS)
"""The kinds of noise that ``noise=`` takes."""
# Factors by which levels change to see whether the standard deviation changes as much
_HOMOGENEITY_FACTOR = 2.0


@dataclass(frozen=True)
class Noise:
    """The noise of one observable.

    ``spread`` (m,) is the standard deviation of each datum, whatever the distribution, or a factor
    of it where a ``formula`` has the rest: then levels, parameters or the prediction change it.
    ``levels`` are the parameters that the formula alone has. ``distribution`` is "normal",
    "log-normal", "student", or "laplace" and "log-laplace", which problems from files may have.
    """

    distribution: str
    spread: Array
    formula: formulas.Formula | None = None
    levels: tuple[str, ...] = ()
    relative: tuple[str, ...] = ()

    @property
    def logarithmic(self) -> bool:
        """Whether the distribution is one of logarithms of the data."""
        return self.distribution.startswith("log-")

    @property
    def of_laplace(self) -> bool:
        """Whether costs are absolute deviations."""
        return self.distribution.endswith("laplace")

    @property
    def estimated(self) -> bool:
        """Whether parameters of a fit change the standard deviation."""
        return self.formula is not None

    def sigma(self, at: Mapping[str, formulas.Operand]) -> formulas.Operand:
        """The standard deviation of each datum; of its logarithm for log-normal noise."""
        if self.formula is None:
            return self.spread
        sigma: formulas.Operand = self.formula(at)
        return sigma * self.spread

    @property
    def scale_root(self) -> float:
        """Root of the Fisher information of a datum about the logarithm of its deviation."""
        nu = STUDENT_FREEDOM
        if self.of_laplace:
            return 1.0
        student = self.distribution == "student"
        return math.sqrt(2.0 * nu / (nu + 3.0)) if student else math.sqrt(2.0)

    @property
    def scales(self) -> bool:
        """Whether the standard deviation grows in proportion to its levels."""
        if self.formula is None or not self.levels:
            return False
        generator = np.random.default_rng(3)
        at = {name: float(generator.uniform(0.5, 2.0)) for name in self.formula.names}
        more = {
            name: x * (_HOMOGENEITY_FACTOR if name in self.levels else 1.0)
            for name, x in at.items()
        }
        ratio = float(self.formula(more)) / float(self.formula(at))
        return abs(ratio - _HOMOGENEITY_FACTOR) < NEGLIGIBLE

    def selected(self, present: NDArray[np.bool_]) -> Noise:
        """The noise of some of the data."""
        return Noise(
            self.distribution, self.spread[present], self.formula, self.levels, self.relative
        )


def noise_of(kind: object, observable: str, spread: Array, *, given: bool) -> Noise:
    """Noise of one of the kinds; its level is ``spread`` if it is given, else a parameter."""
    if not isinstance(kind, str) or kind not in NOISES:
        raise OptionError(
            f"noise={shown(kind)} is unknown{did_you_mean(str(kind), NOISES)}",
            term=kind,
            remedy=f"choose from {', '.join(NOISES)}, or write sigma as an expression",
        )
    distribution = kind if kind in ("log-normal", "student") else "normal"
    text = _STANDARD_DEVIATIONS[kind]
    if given:
        if kind == "combined":
            raise OptionError(
                f"combined noise of {quote(observable)} has two levels, and sigma is one number",
                remedy='leave sigma out, or write it: sigma="sqrt(0.1**2 + (0.05*x)**2)"',
            )
        if kind != "proportional":
            return Noise(distribution, spread)
        return Noise(
            distribution, spread, _named(formulas.formula_of("abs(p)"), {_PREDICTION: observable})
        )
    levels = {
        word: name
        for word, name in zip(_LEVELS, usual_levels(observable), strict=True)
        if word in text
    }
    formula = _named(formulas.formula_of(text), {**levels, _PREDICTION: observable})
    relative = [levels[word] for word in levels if word == "relative" or kind == "log-normal"]
    return Noise(distribution, spread, formula, tuple(levels.values()), tuple(relative))


def usual_levels(observable: str) -> tuple[str, ...]:
    """Names of the levels of noise of an observable, unless sigma names others."""
    return tuple(f"{word}_{observable}" for word in _LEVELS)


def _named(formula: formulas.Formula, names: Mapping[str, str]) -> formulas.Formula:
    """A formula with other names; they need not be words."""
    body = formula.body

    class Renamed(ast.NodeTransformer):
        def visit_Name(self, node: ast.Name) -> ast.Name:
            return ast.Name(names.get(node.id, node.id), ast.Load())

    return formulas.Formula(formula.text, Renamed().visit(body))


class Terms(NamedTuple):
    """What m data add: -2 log L (K,) up to a constant, pseudo-residuals (K, r), Jacobian (K, r, w).

    ``standardised`` (K, m) are the deviations in standard deviations, ``weights`` (K, m) those of
    their squares in the estimate of the standard deviation.
    """

    cost: Array
    residuals: Array
    jacobian: Array
    standardised: Array
    weights: Array


def terms(
    noise: Noise,
    data: Array,
    prediction: formulas.Operand,
    sigma: formulas.Operand,
    width: int | None,
    present: NDArray[np.bool_] | None = None,
) -> Terms:
    """What the data (m,) of an observable add to a fit.

    ``prediction`` and ``sigma`` have w = ``width`` derivatives; without any, the Jacobian is empty.
    Data that are not ``present`` (m,) add nothing.
    """
    if noise.logarithmic:
        prediction, data = formulas.FUNCTIONS["log"](prediction), np.log(data)
    p, s = formulas.value_of(prediction), formulas.value_of(sigma)
    r = (p - data) / s
    shares = np.ones(r.shape)
    location, scale = 1.0, noise.scale_root
    each = r**2
    if noise.distribution == "student":
        nu, squares = STUDENT_FREEDOM, (r / _STUDENT_SCALE) ** 2
        shares = (nu + 1.0) / (nu + squares) / _STUDENT_SCALE**2
        location = np.sqrt((nu + 1.0) / (nu + 3.0)) / _STUDENT_SCALE
        each = (nu + 1.0) * np.log1p(squares / nu)
    if noise.of_laplace:
        location = math.sqrt(2.0)
        shares = np.divide(location, np.abs(r), out=np.zeros(r.shape), where=r != 0.0)
        each = 2.0 * location * np.abs(r)
    if noise.estimated:
        each = each + 2.0 * np.log(s)
    counted: Array | float = 1.0
    if present is not None:
        each, r, shares = (np.where(present, row, 0.0) for row in (each, r, shares))
        counted = np.where(present, 1.0, 0.0)
    residuals = shares * r / location
    if noise.estimated:
        residuals = np.concatenate([residuals, (counted - shares * r**2) / scale], axis=-1)
    w = 0 if width is None else width
    jacobian = np.zeros((*residuals.shape, w))
    if w:
        m = r.shape[-1]
        per_sigma = np.asarray(counted / s)[..., None]
        jacobian[..., :m, :] = location * formulas.slope_of(prediction, w) * per_sigma
        if noise.estimated:
            jacobian[..., m:, :] = scale * formulas.slope_of(sigma, w) * per_sigma
    return Terms(each.sum(axis=-1), residuals, jacobian, r, shares)


def log_likelihood(noise: Noise, data: Array, standardised: Array, sigma: Array) -> float:
    """The logarithm of the probability density of the data (m,), with all constants."""
    if noise.distribution == "student":
        scaled = standardised / _STUDENT_SCALE
        each = scipy.stats.t.logpdf(scaled, STUDENT_FREEDOM) - np.log(_STUDENT_SCALE)
    elif noise.of_laplace:
        each = -math.sqrt(2.0) * np.abs(standardised) - 0.5 * math.log(2.0)
    else:
        each = -0.5 * (standardised**2 + np.log(2.0 * np.pi))
    each = each - np.log(sigma)
    if noise.logarithmic:
        each = each - np.log(data)
    return float(np.sum(each))


def noise_draws(
    noise: Noise, prediction: Array, sigma: Array, generator: np.random.Generator
) -> Array:
    """Data drawn at random around predictions (...), with standard deviations (...)."""
    if noise.distribution == "student":
        tails = generator.standard_t(STUDENT_FREEDOM, prediction.shape)
        return np.asarray(prediction + sigma * _STUDENT_SCALE * tails)
    normal = sigma * generator.standard_normal(prediction.shape)
    log_normal = noise.distribution == "log-normal"
    return np.asarray(prediction * np.exp(normal) if log_normal else prediction + normal)


def normal_scores(noise: Noise, standardised: Array) -> Array:
    """Deviations of normal noise that are as improbable as standardised ones (m,)."""
    if noise.distribution != "student":
        return standardised
    tails = scipy.stats.t.sf(np.abs(standardised) / _STUDENT_SCALE, STUDENT_FREEDOM)
    return np.asarray(np.sign(standardised) * scipy.stats.norm.isf(tails))
