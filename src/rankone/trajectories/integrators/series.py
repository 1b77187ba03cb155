"""The rates of a generated module as expressions of heyoka, and what is compiled of them.

That is Taylor integrators, and the rates themselves. The generated ``rhs`` is run once, with
heyoka's functions in place of NumPy's: no second text of the rates is needed. What heyoka does not
have makes no expression, and other integrators serve.
"""

from __future__ import annotations

import builtins
import math
import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from types import CodeType, FunctionType, ModuleType, SimpleNamespace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import special

from rankone.support.arrays import Array
from rankone.support.budget import charge_once
from rankone.support.costs import Cost, function_cost
from rankone.support.errors import RankoneError, optional_module
from rankone.trajectories.system.features import OfStates, VectorLike
from rankone.trajectories.system.system import System

_SAME_NAMES = (
    *("cos", "cosh", "exp", "expm1", "log", "log1p"),
    *("sin", "sinh", "sqrt", "tan", "tanh"),
)
_INVERSE = ("cos", "cosh", "sin", "sinh", "tan", "tan2", "tanh")
_FUNCTIONS = {name: name for name in _SAME_NAMES} | {f"arc{name}": f"a{name}" for name in _INVERSE}
_SPECIAL = {"erf": "erf", "erfc": "erfc", "expit": "sigmoid"}
# Errors of a right-hand side that is run with what heyoka does not have
_NO_EXPRESSION = (AttributeError, NameError, TypeError, ValueError)
_MAX_KEPT = 16  # Compiled integrators that a thread keeps
# Operations of the rates times the order from which loops are compiled instead of straight lines:
# those take longer to compile, in proportion to both
_MOST_STRAIGHT = 700.0
_COMPILATION = 6e6  # Operations of compiling an integrator, whatever it computes
_COMPILED_TERM = 0.1e6  # The same for an operation of the rates and an order
_COMPILED_LOOPS = 120e6  # Operations of compiling loops
# The same of the rates alone: once, and for each operation of them; and those of calling them
_RATES_COMPILATION = Cost(16e6, 0.03e6)
_RATES_COST = Cost(8e3, 0.12)


class Taylor(Protocol):
    """A batch of trajectories of heyoka, each with its own steps, as far as they are used here."""

    @property
    def batch_size(self) -> int: ...
    @property
    def order(self) -> int: ...
    @property
    def state(self) -> Array: ...
    @property
    def pars(self) -> Array: ...
    @property
    def time(self) -> Array: ...
    @property
    def tc(self) -> Array: ...
    @property
    def propagate_res(self) -> Sequence[tuple[object, float, float, int]]: ...

    def set_time(self, time: float) -> None: ...
    def step(self, max_delta_t: Array, write_tc: bool) -> None: ...
    def propagate_grid(
        self, grid: Array, *, max_steps: int, max_delta_t: float
    ) -> tuple[object, Array]: ...


class _CompiledFunction(Protocol):
    """A function of heyoka of many points at once, as far as it is used here."""

    @property
    def nparams(self) -> int: ...
    @property
    def is_time_dependent(self) -> bool: ...

    def __call__(self, inputs: Array, **of_points: Array) -> Array: ...


@dataclass(frozen=True, eq=False)
class CompiledRates:
    """The rates of a system, an :data:`OfStates`, compiled for stacks: states (n, m) at one time.

    Other shapes are left to the ``generated`` rates. ``cost`` is that of a call.
    """

    generated: OfStates
    compiled: _CompiledFunction
    cost: Cost

    def __call__(self, t: float | Array, u: VectorLike, p: VectorLike) -> Array:
        states, parameters, compiled = np.asarray(u), np.asarray(p), self.compiled
        one_time = isinstance(t, float) and states.ndim == 2 == parameters.ndim
        if not one_time or states.shape[1] != parameters.shape[1]:
            return self.generated(t, u, p)
        of_points: dict[str, Array] = {}
        if compiled.nparams:
            of_points["pars"] = np.ascontiguousarray(parameters[: compiled.nparams])
        if compiled.is_time_dependent:
            of_points["time"] = np.full(states.shape[1], t)
        return compiled(np.ascontiguousarray(states), **of_points)


@cache
def is_installed() -> bool:
    """Whether heyoka is there, and loads."""
    try:
        optional_module("heyoka", "", "")
    except RankoneError:
        return False
    return True


def has_series(system: System) -> bool:
    """Whether the rates of a system are analytic functions that heyoka has.

    Steps see the rates near their start alone, so there are no state surfaces, where rates switch
    or peak.
    """
    analytic = not (system.features.n_state_surfaces or system.features.n_moving_cuts)
    analytic = analytic and system.clock is None
    code = _code(system)
    return analytic and code is not None and _is_expressible(code, *_shape(system))


def order_of(tolerance: float) -> int:
    """The order of the series for a tolerance (Jorba & Zou, Experimental Mathematics 14, 2005)."""
    return max(2, math.ceil(1.0 - 0.5 * math.log(tolerance)))


def compilation_cost(system: System, order: int) -> float:
    """Operations of compiling an integrator."""
    size = _size(system, order)
    return _COMPILATION + (_COMPILED_TERM * size if size < _MOST_STRAIGHT else _COMPILED_LOOPS)


def charge_compilation(system: System, order: int) -> None:
    """Count the compilation once in a solve, whatever was solved before."""
    charge_once((_code(system), *_shape(system), order), compilation_cost(system, order))


def rates_compilation_cost(system: System) -> float:
    """Operations of compiling the rates."""
    return _RATES_COMPILATION(_terms(system))


def compiled_rates_cost(system: System) -> Cost:
    """Operations of compiled rates: of a call, and for each point."""
    return Cost(_RATES_COST.once, _RATES_COST.each * _terms(system))


