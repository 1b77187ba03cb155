"""Generated functions at one point, for Python's floats, as LSODA calls them.

A generated function is arithmetic on arrays, which takes a microsecond for each operation however
small the arrays. Its text is rewritten here for floats and the functions of ``math``, when a
trajectory is first integrated alone: 20 to 50 times faster at one point. Branches of a piecewise
function that are not selected are not evaluated.
"""

from __future__ import annotations

import ast
import bisect
import inspect
import itertools
import math
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import FunctionType
from typing import TypeAlias

import numpy as np

from rankone.support.arrays import COARSE, SAME, Array
from rankone.support.budget import charge
from rankone.support.costs import CALL, Cost, function_cost, inverse, scalar_cost
from rankone.trajectories.integrators.integrator import finite_blocks, jacobians
from rankone.trajectories.system.features import AT_THE_ENDS, POINTS, PREFIX, VALUES
from rankone.trajectories.system.system import PointRates, System, pattern_of

# Numbers, row by row, at a time, states (n,) and parameters (d,) as floats
ScalarFunction: TypeAlias = Callable[[float, Sequence[float], Sequence[float]], list[float]]

_PREFIX = "_of_floats_"  # Begins names that no state or parameter has
# Functions of ``math`` that are called as those of NumPy are
_SAME_IN_MATH = (
    *("sqrt", "exp", "expm1", "log", "log1p"),
    *("sin", "cos", "tan", "sinh", "cosh", "tanh"),
)
_INVERSE = ("sin", "cos", "tan", "tan2", "sinh", "cosh", "tanh")  # Those with an inverse there
_FUNCTIONS: dict[str, object] = {
    **{name: vars(math)[name] for name in _SAME_IN_MATH},
    **{f"arc{name}": vars(math)[f"a{name}"] for name in _INVERSE},
    "abs": abs,
    "ceil": lambda x: float(math.ceil(x)),
    "floor": lambda x: float(math.floor(x)),
    "heaviside": lambda x, middle: middle if x == 0.0 else float(x > 0.0),
    "logaddexp": lambda x, y: float(np.logaddexp(x, y)),
    "maximum": lambda x, y: x if x >= y or x != x else y,
    "minimum": lambda x, y: x if x <= y or x != x else y,
    "mod": lambda x, y: x % y,
    "power": math.pow,
    "sign": lambda x: math.copysign(1.0, x) if x else x,
    "sinc": lambda x: math.sin(math.pi * x) / (math.pi * x) if x else 1.0,
}
_NUMBERS = "CONSTANTS"  # The dictionary of a generated module that has numbers by name
_CONSTANTS: dict[str, object] = {"pi": math.pi, "e": math.e, "nan": math.nan, "inf": math.inf}


class _Untranslatable(Exception):
    """The text of a function has something that is not rewritten."""


@dataclass(frozen=True)
class Entries:
    """A function for floats, and the places in the array of the generated one that it fills."""

    function: ScalarFunction
    places: tuple[tuple[int, ...], ...]


def scalar_rates(system: System) -> ScalarFunction | None:
    """The right-hand side for floats; None where its text is not at hand or cannot be rewritten.

    It raises an ArithmeticError or a ValueError where NumPy gives infinities or no number, also in
    between. Functions of the user are never called with floats.
    """
    rewritten = None if system.user_functions else _rewritten(system.rhs)
    rows = tuple((row,) for row in range(system.n_differential))
    return None if rewritten is None or rewritten.places != rows else rewritten.function


def scalar_jacobian(system: System) -> Entries | None:
    """The Jacobian for floats, as :func:`scalar_rates`: its entries that are not zero."""
    if system.user_functions:
        return None
    pattern = pattern_of(system.jacobian)
    if pattern is None:
        return _rewritten(system.jacobian)
    rewritten = _rewritten(pattern.entries)
    if rewritten is None:
        return None
    own = [*zip(pattern.rows.tolist(), pattern.columns.tolist(), strict=True)]
    return Entries(rewritten.function, tuple(own[k] for (k,) in rewritten.places))


@lru_cache(64)
def _rewritten(function: Callable[..., object]) -> Entries | None:
    """A generated function of t, u and p, rewritten."""
    if not isinstance(function, FunctionType):
        return None
    try:
        (definition,) = ast.parse(textwrap.dedent(inspect.getsource(function))).body
        if not isinstance(definition, ast.FunctionDef):
            return None
        places = _for_floats(definition)
        module = ast.Module([definition], type_ignores=[])
        own = {_PREFIX + name: meaning for name, meaning in (_FUNCTIONS | _CONSTANTS).items()}
        names = {**function.__globals__, **own, **_tables(function)}
        text = f"<{function.__name__} for floats>"
        exec(compile(ast.fix_missing_locations(module), text, "exec"), names)
    except (OSError, SyntaxError, ValueError, RecursionError, _Untranslatable):
        return None
    return Entries(names[function.__name__], tuple(places))


