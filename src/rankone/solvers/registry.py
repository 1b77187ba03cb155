"""The engines by name."""

from __future__ import annotations

from collections.abc import Collection
from difflib import SequenceMatcher

from rankone.solvers import cross, greedy, train
from rankone.solvers.engine import Engine
from rankone.support.errors import OptionError
from rankone.support.wording import did_you_mean
from rankone.trajectories.stacks.newton import SPARSE_STATES

__all__ = ["AUTO", "ENGINES", "engines_for"]

AUTO = "auto"
# Most parameters for which train comes first: it is as fast as cross there, and more exact. Where
# trajectories have sparse factors, cross takes a quarter to three quarters of its time
_FEW_PARAMETERS = 1

# Options about where to compute, which leave the choice of an engine open
_RESOURCES = {"executor"}

ENGINES: dict[str, Engine] = {
    engine.name: engine for engine in (train.ENGINE, cross.ENGINE, greedy.ENGINE)
}


def engines_for(
    method: str,
    options: Collection[str] = (),
    parameters: int = 0,
    *,
    separated: bool = True,
    states: int = 0,
) -> tuple[Engine, ...]:
    """The engines to try for a method and its options.

    ======  ===================  ================================================================
    engine  takes                when ``method="auto"`` tries it
    ======  ===================  ================================================================
    cross   any right-hand side  first from two parameters on: the fastest on all problems
                                 measured, and the only one for systems that do not separate
    train   separated systems    first up to one parameter and 63 states, with a small part of the
                                 budget; else with what is left of it (22 %) where cross does not
                                 reach the tolerance and nothing is steep
    greedy  separated systems    never, only by ``method="greedy"``
    ======  ===================  ================================================================

    An option that only one engine has leaves the other engine out; ``executor`` does not count. An
    OptionError if there is no such method, or an option belongs to another one.
    """
    if isinstance(method, str) and method == AUTO:
        few = parameters <= _FEW_PARAMETERS and states < SPARSE_STATES
        order = ("train", "cross") if few else ("cross", "train")
        possible = [ENGINES[name] for name in order if separated or name == "cross"]
        chosen = set(options) - _RESOURCES
        knowing = [e for e in possible if chosen <= set(e.options.names())]
        if knowing:
            return tuple(knowing)
        engine = max(possible, key=lambda e: _knows(e, options))
    elif isinstance(method, str) and method in ENGINES:
        engine = ENGINES[method]
    else:
        methods = (AUTO, *ENGINES)
        raise OptionError(
            f"method={method!r} is unknown{did_you_mean(str(method), methods)}",
            remedy=f"choose from {', '.join(methods)}",
        )
    for option in sorted(set(options).difference(engine.options.names())):
        owners = [f"method={e.name!r}" for e in ENGINES.values() if option in e.options.names()]
        if owners:
            raise OptionError(
                f"option {option!r} belongs to {' and '.join(owners)}, not to method={method!r}",
                remedy=f"choose {' or '.join(owners)}, or leave the option out",
            )
    return (engine,)


def _knows(engine: Engine, options: Collection[str]) -> tuple[int, float]:
    """How many of the options an engine has, and how similar its own are to the others."""
    names = engine.options.names()
    similarity = sum(max(SequenceMatcher(None, o, n).ratio() for n in names) for o in options)
    return len(set(options) & set(names)), similarity
