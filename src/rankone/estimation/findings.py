"""What speaks against a fit, in sentences."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Protocol

import numpy as np

from rankone.support.arrays import Array
from rankone.support.wording import listing, quote

if TYPE_CHECKING:
    from rankone.estimation.observations import Observations
    from rankone.solution.core import SolutionCore

__all__ = ["findings_of"]

_UNLIKELY = 1e-3
"""Probability of the residuals below which they are too large."""
_MODEL = 0.5
"""How far the error of the solution may move an estimate, in its standard deviations."""


class _Fit(Protocol):
    """What is looked at of a fit."""

    @property
    def observations(self) -> Observations: ...
    @property
    def solution(self) -> SolutionCore: ...
    @property
    def chi2(self) -> float: ...
    @property
    def converged(self) -> bool: ...
    @property
    def others(self) -> tuple[dict[str, float], ...]: ...
    @property
    def size(self) -> Array: ...
    @property
    def identifiable(self) -> dict[str, bool]: ...
    @property
    def combinations(self) -> tuple[str, ...]: ...
    @property
    def at_bounds(self) -> dict[str, str]: ...
    @property
    def p_value(self) -> float: ...
    @property
    def dof(self) -> int: ...
    @property
    def sigma(self) -> float: ...
    @property
    def x(self) -> dict[str, float]: ...


def findings_of(fit: _Fit) -> Iterator[str]:
    """Whatever makes a fit one that should not be used as it is."""
    if not fit.converged:
        yield "the search did not end; remedy: give a start, or more starts"
    yield from _identification(fit)
    for name, end in fit.at_bounds.items():
        if fit.identifiable[name]:
            yield (
                f"{quote(name)} = {fit.x[name]:.6g} is at the {end} end of its bounds: intervals "
                "are not valid there; remedy: widen the bounds, or solve on a wider box"
            )
    for other in fit.others:
        where = ", ".join(f"{name} = {value:.6g}" for name, value in other.items())
        yield f"other values fit as well: {where}; remedy: set bounds, or measure more"
    if fit.p_value < _UNLIKELY:
        yield (
            f"the residuals are {fit.sigma:.3g} times as large as sigma (chi2 {fit.chi2:.4g} with "
            f"{fit.dof} degrees of freedom, p = {fit.p_value:.1g}): the model does not describe "
            "the data, or sigma is larger"
        )
    if not fit.solution.success:
        yield f"the solution is no success itself: {fit.solution.message}"
    yield from _error_of_model(fit.solution, fit.observations, fit.size, fit.sigma)


def _identification(fit: _Fit) -> Iterator[str]:
    names = [name for name, known in fit.identifiable.items() if not known]
    if not names:
        return
    if len(names) == 1:
        yield f"the data do not identify {quote(names[0])}; remedy: fix it, or measure more"
        return
    said = f"the data do not identify {listing(names)}"
    if fit.combinations:
        yield f"{said} alone, only {listing(fit.combinations)}; remedy: fix one of them"
    else:
        yield f"{said} within their bounds; remedy: fix some, measure more, or widen the box"


def _error_of_model(
    solution: SolutionCore, seen: Observations, size: Array, sigma: float
) -> Iterator[str]:
    """Where the error of the solution is not small beside the noise."""
    unit = 1.0 if seen.known else sigma
    for i, name in enumerate(seen.names):
        here = seen.owner == i
        error = solution.errors[name]
        if not here.any() or math.isnan(error):
            continue
        absolute = error * float(size[here][0])
        noise = unit / seen.scale[here]
        if absolute * float(np.sqrt(np.sum(noise**-2.0, where=noise > 0.0))) > _MODEL:
            yield (
                f"the error of the solution, {absolute:.2g} in {quote(name)}, is not small beside "
                f"the noise, {float(np.median(noise)):.2g}; remedy: solve with a smaller rtol"
            )