def _tables(function: FunctionType) -> dict[str, Callable[[float], float]]:
    """The tables of lines and of steps that a generated function applies, for floats."""
    tables: dict[str, Callable[[float], float]] = {}
    for name in function.__code__.co_names:
        table, data = function.__globals__.get(name), name.removeprefix(PREFIX)
        if not isinstance(table, FunctionType) or POINTS + data not in function.__globals__:
            continue
        points, values = (function.__globals__[each + data].tolist() for each in (POINTS, VALUES))
        for numpy_name, make in (("interp", _lines), ("searchsorted", _steps)):
            if numpy_name in table.__code__.co_names:
                tables[name] = make(points, values)
    return tables


def _lines(points: list[float], values: list[float]) -> Callable[[float], float]:
    """Straight lines between points, as ``np.interp`` has them; not a number outside."""
    pairs = itertools.pairwise(zip(points, values, strict=True))
    slopes = [(b - a) / (y - x) for (x, a), (y, b) in pairs]
    first, last, behind = points[0], points[-1], len(slopes)
    near = AT_THE_ENDS * (last - first)

    def value(x: float) -> float:
        inside = min(max(x, first), last)
        if not abs(inside - x) <= near:
            return math.nan
        k = bisect.bisect_right(points, inside) - 1
        return values[k] if k == behind else slopes[k] * (inside - points[k]) + values[k]

    return value


def _steps(points: list[float], values: list[float]) -> Callable[[float], float]:
    """The value of the last point before; not a number outside."""
    first, last = points[0], points[-1]
    near = AT_THE_ENDS * (last - first)

    def value(x: float) -> float:
        inside = min(max(x, first), last)
        return (
            values[bisect.bisect_right(points, inside) - 1] if abs(inside - x) <= near else math.nan
        )

    return value


def _for_floats(definition: ast.FunctionDef) -> list[tuple[int, ...]]:
    """Take the arrays out of a definition: what it computes for each place becomes a name."""
    body: list[ast.stmt] = []
    entries: list[ast.expr] = []
    places: list[tuple[int, ...]] = []
    expressions = _Expressions()
    for statement in definition.body:
        if isinstance(statement, ast.Return):
            break
        if isinstance(statement, ast.Expr):  # the docstring
            continue
        if not isinstance(statement, ast.Assign):
            raise _Untranslatable
        (target,) = statement.targets
        if isinstance(target, ast.Name) and target.id in ("shape", "out", "t"):
            continue  # the shape of all points, an array for the rows, and the time as an array
        if isinstance(target, ast.Subscript):
            if ast.unparse(target.value) != "out":
                raise _Untranslatable
            place = ast.literal_eval(target.slice)
            name = f"{_PREFIX}entry_{len(entries)}"
            target = ast.Name(name, ast.Store())
            entries.append(ast.Name(name, ast.Load()))
            places.append(place if isinstance(place, tuple) else (place,))
        body.append(ast.Assign([target], expressions.visit(statement.value)))
    if not entries or len({*places}) < len(places):
        raise _Untranslatable
    body.append(ast.Return(ast.List(entries, ast.Load())))
    definition.body = body
    return places


class _Expressions(ast.NodeTransformer):
    """Rewrites expressions of NumPy's functions."""

    def visit_Call(self, node: ast.Call) -> ast.expr:
        arguments = [self.visit(argument) for argument in node.args]
        module, _, name = ast.unparse(node.func).rpartition(".")
        if module != "np":
            return _float(ast.Call(node.func, arguments, []))
        if name == "where":
            condition, chosen, otherwise = arguments
            return ast.IfExp(condition, chosen, otherwise)
        if name in ("logical_and", "logical_or"):
            operator = ast.And() if name == "logical_and" else ast.Or()
            return ast.BoolOp(operator, arguments)
        if name == "logical_not":
            return ast.UnaryOp(ast.Not(), *arguments)
        return _call(name, arguments)

    def visit_Subscript(self, node: ast.Subscript) -> ast.expr:
        if ast.unparse(node.value) == _NUMBERS:
            return node
        return self._part(node)

    def visit_Attribute(self, node: ast.Attribute) -> ast.expr:
        if ast.unparse(node.value) == "np":
            if node.attr not in _CONSTANTS:
                raise _Untranslatable
            return ast.Name(_PREFIX + node.attr, ast.Load())
        return self._part(node)

    def visit_BinOp(self, node: ast.BinOp) -> ast.expr:
        left, right = self.visit(node.left), self.visit(node.right)
        if isinstance(node.op, ast.Pow) and not _is_integer(right):
            return _call("power", [left, right])
        return ast.BinOp(left, node.op, right)

    def _part(self, node: ast.Subscript | ast.Attribute) -> ast.expr:
        """A part of what a function of SciPy returns."""
        if not isinstance(node.value, ast.Call):
            raise _Untranslatable
        node.value.args = [self.visit(argument) for argument in node.value.args]
        return _float(node)


def _float(node: ast.expr) -> ast.expr:
    return ast.Call(ast.Name("float", ast.Load()), [node], [])


def _call(name: str, arguments: list[ast.expr]) -> ast.expr:
    if name not in _FUNCTIONS:
        raise _Untranslatable
    return ast.Call(ast.Name(_PREFIX + name, ast.Load()), arguments, [])


