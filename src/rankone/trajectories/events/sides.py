"""Systems on the sides of their switches: rates as smooth as the sides are known numbers."""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from types import FunctionType

import numpy as np
from scipy import special

from rankone.support.arrays import Array
from rankone.support.costs import Cost, function_cost
from rankone.support.precision import COINCIDENT, NEGLIGIBLE
from rankone.trajectories.events.event_order import OrderError, at_point, at_time
from rankone.trajectories.system.events import OfTrajectory, Row, SystemEvent
from rankone.trajectories.system.features import OfStates, VectorLike
from rankone.trajectories.system.system import Clock, System

# Of a stretch, where its sides are checked, also next to its ends: something narrow may be there
_SHARES = np.array([NEGLIGIBLE, 0.02, 0.2, 0.5, 0.8, 0.98, 1.0 - NEGLIGIBLE])
_BESIDE = 1e-5  # Distance beyond a surface, over the largest one, that is rounding and tolerance


def check_sides(clock: Clock, states: Array, times: Array, points: Array) -> None:
    """Raise an OrderError if a trajectory is not on the sides that its rates are of.

    So the rates are those of the system as it was written, almost everywhere.

    Parameters
    ----------
    clock : Clock
        Of the trajectories.
    states : ndarray (n, m, stretches, shares)
        Of the system, with its sides, at m points.
    times : ndarray (m, stretches, shares)
        Clock times.
    points : ndarray (m, d)
    """
    system = clock.system
    first = len(states) - system.n_sides
    p = np.broadcast_to(points.T[:, :, None, None], (points.shape[1], *times.shape))
    lengths = np.ptp(times, axis=2, keepdims=True)
    long = np.broadcast_to(lengths > _BESIDE * clock.length, times.shape).ravel()
    flat = states.reshape(len(states), -1), times.ravel(), p.reshape(points.shape[1], times.size)
    crossings = (event for event in system.events if event.switch and event.then is not None)
    for k, event in enumerate(crossings, first):
        sides = np.rint(flat[0][k])
        above = flat[0].copy()
        above[k] = 1.0
        with np.errstate(all="ignore"):
            heights = np.broadcast_to(event.when(flat[1], above, flat[2]), sides.shape)
            stays = np.broadcast_to(event.when(flat[1], flat[0], flat[2]), sides.shape)
        slides = sides == 0.0
        beyond = np.where(slides, np.abs(heights), -sides * heights)
        held_back = np.sqrt(np.abs(stays[slides]).max(initial=0.0)) * clock.length
        wrong = beyond > _BESIDE * np.abs(heights).max() + COINCIDENT * held_back
        wrong |= slides & (stays < -_BESIDE * np.abs(stays).max())
        wrong &= long
        if wrong.any():
            at = int(np.flatnonzero(wrong)[0])
            point = np.unravel_index(at, times.shape)[0]
            raise OrderError(
                f"{event.name} is not on the side that it is held on"
                f"{at_time(clock, flat[1][at])}{at_point(clock, points[point])}",
                remedy="narrow the box, or smooth the switch",
            )


def times_to_check(borders: Array) -> Array:
    """Clock times (m, stretches, shares) to check sides at, of borders (m, stretches + 1)."""
    lengths = np.diff(borders, axis=1)
    return np.asarray(borders[:, :-1, None] + lengths[:, :, None] * _SHARES)


@dataclass(frozen=True, eq=False)
class _OnSides:
    """A ``function`` of states and of sides, as one of states alone, and ``rows`` of it."""

    function: Callable[..., Array]
    sides: Array
    rows: tuple[slice, ...]
    cost: Cost

    def __call__(self, t: float | Array, u: VectorLike, p: VectorLike) -> Array:
        return np.asarray(self.function(t, [*u, *self.sides], p))[self.rows]