def charge_compiled_rates(system: System) -> None:
    """Count the compilation of the rates once in a solve, whatever was solved before."""
    charge_once((_code(system), *_shape(system)), rates_compilation_cost(system))


@lru_cache(_MAX_KEPT)
def with_compiled_rates(system: System) -> System:
    """The same system with compiled rates; it has to have :func:`series <has_series>`."""
    code = _code(system)
    assert code is not None
    compiled = _compiled_rates(code, *_shape(system))
    return replace(system, rhs=CompiledRates(system.rhs, compiled, compiled_rates_cost(system)))


def taylor_integrator(system: System, order: int) -> Taylor:
    """An integrator of the scaled system, compiled once in a process and thread.

    Its parameters are those of the system, then the scale of each state; its states are in units of
    those.
    """
    code = _code(system)
    assert code is not None
    straight = _size(system, order) < _MOST_STRAIGHT
    return _KEPT.compiled(code, *_shape(system), order, straight)


def _code(system: System) -> CodeType | None:
    """The code of the rates; None where they call functions of the user."""
    rates = system.rhs
    return rates.__code__ if isinstance(rates, FunctionType) and not system.user_functions else None


def _shape(system: System) -> tuple[int, int]:
    return system.n_differential, len(system.parameters)


def _terms(system: System) -> float:
    """Operations of the rates at one point, times the half nanosecond that each takes in arrays."""
    return function_cost(system.rhs).each


def _size(system: System, order: int) -> float:
    """Operations of the rates at one point, times the order."""
    return _terms(system) * order


@lru_cache(_MAX_KEPT)
def _is_expressible(code: CodeType, n: int, d: int) -> bool:
    heyoka: ModuleType = optional_module("heyoka", "a compiled integrator needs heyoka", "")
    try:
        _equations(heyoka, code, n, d)
    except _NO_EXPRESSION:
        return False
    return True


def _compiled(code: CodeType, n: int, d: int, order: int, straight: bool) -> Taylor:
    heyoka: ModuleType = optional_module("heyoka", "a compiled integrator needs heyoka", "")
    equations = _equations(heyoka, code, n, d)
    taylor: Taylor = heyoka.taylor_adaptive_batch(
        equations,
        np.zeros((n, heyoka.recommended_simd_size())),
        tol=math.exp(-2.0 * (order - 1.0)),
        compact_mode=not straight,
        opt_level=0 if straight else 1,  # straight lines are vectors as they are written
    )
    return taylor


@lru_cache(_MAX_KEPT)
def _compiled_rates(code: CodeType, n: int, d: int) -> _CompiledFunction:
    heyoka: ModuleType = optional_module("heyoka", "compiled rates need heyoka", "")
    states = _states(heyoka, n)
    rates = [heyoka.expression(0.0) + rate for rate in _rates(heyoka, code, states, d)]
    # straight lines are vectors as they are written
    compiled: _CompiledFunction = heyoka.cfunc(rates, states, compact_mode=False, opt_level=0)
    return compiled


class _Kept(threading.local):
    """The integrators of a thread: each has a state of its own, so threads do not share them."""

    def __init__(self) -> None:
        self.compiled = lru_cache(_MAX_KEPT)(_compiled)


_KEPT = _Kept()


def _states(heyoka: ModuleType, n: int) -> list[Any]:
    return [heyoka.expression(f"u{i}") for i in range(n)]


def _equations(heyoka: ModuleType, code: CodeType, n: int, d: int) -> list[tuple[object, object]]:
    """Pairs of a state and its rate, both in units of the state's scale."""
    states = _states(heyoka, n)
    scales = [heyoka.par[d + i] for i in range(n)]
    sizes = [scale * state for scale, state in zip(scales, states, strict=True)]
    triples = zip(states, _rates(heyoka, code, sizes, d), scales, strict=True)
    return [(state, rate / scale) for state, rate, scale in triples]


def _rates(heyoka: ModuleType, code: CodeType, states: Sequence[Any], d: int) -> Iterable[Any]:
    """Rates of states, by running their code."""
    names = {
        "np": _numpy(heyoka),
        "special": _functions(heyoka, _SPECIAL, special),
        "__builtins__": {"float": builtins.float},
    }
    rates: Iterable[Any] = FunctionType(code, names)(
        heyoka.time, states, [heyoka.par[j] for j in range(d)]
    )
    return rates


def _functions(heyoka: ModuleType, names: dict[str, str], numeric: ModuleType) -> SimpleNamespace:
    """Functions of heyoka by the names that a module of NumPy or SciPy has for them."""

    def either(name: str) -> Callable[..., object]:
        of_expressions, of_numbers = vars(heyoka)[names[name]], vars(numeric)[name]

        def function(*arguments: object) -> object:
            if any(isinstance(x, heyoka.expression) for x in arguments):
                return of_expressions(*arguments)
            return float(of_numbers(*arguments))

        return function

    return SimpleNamespace(**{name: either(name) for name in names})


def _numpy(heyoka: ModuleType) -> SimpleNamespace:
    """What generated rates call of NumPy, for a single point."""

    def entries(shape: tuple[int, ...]) -> NDArray[np.object_]:
        return np.zeros(shape, dtype=object)

    numpy = _functions(heyoka, _FUNCTIONS, np)
    vars(numpy).update(
        pi=np.pi,
        e=np.e,
        empty=entries,
        zeros=entries,
        broadcast=lambda *arrays: SimpleNamespace(shape=()),
        broadcast_shapes=lambda *shapes: (),
        shape=lambda array: (),
        asarray=lambda array, dtype: array,
    )
    return numpy
