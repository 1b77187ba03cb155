"""What a solve came to, held against SciPy on stacked trajectories at points of its own."""

from __future__ import annotations

import itertools
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.integrate
import sympy as sp

import rankone as ro
from rankone.problem.functions import Table
from tests.honesty import impacts, narrow, orders, switches  # register their kinds
from tests.honesty.cases import Case, case, t

__all__ = ["Verdict", "impacts", "judged", "narrow", "orders", "switches", "tried"]

WITHIN = 5.0
"""Errors of a success, over rtol, from which it is wrong."""
POINTS, TIMES = 500, 21
_SINGLE = 25
"""Points at which single trajectories are integrated."""
_FEW = 8
"""Points at which trajectories with narrow steps are integrated."""
_NARROW = 1e-7
"""Their width."""
LONGEST = 30.0
"""Seconds after which a solve is slow."""
_ACCURACY, _STEPS = 1e-9, 20_000
_MOST_UNDECIDED = 0.01
"""Share of the box in which the order of events may be undecided."""
_FEW_UNDECIDED = 2
"""Points of 25 that such a share leaves without values, but once in five hundred cases."""
_LARGEST_LEVEL = 12
"""Level of a staircase up to which its steps are narrow ones."""
_REST = 100
"""Floating-point numbers to the end of a segment from which it is reached."""
_LARGEST_LOG = 100
"""Logarithm of numbers that stay outside."""
_APART = 1e-13
"""Cuts closer to the ends, in horizons, are the ends."""


@dataclass(frozen=True)
class Verdict:
    """How a case ended: ``ok``, ``refused``, ``wrong``, ``error``, ``slow`` or ``unknown``.

    Attributes
    ----------
    kept : float
        Largest error at the points of a success over rtol.
    """

    verdict: str
    kept: float
    seconds: float
    message: str


def tried(seed: int, kind: str, method: str, one: bool = False) -> tuple[int, str, Verdict]:
    """The seed, the name and the verdict of the case of a kind, or of one of its unknowns."""
    made = case(kind, seed)
    asked = seed % len(made.unknowns) if one else None
    return seed, made.name, judged(made, asked=asked, method=method)


def judged(
    case: Case,
    longest: float = LONGEST,
    asked: int | None = None,
    points: int = POINTS,
    **options: object,
) -> Verdict:
    """Solve a case and judge the result; beyond this many seconds it is slow.

    Perhaps one unknown alone is asked for, by position.
    """
    began = time.perf_counter()
    if asked is not None:
        options["unknowns"] = [case.unknowns[asked]]
    solution = None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ro.RankoneWarning)
            solution = ro.solve(case.problem(), case.rtol, **options)  # type: ignore[arg-type]
        message = f"{solution.method}: {solution.message}"
    except ro.RankoneError as error:
        message = f"{type(error).__name__}: {error}"
    except Exception as error:  # what nobody should ever see
        return Verdict("error", np.inf, time.perf_counter() - began, f"{error!r}")
    seconds = time.perf_counter() - began
    if solution is None or not solution.success:
        return Verdict("slow" if seconds > longest else "refused", np.nan, seconds, message)
    points = sampled(case)[:, :points]
    times = np.linspace(0.0, case.end, TIMES)
    try:
        if case.events:
            points = points[:, :_SINGLE]
            exact, beside = single(case, points, times)
        elif case.switches:
            points = points[:, :_FEW]
            exact, beside = smoothed(case, points, times), np.zeros((1, times.size), dtype=bool)
        else:
            exact, beside = truth(case, points, times), np.zeros((1, times.size), dtype=bool)
    except (TimeoutError, ro.RankoneError):
        return Verdict("unknown", np.nan, seconds, message)
    exact = exact if asked is None else exact[[asked]]
    values = {str(symbol): p[:, None] for symbol, p in zip(case.box, points, strict=True)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ro.RankoneWarning)
        solved = solution(t=times[None, :], **values)
    undecided = getattr(solution.outcome.timeline, "undecided", 0.0)
    if 0.0 < undecided <= _MOST_UNDECIDED:  # at points on a declared sliver there are no values
        sliver = np.isnan(solved).any(axis=(0, 2))
        if sliver.sum() <= _FEW_UNDECIDED:
            beside = beside | sliver[:, None]
    if case.events or beside.any():  # after the end of time both are NaN
        beside |= np.isnan(exact).all(axis=0) & np.isnan(solved).all(axis=0)
        exact, solved = np.where(beside, 0.0, exact), np.where(beside, 0.0, solved)
    size = np.abs(exact).max(axis=(1, 2))
    errors = np.abs(solved - exact).max(axis=(1, 2)) / np.where(size > 0.0, size, 1.0)
    kept = float(np.nan_to_num(errors, nan=np.inf).max()) / case.rtol
    verdict = "wrong" if kept > WITHIN else "slow" if seconds > longest else "ok"
    return Verdict(verdict, kept, seconds, message)


