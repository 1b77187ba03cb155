"""Fits as tables."""

from __future__ import annotations

from typing import Protocol

from rankone.support.labelled import Table
from rankone.support.wording import count


class Shown(Protocol):
    """What the table needs of a fit."""

    @property
    def level(self) -> float: ...
    @property
    def chi2(self) -> float: ...
    @property
    def sigma(self) -> float: ...
    @property
    def dof(self) -> int: ...
    @property
    def unit_known(self) -> bool: ...
    @property
    def noise_levels(self) -> tuple[str, ...]: ...
    @property
    def log_likelihood(self) -> float: ...
    @property
    def size(self) -> int: ...
    @property
    def observed(self) -> tuple[str, ...]: ...
    @property
    def trials(self) -> tuple[object, ...]: ...
    @property
    def parameters(self) -> tuple[str, ...]: ...
    @property
    def x(self) -> dict[str, float]: ...
    @property
    def identifiable(self) -> dict[str, bool]: ...
    @property
    def combinations(self) -> tuple[str, ...]: ...
    @property
    def success(self) -> bool: ...
    @property
    def message(self) -> str: ...
    @property
    def checks(self) -> tuple[str, ...]: ...
    def interval(self) -> dict[str, tuple[float, float]]: ...
    def interval_of(self, given: object) -> tuple[float, float]: ...
    def value_of(self, given: object) -> float: ...


def fit_table(fit: Shown) -> Table:
    """The estimates, a line each, and whether to believe them."""
    noise = f"chi2 {fit.chi2:.4g}"
    if not fit.unit_known:
        noise = f"sigma {fit.sigma:.4g} estimated"
    elif fit.noise_levels:
        noise = f"log-likelihood {fit.log_likelihood:.4g}"
    of = f"{count(fit.size, 'value')} of {', '.join(fit.observed)}"
    if len(fit.trials) > 1:
        of += f" in {len(fit.trials)} experiments"
    rows = []
    for name, (low, high) in fit.interval().items():
        identified = [f"{fit.x[name]:.6g}", f"[{low:.6g}, {high:.6g}]"]
        rows.append([name, *(identified if fit.identifiable[name] else ["not identified", ""])])
    for name in fit.combinations:
        low, high = fit.interval_of(name)
        rows.append([name, f"{fit.value_of(name):.6g}", f"[{low:.6g}, {high:.6g}]"])
    verdict = f"{'success' if fit.success else 'no success'}: {fit.message}"
    return Table(
        f"Fit to {of}: {noise}, {fit.dof} degrees of freedom",
        ["parameter", "estimate", f"{100 * fit.level:g} % interval"],
        rows,
        [verdict, *(f"note: {check}" for check in fit.checks)],
    )
