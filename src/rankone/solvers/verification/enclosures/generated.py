"""Generated functions, functions of NumPy and sampled functions, run on enclosures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import FunctionType, SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from rankone.solvers.verification.enclosures.bounds import (
    BETWEEN,
    SCALE,
    Bounds,
    Function,
    Resolved,
    around,
    away_from,
    even_bounds,
    falling_bounds,
    inside,
    one_sided,
    rising_bounds,
    share_in_doubt,
    sinc_bounds,
    tan_bounds,
    tan_resolved,
    times,
    wave_bounds,
    width_of,
    within,
    without_nan,
)
from rankone.solvers.verification.enclosures.enclosure import (
    Condition,
    Enclosure,
    add_doubts,
    applied,
)
from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import Cost
from rankone.trajectories.integrators.integrator import NODES
from rankone.trajectories.system.features import PREFIX


def unary(function: Function, bounds: Bounds, resolved: Resolved) -> Function:
    """A function of NumPy that takes enclosures too."""

    def of(a: Any) -> Any:
        if not isinstance(a, Enclosure):
            return function(a)
        return applied(a, function(a.values), bounds, resolved)

    return of


def rising(
    function: Function,
    resolved: Resolved | None = None,
    domain: tuple[float, float] = (-np.inf, np.inf),
) -> Function:
    """A function that rises; without a scale one that has steps alone."""

    def constant(low: Array, high: Array) -> NDArray[np.bool_]:
        return np.asarray(function(low) == function(high))

    return unary(function, rising_bounds(function, domain), resolved or constant)


def falling(function: Function, resolved: Resolved, domain: tuple[float, float]) -> Function:
    """A function that falls on its domain."""
    return unary(function, falling_bounds(function, domain), resolved)


def extreme(function: Function) -> Function:
    """The larger or the smaller one of two: in doubt where their ranges meet."""

    def of(a: Any, b: Any) -> Any:
        if not isinstance(a, Enclosure) and not isinstance(b, Enclosure):
            return function(a, b)
        a, b = Enclosure.of(a), Enclosure.of(b)
        (a_low, a_high), (b_low, b_high) = a.range(), b.range()
        common = np.minimum(a_high - b_low, b_high - a_low)
        doubt = add_doubts(np.maximum(common, 0.0), add_doubts(a.doubt, b.doubt))
        bounds = function(a_low, b_low), function(a_high, b_high)
        return Enclosure(function(a.values, b.values), bounds, doubt)

    return of


def where(condition: Any, a: Any, b: Any) -> Any:
    """One of two branches: both where it is not known which."""
    if not isinstance(condition, Condition):
        return a if condition else b
    a, b = Enclosure.of(a), Enclosure.of(b)
    (a_low, a_high), (b_low, b_high) = a.range(), b.range()
    may, must = condition.may, condition.must
    low = np.where(must, a_low, np.where(may, np.fmin(a_low, b_low), b_low))
    high = np.where(must, a_high, np.where(may, np.fmax(a_high, b_high), b_high))
    of_a, of_b = (0.0 if each.doubt is None else each.doubt for each in (a, b))
    doubt = np.where(must, of_a, np.where(may, width_of(low, high), of_b))
    return Enclosure(np.where(condition.values, a.values, b.values), (low, high), doubt)


def heaviside(a: Any, at_zero: Any) -> Any:
    """The step from zero to one: in doubt where the argument may be zero."""
    if not isinstance(a, Enclosure):
        return np.heaviside(a, at_zero)

    def bounds(low: Array, high: Array) -> tuple[Array, Array]:
        return np.heaviside(low, 0.0), np.heaviside(high, 1.0)

    values = np.heaviside(a.values, at_zero)
    return applied(a, values, bounds, lambda low, high: (low > 0.0) | (high < 0.0))


def mod(a: Any, b: Any) -> Any:
    """The remainder of a division: in doubt where it starts anew."""
    if not isinstance(a, Enclosure) and not isinstance(b, Enclosure):
        return np.mod(a, b)
    a, b = Enclosure.of(a), Enclosure.of(b)
    quotient = a / b
    low, high = quotient.range()
    inside = np.floor(low) == np.floor(high)
    sizes, zero = b.largest, np.zeros(1)
    least = np.where(b.bounds[0] < 0.0, -sizes, 0.0)
    most = np.where(b.bounds[1] > 0.0, sizes, 0.0)
    doubt = np.where(inside, zero if a.doubt is None else a.doubt, most - least)
    return Enclosure(np.mod(a.values, b.values), (least, most), doubt)


def logaddexp(a: Any, b: Any) -> Any:
    """The logarithm of a sum of exponentials."""
    if not isinstance(a, Enclosure) and not isinstance(b, Enclosure):
        return np.logaddexp(a, b)
    a, b = Enclosure.of(a), Enclosure.of(b)
    total = b + _softplus(a - b)
    return Enclosure(np.logaddexp(a.values, b.values), total.range, total.doubt)


_softplus = rising(lambda x: np.logaddexp(0.0, x), within(4.0))


# -----------------------------------------------------------------------------
# Functions of which enclosures are made by samples: those of the user, tables and the unlisted.
#
# Functions of ``scipy.special`` have a scale of about one, and poles at integers, if any. Of
# functions of the user and of tables nothing is known: they show what their samples show.


_MIDDLE = NODES.size // 2  # The sample in the middle of a piece
# Shares of ranges of several arguments at which functions are sampled, with all corners of three
_SHARES = np.concatenate(
    [np.indices((2, 2, 2)).reshape(3, -1), np.random.default_rng(7).random((3, 89))], axis=1
)


def by_samples(function: Function) -> Function:
    """A function of which nothing is known besides its values."""

    def of(*arguments: Any) -> Any:
        if not any(isinstance(argument, Enclosure) for argument in arguments):
            return function(*arguments)
        sampled = np.broadcast_arrays(*(Enclosure.of(a).values for a in arguments))
        values = function(*sampled)
        if isinstance(values, tuple):
            return tuple(Enclosure.of_samples(np.real(each)) for each in values)
        return Enclosure.of_samples(np.real(values))

    return of


def of_scale_one(function: Function) -> Function:
    """A function of scale one that may be singular at integers: its range is told by samples."""

    def of(*arguments: Any) -> Any:
        if not any(isinstance(argument, Enclosure) for argument in arguments):
            return function(*arguments)
        enclosures = [Enclosure.of(argument) for argument in arguments]
        sampled = function(*np.broadcast_arrays(*(each.values for each in enclosures)))
        if not isinstance(sampled, tuple):
            return _over_ranges(function, enclosures, sampled)
        return tuple(
            _over_ranges(lambda *a, k=k: function(*a)[k], enclosures, values)
            for k, values in enumerate(sampled)
        )

    return of


def _over_ranges(function: Function, arguments: Sequence[Enclosure], sampled: Array) -> Enclosure:
    """In doubt by its range where an argument varies by more than its scale, or is in doubt."""
    values = np.real(sampled)
    varying = [each for each in arguments if each.values.ndim > 1]
    clear = all(each.doubt is None and _of_one_scale(*each.hull()).all() for each in varying)
    if values.ndim < 2:
        return Enclosure.of_samples(values)
    poles = _poles(function, arguments)
    if clear and not poles.any():
        return Enclosure.of_samples(values)
    shares = iter(_SHARES[: len(varying)] if len(varying) > 1 else [np.linspace(0.0, 1.0, 49)])
    inside = [
        each.values if each.values.ndim < 2 else _inside_range(*each.range(), next(shares))
        for each in arguments
    ]
    beside = np.real(function(*np.broadcast_arrays(*inside)))
    low, high = without_nan(*around(np.concatenate([values, beside]), BETWEEN))
    low, high = np.where(poles, -np.inf, low), np.where(poles, np.inf, high)
    in_doubt = np.where(poles, 1.0, 0.0)
    for each in varying:
        below, above = each.range()
        in_doubt = np.where(_of_one_scale(below, above), in_doubt, 1.0)
        if each.doubt is not None:
            in_doubt = np.maximum(in_doubt, share_in_doubt(each.doubt, below, above))
    return Enclosure(values, (low, high), times(width_of(low, high), in_doubt))


def _poles(function: Function, arguments: Sequence[Enclosure]) -> NDArray[np.bool_]:
    """Whether a function is infinite, or no number, at an integer in the range of an argument.

    There are the poles of gamma, digamma and zeta functions, of elliptic and of hypergeometric
    ones. A range within one scale holds three integers at most.
    """
    middles = [each.values[_MIDDLE] if each.values.ndim > 1 else each.values for each in arguments]
    poles = np.zeros(1, dtype=bool)
    for k, each in enumerate(arguments):
        if each.values.ndim < 2:
            continue
        low, high = each.hull()
        integers = np.stack([np.ceil(low), np.rint(0.5 * (low + high)), np.floor(high)])
        places = [*middles[:k], np.clip(integers, low, high), *middles[k + 1 :]]
        poles = poles | ~np.isfinite(function(*np.broadcast_arrays(*places))).all(axis=0)
    return poles


def _of_one_scale(low: Array, high: Array) -> NDArray[np.bool_]:
    return np.asarray(within(1.0)(low, high) & away_from(0.0)(low, high))


def _inside_range(low: Array, high: Array, shares: Array) -> Array:
    """Places at shares (M,) of ranges, evenly spaced near zero and by their logarithms afar."""
    begin, end = (np.arcsinh(10.0 * np.clip(each, -1e100, 1e100)) for each in (low, high))
    places = np.sinh(begin + (end - begin) * shares[:, None]) / 10.0
    return np.asarray(np.clip(places, low, high))


# -----------------------------------------------------------------------------
# Generated functions, run on enclosures by the same text.


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