@lru_cache(64)
def on_sides(system: System, sides: tuple[int, ...]) -> System:
    """The system of trajectories that all stay on some sides: these are no states of it."""
    if not sides:
        return system
    n, known = system.n_differential - len(sides), tuple(map(float, sides))

    def alone(function: Callable[..., Array], *rows: slice) -> OfStates:
        cost = function_cost(function, system.user_functions)
        return _OnSides(function, np.array(known), rows, cost)

    def when(event: SystemEvent) -> OfTrajectory:
        if isinstance(event.when, Row):
            row = event.when.row
            function = of_known_states(event.when.function, known, (row,))
            if function is not None:
                return Row(function, row)
        return alone(event.when)

    rhs = of_known_states(system.rhs, known, tuple(range(n))) or alone(system.rhs, slice(n))
    return replace(
        system,
        states=system.states[:n],
        n_differential=n,
        n_sides=0,
        events=tuple(replace(event, when=when(event)) for event in system.events),
        rhs=rhs,
        jacobian=alone(system.jacobian, slice(n), slice(n)),
        features=replace(system.features, state_surfaces=alone(system.features.state_surfaces)),
    )


# -----------------------------------------------------------------------------
# Generated functions of states of which the last ones are known numbers.
#
# A generated function is arithmetic on arrays, which takes a microsecond for each operation however
# small the arrays. What follows from known numbers alone, such as sides of switches on a stretch,
# is computed once here, and branches of piecewise functions that they do not select are left out.
# What is multiplied by a known zero is left out as well, also where it is not finite: a branch that
# does not hold has no say.


_LIBRARIES = ("np", "special")  # Names of generated modules whose functions are pure
_LONGEST = 10_000  # Bytes of code of a function, beyond which this takes a tenth of a second


class _Unknown(Exception):
    """The text of a function is not laid out as that of generated functions of states."""


@lru_cache(256)
def of_known_states(
    function: OfStates, known: tuple[float, ...], rows: tuple[int, ...]
) -> OfStates | None:
    """A generated function of t, u and p without the last states, which have ``known`` values.

    It computes some rows, and has no more than are needed for them. None where its text is not at
    hand or very long, or has a number that is not finite.
    """
    if not isinstance(function, FunctionType) or len(function.__code__.co_code) > _LONGEST:
        return None
    try:
        (definition,) = ast.parse(textwrap.dedent(inspect.getsource(function))).body
        if not isinstance(definition, ast.FunctionDef):
            return None
        definition.body = _body(definition.body, known, rows)
        module = ast.fix_missing_locations(ast.Module([definition], type_ignores=[]))
        names: dict[str, Callable[..., np.ndarray]] = {}
        text = f"<{function.__name__} of known states>"
        exec(compile(module, text, "exec"), function.__globals__, names)
    except (OSError, SyntaxError, ValueError, ArithmeticError, RecursionError, _Unknown):
        return None
    return names[function.__name__]


def _body(
    statements: list[ast.stmt], known: tuple[float, ...], rows: tuple[int, ...]
) -> list[ast.stmt]:
    """The statements that some rows need, with what is known in place of names."""
    folding, kept = _Folding(), list[ast.stmt]()
    for statement in statements:
        if isinstance(statement, ast.Expr):  # the docstring
            continue
        if isinstance(statement, ast.Return):
            whole = ast.Slice(upper=ast.Constant(max(rows) + 1))
            if ast.unparse(statement) != "return out":
                raise _Unknown
            kept.append(ast.Return(ast.Subscript(ast.Name("out", ast.Load()), whole, ast.Load())))
            continue
        if not isinstance(statement, ast.Assign):
            raise _Unknown
        (target,) = statement.targets
        if isinstance(target, ast.Tuple) and ast.unparse(statement.value) == "u":
            first = len(target.elts) - len(known)
            names = map(ast.unparse, target.elts[first:])
            folding.known |= dict(zip(names, known, strict=True))
            target.elts = target.elts[:first]
        elif isinstance(target, ast.Subscript):
            row = ast.literal_eval(target.slice)
            if not isinstance(row, int) or ast.unparse(target.value) != "out":
                raise _Unknown
            if row not in rows:
                continue
        statement.value = folding.visit(statement.value)
        if isinstance(target, ast.Name):
            folding.known.pop(target.id, None)
            if (number := _number(statement.value)) is not None:
                folding.known[target.id] = number
                continue
        kept.append(statement)
    return _read(kept)


