"""The rates of a generated module as expressions of heyoka, and Taylor integrators made of them.

The generated ``rhs`` is run once, with heyoka's functions in place of NumPy's: no second text of
the rates is needed. What heyoka does not have makes no expression, and other integrators serve.
"""

from __future__ import annotations

import builtins
import math
import threading
from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from types import CodeType, FunctionType, ModuleType, SimpleNamespace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import special

from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.support.budget import charge_once
from rankone.support.costs import function_cost
from rankone.support.errors import RankoneError, optional_module

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


def _size(system: System, order: int) -> float:
    """Operations of the rates at one point, times the order."""
    return function_cost(system.rhs).each * order


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


class _Kept(threading.local):
    """The integrators of a thread: each has a state of its own, so threads do not share them."""

    def __init__(self) -> None:
        self.compiled = lru_cache(_MAX_KEPT)(_compiled)


_KEPT = _Kept()


def _equations(heyoka: ModuleType, code: CodeType, n: int, d: int) -> list[tuple[object, object]]:
    """Pairs of a state and its rate, both in units of the state's scale."""
    states = [heyoka.expression(f"u{i}") for i in range(n)]
    parameters = [heyoka.par[j] for j in range(d)]
    scales = [heyoka.par[d + i] for i in range(n)]
    sizes = [scale * state for scale, state in zip(scales, states, strict=True)]
    names = {
        "np": _numpy(heyoka),
        "special": _functions(heyoka, _SPECIAL, special),
        "__builtins__": {"float": builtins.float},
    }
    rates = FunctionType(code, names)(heyoka.time, sizes, parameters)
    triples = zip(states, rates, scales, strict=True)
    return [(state, rate / scale) for state, rate, scale in triples]


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
