"""The engines by name."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rankone.errors import OptionError
from rankone.solvers import cross, greedy, train
from rankone.solvers.engine import Engine
from rankone.wording import did_you_mean

__all__ = ["ENGINES", "engine_named"]

ENGINES: dict[str, Engine[Any]] = {
    engine.name: engine for engine in (train.ENGINE, cross.ENGINE, greedy.ENGINE)
}


def engine_named(method: str, options: Iterable[str] = ()) -> Engine[Any]:
    """The engine of a method, or an OptionError, also if an option belongs to another one."""
    if not isinstance(method, str) or method not in ENGINES:
        raise OptionError(
            f"method={method!r} is unknown{did_you_mean(str(method), ENGINES)}",
            remedy=f"choose from {', '.join(ENGINES)}",
        )
    for option in set(options).difference(ENGINES[method].options.names()):
        for name, engine in ENGINES.items():
            if option in engine.options.names():
                raise OptionError(
                    f"option {option!r} belongs to method={name!r}, not to method={method!r}"
                )
    return ENGINES[method]