def _read(statements: list[ast.stmt]) -> list[ast.stmt]:
    """The statements without names that nothing reads."""
    read, kept = set[str](), list[ast.stmt]()
    for statement in reversed(statements):
        target = statement.targets[0] if isinstance(statement, ast.Assign) else None
        if isinstance(target, ast.Name) and target.id not in read:
            continue
        names = (node for node in ast.walk(statement) if isinstance(node, ast.Name))
        read |= {name.id for name in names if isinstance(name.ctx, ast.Load)}
        kept.append(statement)
    return kept[::-1]


class _Folding(ast.NodeTransformer):
    """Computes what follows from the numbers of ``known`` names."""

    def __init__(self) -> None:
        self.known: dict[str, float] = {}

    def visit_Name(self, node: ast.Name) -> ast.expr:
        return ast.Constant(self.known[node.id]) if node.id in self.known else node

    def visit_UnaryOp(self, node: ast.UnaryOp) -> ast.expr:
        self.generic_visit(node)
        return _value(node) if _number(node.operand) is not None else node

    def visit_Compare(self, node: ast.Compare) -> ast.expr:
        self.generic_visit(node)
        sides = [node.left, *node.comparators]
        return node if None in map(_number, sides) else _value(node)

    def visit_BinOp(self, node: ast.BinOp) -> ast.expr:
        self.generic_visit(node)
        left, right = _number(node.left), _number(node.right)
        if left is not None and right is not None:
            return _value(node)
        if isinstance(node.op, ast.Mult):
            if 0.0 in (left, right):
                return ast.Constant(0.0)
            if left == 1.0:
                return node.right
        if isinstance(node.op, ast.Add) and left == 0.0:
            return node.right
        if isinstance(node.op, ast.Mult | ast.Div) and right == 1.0:
            return node.left
        if isinstance(node.op, ast.Add | ast.Sub) and right == 0.0:
            return node.left
        return node

    def visit_Call(self, node: ast.Call) -> ast.expr:
        self.generic_visit(node)
        module, _, name = ast.unparse(node.func).rpartition(".")
        numbers = [*map(_number, node.args)]
        if module not in _LIBRARIES or node.keywords or not node.args:
            return node
        if name == "broadcast":  # numbers change no shape
            node.args = [each for each in node.args if _number(each) is None]
            return node
        if name == "where" and numbers[0] is not None:
            return node.args[1 if numbers[0] else 2]
        if name in ("logical_and", "logical_or"):
            for this, other in ((0, 1), (1, 0)):
                if numbers[this] is not None:
                    decided = bool(numbers[this]) == (name == "logical_or")
                    return node.args[this if decided else other]
        return node if None in numbers else _value(node)


def _number(node: ast.expr) -> float | None:
    """The number that an expression is, if it is one."""
    if isinstance(node, ast.Constant) and isinstance(node.value, bool | int | float):
        return node.value
    return None


def _value(node: ast.expr) -> ast.Constant:
    """The value of an expression of numbers."""
    module = ast.fix_missing_locations(ast.Expression(node))
    with np.errstate(all="ignore"):
        value = eval(compile(module, "<numbers>", "eval"), {"np": np, "special": special})
    if isinstance(value, bool | np.bool_):
        return ast.Constant(bool(value))
    if not np.isfinite(value) or np.iscomplexobj(value):
        raise _Unknown
    return ast.Constant(value if isinstance(value, int) else float(value))