def single(case: Case, points: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Trajectories (n, points, times) from the equations as they are written.

    And which times (points, times) are beside an event, within rtol horizons.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ro.RankoneWarning)
        problem, names = case.problem(), [str(symbol) for symbol in case.box]
    exact, beside = [], []
    for point in points.T:
        run = problem.trajectory(times, rtol=1e-9, **dict(zip(names, point, strict=True)))
        exact.append(np.asarray(run))
        happened = np.concatenate([[np.inf], *run.events.values()])
        beside.append(np.abs(times[:, None] - happened).min(axis=1) <= case.rtol * case.end)
    return np.stack(exact, axis=1), np.array(beside)


def smoothed(case: Case, points: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Trajectories (n, points, times) whose switches are narrow steps, by implicit steps."""

    def step(x: sp.Expr) -> sp.Expr:
        return (1 + sp.tanh(x / _NARROW)) / 2

    names = [sp.Dummy(real=True) for _ in case.unknowns]
    plain = dict(zip(case.unknowns, names, strict=True))
    rates = [
        rate.xreplace(plain)
        .replace(sp.Piecewise, lambda *pairs: _blended(pairs, step))
        .replace(sp.sign, lambda x: 2 * step(x) - 1)
        .replace(sp.Heaviside, lambda x, *_: step(x))
        .replace(sp.frac, lambda x: x - sp.floor(x))
        .replace(sp.Mod, lambda x, period: x - period * sp.floor(x / period))
        .replace(sp.ceiling, lambda x: -sp.floor(-x))
        .replace(sp.floor, lambda x: _staircase(x, step))
        .replace(_is_table, lambda table: _blended_table(table, step))
        for rate in case.rates
    ]
    arguments = [t, names, list(case.box)]
    rhs = sp.lambdify(arguments, rates, "math")
    slopes = sp.lambdify(arguments, sp.Matrix(rates).jacobian(names), "numpy")
    exact = []
    for point, start in zip(points.T, _starts(case, points).T, strict=True):
        run = scipy.integrate.solve_ivp(
            lambda now, u, p=point: rhs(now, u.tolist(), p.tolist()),
            (0.0, case.end),
            start,
            "Radau",
            times,
            jac=lambda now, u, p=point: slopes(now, u, p),
            rtol=1e-8,
            atol=1e-10,
        )
        if not run.success:
            raise TimeoutError
        exact.append(run.y)
    return np.stack(exact, axis=1)


def _staircase(x: sp.Expr, step: Callable[[sp.Expr], sp.Expr]) -> sp.Expr:
    """The floor of x, as far as it goes, as a sum with narrow steps."""
    levels = range(-_LARGEST_LEVEL, _LARGEST_LEVEL)
    return sp.Add(levels[0] - 1, *(step(x - level) for level in levels))


def _is_table(node: sp.Basic) -> bool:
    return isinstance(node, Table)


def _blended_table(applied: Table, step: Callable[[sp.Expr], sp.Expr]) -> sp.Expr:
    """A table as a sum over its pieces, each between two narrow steps."""
    x, places, values = applied.args[0], applied.points, applied.values
    total = sp.S.Zero
    for a, b, first, last in zip(places, places[1:], values, values[1:]):
        slope = 0.0 if applied.kind == "previous" else (last - first) / (b - a)
        total += (step(x - a) - step(x - b)) * (first + slope * (x - a))
    return total


def _blended(pairs: Sequence[tuple], step: Callable[[sp.Expr], sp.Expr]) -> sp.Expr:
    """A piecewise function whose conditions are inequalities, as a sum with narrow steps."""
    total, rest = sp.S.Zero, sp.S.One
    for branch, condition in pairs:
        share = sp.S.One if condition == True else step(condition.gts - condition.lts)  # noqa: E712
        total, rest = total + rest * share * branch, rest * (1 - share)
    return total


def _starts(case: Case, points: np.ndarray) -> np.ndarray:
    """Initial values (n, points)."""
    start = sp.lambdify([list(case.box)], case.initial, ["numpy", "scipy"])
    return np.stack([np.broadcast_to(v, points.shape[1]) for v in start(points)]).astype(float)


def sampled(case: Case) -> np.ndarray:
    """Points (d, POINTS): random ones, a third of them where something narrow is."""
    generator = np.random.default_rng(77)
    bounds = np.array(list(case.box.values()), dtype=float)
    points = bounds[:, :1] + np.diff(bounds, axis=1) * generator.random((len(bounds), POINTS))
    names = list(case.box)
    for i, (symbol, place, half) in enumerate(case.places):
        j, some = names.index(symbol), slice(i, None, 3 * len(case.places))
        middle, width = (_at(case, value, points[:, some]) for value in (place, half))
        near = middle + width * generator.uniform(-1, 1, middle.size)
        points[j, some] = np.where(np.isfinite(near), np.clip(near, *bounds[j]), points[j, some])
    return points


def _at(case: Case, value: object, points: np.ndarray) -> np.ndarray:
    """An expression of the parameters at points (d, m)."""
    with np.errstate(all="ignore"):
        found = sp.lambdify([list(case.box)], value, ["numpy", "scipy"])(points)
    return np.broadcast_to(np.asarray(found, dtype=float), points.shape[1])


def _passing(case: Case, points: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Trajectories (1, points, times) from the times at which values are passed: by bisection."""
    (x,) = case.unknowns
    name = sp.Dummy()
    passed = case.passed.xreplace({x: name})
    when = sp.lambdify([name, list(case.box)], passed, ["numpy", "scipy"])
    start = _at(case, case.initial[0], points)[:, None] * np.ones(times.size)
    step = np.ones_like(start)
    lower, upper = start.copy(), start + step
    while (short := when(upper, points[:, :, None]) < times).any():
        upper = np.where(short, upper + step, upper)
        step *= 2
    for _ in range(80):
        middle = 0.5 * (lower + upper)
        late = when(middle, points[:, :, None]) > times
        lower, upper = np.where(late, lower, middle), np.where(late, middle, upper)
    return np.asarray(0.5 * (lower + upper))[None]


def truth(case: Case, points: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Trajectories (n, points, times); NaN where there are none."""
    if case.passed is not None:
        return _passing(case, points, times)
    n, m = len(case.unknowns), points.shape[1]
    names = [sp.Dummy() for _ in case.unknowns]
    plain = [
        _finite(rate.xreplace(dict(zip(case.unknowns, names, strict=True)))) for rate in case.rates
    ]
    rhs = sp.lambdify([t, names, list(case.box)], plain, [_tables(case), "numpy", "scipy"])
    state = _starts(case, points)
    values = np.full((n, m, times.size), np.nan)
    values[:, :, 0] = state
    cuts = np.concatenate([[0.0], *(_at(case, cut, points) for cut in case.cuts)])
    inside = cuts[(cuts > _APART * case.end) & (cuts < (1.0 - _APART) * case.end)]
    edges = np.unique([0.0, *inside, *case.jumps, case.end])
    scale = np.maximum(np.abs(state).max(axis=1, keepdims=True), 1e-3)
    for a, b in itertools.pairwise(edges):
        if a in case.jumps:
            state = _jumped(case, a, names, state, points)
            values[:, :, times == a] = state[:, :, None]
        inset = min(max(1e-9 * (b - a), 8 * np.spacing(b)), 0.25 * (b - a))

        def rate(now: float, u: np.ndarray, a: float = a, b: float = b, i: float = inset):
            inside = min(max(now, a + i), b - i)
            return _flat(rhs(inside, u.reshape(n, m), points), m)

        solver = _stepper(rate, a, state.ravel(), b, scale, m)
        for _ in range(_STEPS):
            if solver.status != "running":
                break
            solver.step()
            if solver.status == "failed":
                if b - solver.t <= _REST * np.spacing(b):
                    break  # SciPy makes no step of so few floating-point numbers
                return values
            inner = (times > solver.t_old) & (times <= solver.t)
            values[:, :, inner] = solver.dense_output()(times[inner]).reshape(n, m, -1)
        else:
            raise TimeoutError
        state = solver.y.reshape(n, m)
    return values


def _jumped(case: Case, at: float, names: list, state: np.ndarray, points: np.ndarray):
    """States (n, points) after a jump."""
    known = dict(zip(case.unknowns, names, strict=True))
    reset = [case.jumps[at].get(u, u).xreplace(known) for u in case.unknowns]
    after = sp.lambdify([names, list(case.box)], reset, ["numpy", "scipy"])(state, points)
    return np.stack([np.broadcast_to(value, points.shape[1]) for value in after]).astype(float)


def _finite(rate: sp.Expr) -> sp.Expr:
    """A rate without numbers beyond floating point, which SymPy takes out of exponentials."""

    def joined(product: sp.Mul) -> sp.Expr:
        number, rest = product.as_coeff_Mul()
        factors = sp.Mul.make_args(rest)
        inside = next((part for part in factors if isinstance(part, sp.exp)), None)
        size = sp.N(sp.log(abs(number)), 20)
        if inside is None or abs(size) < _LARGEST_LOG:
            return product
        others = [part for part in factors if part is not inside]
        exponent = sp.nsimplify(inside.exp, rational=True) + sp.Rational(str(size))
        return sp.Mul(sp.sign(number), sp.exp(exponent), *others)

    return rate.replace(lambda part: part.is_Mul and part.args[0].is_Float, joined)


def _tables(case: Case) -> dict[str, object]:
    """Functions of data in the rates, by name."""
    found = set().union(*(rate.atoms(sp.Function) for rate in case.rates))
    made = {type(part) for part in found if hasattr(type(part), "points")}
    return {f.__name__: partial(np.interp, xp=f.points, fp=f.values) for f in made}


def _stepper(rate, a, y, b, scale, m):
    """An integrator of a stack."""
    atol = np.repeat(_ACCURACY * 1e-3 * scale, m, axis=1).ravel()
    longest = (b - a) / 25
    return scipy.integrate.DOP853(rate, a, y, b, rtol=_ACCURACY, atol=atol, max_step=longest)


def _flat(parts: list[object], m: int) -> np.ndarray:
    return np.concatenate([np.broadcast_to(part, m) for part in parts]).astype(float)
