"""The engines by name."""

from __future__ import annotations

from typing import Any

from rankone.errors import OptionError
from rankone.solvers import cross, greedy, train
from rankone.solvers.engine import Engine
from rankone.wording import did_you_mean

__all__ = ["ENGINES", "engine_named"]

ENGINES: dict[str, Engine[Any]] = {
    engine.name: engine for engine in (train.ENGINE, cross.ENGINE, greedy.ENGINE)
}


def engine_named(method: str) -> Engine[Any]:
    """The engine of a method, or an OptionError."""
    if not isinstance(method, str) or method not in ENGINES:
        raise OptionError(
            f"method={method!r} is unknown{did_you_mean(str(method), ENGINES)}",
            remedy=f"choose from {', '.join(ENGINES)}",
        )
    return ENGINES[method]