def _is_integer(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, int)


# -----------------------------------------------------------------------------
# Rates and Jacobians as LSODA calls them: for floats where they can be rewritten.


_COUNTED_CALLS = 100  # Calls of the rates that are charged at once
_LOOKED_CALLS = 3000  # Calls after which progress is looked at
_CALL_COST = Cost(600, 0.02)  # Operations of LSODA for a call: once, and for each cube of states
_FAILURES = (ArithmeticError, ValueError)  # What functions of floats raise instead of infinities

# Rates (n,) at a time and a state (n,), and their Jacobian (n, n)
Rates: TypeAlias = Callable[[float, Array], "Sequence[float] | Array"]
Jacobian: TypeAlias = Callable[[float, Array], Array]


class Border(Exception):
    """An integration gets no further: the rates are not finite at a time, or it creeps there.

    It is known to reach the time ``safe``.
    """

    def __init__(self, time: float, safe: float | None = None) -> None:
        super().__init__(time, safe)
        self.time, self.safe = time, safe


class Crawl(Border):
    """An integration is so slow that one that begins anew may be faster.

    After a jump of rates that are constant beyond it, LSODA's estimate of their slope, and so of
    the longest stable step, stays what it was across the jump.
    """


def called_by_lsoda(
    system: System, point: Array, span: tuple[float, float], horizon: float, *, restarts: bool
) -> tuple[Rates, Jacobian | None]:
    """Rates and Jacobian at a point (d,), taken within a span of time alone.

    The rates raise a Border where they are not finite, and after thousands of calls at almost the
    same time; with ``restarts`` a Crawl after as many not far from each other. The Jacobian is None
    where LSODA's own differences cost no more.
    """
    alone = None if system.at_point is None else system.at_point(point)
    function = None if alone else scalar_rates(system)
    stacked_cost = alone.cost if alone else function_cost(system.rhs, system.user_functions)(1)
    each = stacked_cost if function is None else scalar_cost(function)
    each += _CALL_COST.once
    differences = system.n_differential * each
    if alone:  # whose factors are counted where they are made
        jacobian: Jacobian | None = _counted(alone, system.n_differential)
    else:
        jacobian = _jacobian(system, point, span, differences)
        each += _CALL_COST.each * system.n_differential**3
    (first, last), numbers, column = span, point.tolist(), point[:, None]
    tiny, calls, looked_at = SAME * horizon, 0, -math.inf
    slow = COARSE * horizon if restarts else tiny

    def stacked(t: float, u: Array) -> Array:
        if function is not None:  # others are counted some calls at a time
            charge(stacked_cost)
        rates = alone.rates(t, u) if alone else system.rhs(t, u[:, None], column)[:, 0]
        if not np.isfinite(rates).all():
            raise Border(t)
        return np.asarray(rates)

    def rates(t: float, u: Array) -> Sequence[float] | Array:
        nonlocal calls, looked_at
        if not calls % _COUNTED_CALLS:
            charge(_COUNTED_CALLS * each)
            if not calls % _LOOKED_CALLS:
                if abs(t - looked_at) < slow:
                    raise Border(t, looked_at) if abs(t - looked_at) < tiny else Crawl(t)
                looked_at = t
        calls += 1
        time = min(max(t, first), last)
        if function is None:
            return stacked(time, u)
        try:
            slopes = function(time, u.tolist(), numbers)
        except _FAILURES:
            return stacked(time, u)
        return slopes if math.isfinite(sum(slopes)) else stacked(time, u)

    return rates, jacobian


def _jacobian(
    system: System, point: Array, span: tuple[float, float], differences: float
) -> Jacobian | None:
    """The Jacobian, where it costs fewer operations than ``differences`` of the rates."""
    entries = scalar_jacobian(system)
    if entries is None:
        return None
    cost = 5 * CALL + scalar_cost(entries.function)  # of the entries, and of the matrix
    if cost >= differences:
        return None
    (first, last), numbers, n = span, point.tolist(), system.n_differential
    rows, columns = np.array(entries.places, dtype=np.intp).reshape(-1, 2).T
    function = entries.function

    def jacobian(t: float, u: Array) -> Array:
        charge(cost)
        matrix, time = np.zeros((n, n)), min(max(t, first), last)
        try:
            matrix[rows, columns] = function(time, u.tolist(), numbers)
        except _FAILURES:
            matrix = jacobians(system, point[None], time, u)[0]
        return np.asarray(finite_blocks(matrix[None])[0])

    return jacobian


def _counted(alone: PointRates, n: int) -> Jacobian:
    """The Jacobian at a point, of a system that has it; each is factored once."""
    cost = 2.0 * alone.cost + inverse(n, real=True) / 3.0  # factors are a third

    def jacobian(t: float, u: Array) -> Array:
        charge(cost)
        return np.asarray(finite_blocks(alone.jacobian(t, u)[None])[0])

    return jacobian


def recording(rates: Rates, called: list[float]) -> Rates:
    """Rates that append the times at which they are called."""

    def recorded(t: float, u: Array) -> Sequence[float] | Array:
        called.append(t)
        return rates(t, u)

    return recorded
