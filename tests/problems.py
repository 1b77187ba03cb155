"""The reference problems by name, as the examples define them."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

from examples import (
    compartment_chain,
    coupled,
    decay,
    doses,
    falling_card,
    free_fall,
    kirchhoff,
    linear,
    lotka_volterra,
    pendulum,
    projectile,
    robertson,
)
from rankone import Problem

__all__ = ["EXAMPLES", "GENERAL", "MEASURED", "REFERENCE", "SAMPLED"]

EXAMPLES: dict[str, ModuleType] = {
    "decay": decay,
    "linear": linear,
    "free_fall": free_fall,
    "coupled": coupled,
    "lotka_volterra": lotka_volterra,
    "kirchhoff": kirchhoff,
    "robertson": robertson,
    "chain": compartment_chain,
}

GENERAL: dict[str, ModuleType] = {
    "pendulum": pendulum,
    "doses": doses,
    "projectile": projectile,
}
"""Examples that do not separate as they are written."""

SAMPLED: dict[str, ModuleType] = {"falling_card": falling_card}
"""Those that are for ``method="cross"`` alone: lifted, they take the other engines too long."""


def _builder(example: ModuleType) -> Callable[[], Problem]:
    """A problem is immutable, so that all tests may share the example's."""
    return lambda: example.problem


REFERENCE: dict[str, Callable[[], Problem]] = {
    name: _builder(example) for name, example in EXAMPLES.items()
}

MEASURED: dict[str, Callable[[], Problem]] = {
    **REFERENCE,
    "kirchhoff_long": lambda: kirchhoff.motion(3),
}
"""What the benchmarks measure."""
