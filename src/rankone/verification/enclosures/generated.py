"""Generated functions, run on enclosures by the same text."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import FunctionType, SimpleNamespace
from typing import Any

import numpy as np
from scipy import special

from rankone.ir.guarded import PREFIX
from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import Cost
from rankone.verification.enclosures.enclosure import Condition, Enclosure
from rankone.verification.enclosures.functions import (
    extreme,
    falling,
    heaviside,
    logaddexp,
    mod,
    rising,
    unary,
    where,
)
from rankone.verification.enclosures.ranges import (
    SCALE,
    Function,
    away_from,
    even_bounds,
    inside,
    one_sided,
    sinc_bounds,
    tan_bounds,
    tan_resolved,
    wave_bounds,
    within,
)
from rankone.verification.enclosures.samples import by_samples, of_scale_one

_ENCLOSURES = 4.0  # Operations of enclosures and samples over those of the samples alone
_CALL = Cost(2e5, 0.0)  # Operations of an evaluation besides the function


class UnsuitableError(Exception):
    """A function cannot be evaluated on enclosures: it is array code."""


def enclosed(function: Callable[..., object]) -> Callable[..., Sequence[Enclosure]]:
    """A generated function as one of enclosures, which returns the rows of its array.

    An UnsuitableError if it calls helpers, as array code does, or was not generated.
    """
    if not isinstance(function, FunctionType) or not _is_generated(function):
        raise UnsuitableError
    names = {**function.__globals__, "np": _NAMES_OF_NUMPY, "special": _NAMES_OF_SPECIAL}
    for name in function.__code__.co_names:
        original = function.__globals__.get(name)
        if name.startswith(PREFIX) and callable(original):
            names[name] = by_samples(original)
        elif isinstance(original, FunctionType):
            raise UnsuitableError
    return FunctionType(function.__code__, names, function.__name__, function.__defaults__)


def arguments(
    cost: Cost, times: Array, states: Array, parameters: Array
) -> tuple[Enclosure, list[Enclosure], list[Enclosure]]:
    """Enclosures of times (nodes, N), states (n, nodes, N) and parameters (d, N) on N pieces.

    They are for one evaluation of a function, which is charged by what it would ``cost`` at these
    times alone.
    """
    charge(_CALL(0) + _ENCLOSURES * cost(times.size))
    clock = Enclosure.of_samples(times, 0.0)
    return clock, [*map(Enclosure.of_samples, states)], [*map(Enclosure.of, parameters)]


def _is_generated(function: FunctionType) -> bool:
    """Whether a function is from text, and not from a file."""
    return function.__code__.co_filename.startswith("<")


class _Rows(list[Any]):
    """The rows of what a generated function returns."""

    def __init__(self, shape: Sequence[int]) -> None:
        super().__init__(Enclosure.of(0.0) for _ in range(shape[0]))

    def __setitem__(self, row: Any, value: Any) -> None:
        super().__setitem__(row, Enclosure.of(value))


class _Names:
    """A namespace for generated text: functions of enclosures, and others by their samples."""

    def __init__(self, module: Any, functions: Mapping[str, Function]) -> None:
        self._module = module
        vars(self).update(functions)

    def __getattr__(self, name: str) -> Any:
        original = getattr(self._module, name)
        return of_scale_one(original) if callable(original) else original


def _no_shape(*_: Any) -> tuple[int, ...]:
    """Rows need no shape."""
    return ()


_NAMES_OF_NUMPY = _Names(
    np,
    {
        "abs": unary(np.abs, even_bounds(np.abs), one_sided),
        "arccos": falling(np.arccos, inside(0.9), (-1.0, 1.0)),
        "arccosh": rising(np.arccosh, away_from(1.0), (1.0, np.inf)),
        "arcsin": rising(np.arcsin, inside(0.9), (-1.0, 1.0)),
        "arcsinh": rising(np.arcsinh, within(1.2)),
        "arctan": rising(np.arctan, within(1.2)),
        "arctanh": rising(np.arctanh, inside(0.8), (-1.0, 1.0)),
        "asarray": lambda a, dtype=None: a,
        "broadcast": lambda *_: SimpleNamespace(shape=()),
        "broadcast_shapes": _no_shape,
        "ceil": rising(np.ceil),
        "cos": unary(np.cos, wave_bounds(0.5 * np.pi), within(SCALE)),
        "cosh": unary(np.cosh, even_bounds(np.cosh), within(SCALE)),
        "empty": _Rows,
        "exp": rising(np.exp, within(SCALE)),
        "expm1": rising(np.expm1, within(SCALE)),
        "floor": rising(np.floor),
        "heaviside": heaviside,
        "log": rising(np.log, away_from(0.0), (0.0, np.inf)),
        "log1p": rising(np.log1p, away_from(-1.0), (-1.0, np.inf)),
        "logaddexp": logaddexp,
        "logical_and": lambda a, b: Condition.known(a) & b,
        "logical_not": lambda a: ~Condition.known(a),
        "logical_or": lambda a, b: Condition.known(a) | b,
        "maximum": extreme(np.maximum),
        "minimum": extreme(np.minimum),
        "mod": mod,
        "shape": _no_shape,
        "sign": rising(np.sign),
        "sin": unary(np.sin, wave_bounds(0.0), within(SCALE)),
        "sinc": unary(np.sinc, sinc_bounds, within(1.0)),
        "sinh": rising(np.sinh, within(SCALE)),
        "sqrt": rising(np.sqrt, away_from(0.0), (0.0, np.inf)),
        "tan": unary(np.tan, tan_bounds, tan_resolved),
        "tanh": rising(np.tanh, within(2.0)),
        "where": where,
        "zeros": _Rows,
    },
)
_NAMES_OF_SPECIAL = _Names(
    special,
    {
        "cosm1": unary(special.cosm1, wave_bounds(0.5 * np.pi, 0.0), within(SCALE)),
        "erf": rising(special.erf, within(1.5)),
        "erfc": falling(special.erfc, within(1.5), (-np.inf, np.inf)),
        "expit": rising(special.expit, within(4.0)),
    },
)
