"""Fits as text."""

from __future__ import annotations

from typing import Protocol

from rankone.support.wording import count


class Shown(Protocol):
    """What the text needs of a fit."""

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


def fit_text(fit: Shown) -> str:
    """The estimates, a line each, and whether to believe them."""
    level = f"{100 * fit.level:g} %"
    noise = f"chi2 {fit.chi2:.4g}"
    if not fit.unit_known:
        noise = f"sigma {fit.sigma:.4g} estimated"
    elif fit.noise_levels:
        noise = f"log-likelihood {fit.log_likelihood:.4g}"
    of = f"{count(fit.size, 'value')} of {', '.join(fit.observed)}"
    if len(fit.trials) > 1:
        of += f" in {len(fit.trials)} experiments"
    lines = [f"Fit to {of}: {noise}, {fit.dof} degrees of freedom"]
    width = max(len(name) for name in fit.parameters)
    for name, (low, high) in fit.interval().items():
        text = "not identified"
        if fit.identifiable[name]:
            text = f"{fit.x[name]:.6g}  {level} in [{low:.6g}, {high:.6g}]"
        lines.append(f"  {name:<{width}}  {text}")
    for name in fit.combinations:
        low, high = fit.interval_of(name)
        lines.append(f"  {name}  {fit.value_of(name):.6g}  {level} in [{low:.6g}, {high:.6g}]")
    lines.append(f"  {'success' if fit.success else 'no success'}: {fit.message}")
    lines += [f"  note: {check}" for check in fit.checks]
    return "\n".join(lines)
