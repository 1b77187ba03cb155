"""The features of a system: all that is not smooth, or so narrow that samples may miss it.

They are derived here once, as expressions, and printed into the generated module; numeric code sees
them as :class:`rankone.ir.features.Features`. Switches whose times move with parameters are cuts of
each trajectory. Functions of the unknowns, such as a pulse ``Piecewise((1, (x > 2) & (x < 2.001)),
(0, True))``, are looked at where a step crosses them. Surfaces in the space of the parameters are
where further trajectories are checked.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.ir.forms import Coordinate
from rankone.ir.verdict import SwitchingTerm
from rankone.support.wording import quote, written
from rankone.symbolic.cuts import Cuts, cuts_of
from rankone.symbolic.derivatives import slope
from rankone.symbolic.first_order import FirstOrderSystem
from rankone.symbolic.surfaces import (
    CONTINUOUS,
    DISCONTINUOUS,
    boundaries,
    peaks,
    steps,
    subexpressions,
    valleys,
)

_MAX_SURFACES = 64  # Surfaces of each sort: every check point and step evaluates them all
# Second derivative of an exponent times the squared horizon: above this, steps may miss a peak
_NARROW_CURVATURE = 1e4


@dataclass(frozen=True)
class SymbolicFeatures:
    """Where expressions of a system are not smooth; see :class:`rankone.ir.features.Features`.

    Attributes
    ----------
    cuts : tuple of Cuts
        For each coordinate.
    moving_cuts, parameter_surfaces : tuple of Expr
    peaks, kinks, steps : tuple of Expr
        The surfaces over the states.
    """

    cuts: tuple[Cuts, ...]
    moving_cuts: tuple[sp.Expr, ...]
    parameter_surfaces: tuple[sp.Expr, ...]
    peaks: tuple[sp.Expr, ...]
    kinks: tuple[sp.Expr, ...]
    steps: tuple[sp.Expr, ...]

    @property
    def state_surfaces(self) -> tuple[sp.Expr, ...]:
        """The middles of peaks, then kinks, then steps."""
        return (*self.peaks, *self.kinks, *self.steps)


def features_of(
    coordinates: Sequence[Coordinate], rates: Sequence[sp.Expr], further: Sequence[sp.Expr]
) -> SymbolicFeatures:
    """All features of a system: the one place that derives them.

    Parameters
    ----------
    coordinates : sequence of Coordinate
        Time, then the parameters.
    rates : sequence of Expr
        Right-hand sides that do not separate; none if they do.
    further : sequence of Expr
        Initial values, values after jumps, and the factors of a right-hand side that separates.
    """
    expressions = [*rates, *further]
    return SymbolicFeatures(
        cuts_of(coordinates, expressions),
        _moving_cuts(coordinates, rates),
        _parameter_surfaces(coordinates, expressions),
        *_state_surfaces(coordinates[0].symbol, rates),
    )


def _moving_cuts(
    coordinates: Sequence[Coordinate], rates: Sequence[sp.Expr]
) -> tuple[sp.Expr, ...]:
    """Times, as functions of the parameters, at which functions of both switch or are narrow.

    Boundaries that are linear in time, and the middles of narrow exponentials of squares.
    """
    t, symbols = coordinates[0].symbol, {c.symbol for c in coordinates}
    times = set(_moving_peaks(coordinates, rates))
    for boundary, levels in boundaries(rates):
        rate, involved = slope(boundary, t), boundary.free_symbols
        if boundary.has(AppliedUndef) or len(involved) < 2 or not involved <= symbols:
            continue
        if rate not in (0, sp.nan) and not rate.has(t):
            times.update((sp.Rational(v) - boundary.subs(t, 0)) / rate for v in levels or ())
    return tuple(sorted(times, key=sp.default_sort_key))


def _moving_peaks(coordinates: Sequence[Coordinate], rates: Sequence[sp.Expr]) -> Iterator[sp.Expr]:
    """Times, as functions of the parameters, of the peaks of narrow exponentials of squares."""
    clock, *parameters = coordinates
    t, symbols = clock.symbol, {c.symbol for c in coordinates}
    centre = {p.symbol: sp.Float(0.5 * (p.lower + p.upper)) for p in parameters}
    for node in subexpressions(rates, sp.exp):
        exponent, involved = node.exp, node.exp.free_symbols
        if len(involved) < 2 or not involved <= symbols or exponent.has(AppliedUndef):
            continue
        rate = slope(exponent, t)
        curvature = slope(rate, t)
        if curvature in (0, sp.nan) or curvature.has(t):
            continue
        size = abs(curvature.subs(centre)) * (clock.upper - clock.lower) ** 2
        if size.is_number and size > _NARROW_CURVATURE:
            yield -rate.subs(t, 0) / curvature


def _state_surfaces(
    time: sp.Symbol, rates: Sequence[sp.Expr]
) -> tuple[tuple[sp.Expr, ...], tuple[sp.Expr, ...], tuple[sp.Expr, ...]]:
    """Functions of the unknowns, or of time, that vanish in peaks, at kinks and at steps.

    Each is in the first of these only; there are at most 64 in all.
    """

    def moving(expression: sp.Basic) -> set[sp.Expr]:
        unknowns = set(expression.atoms(AppliedUndef))
        return unknowns | (expression.free_symbols & {time} if not unknowns else set())

    of_steps = (middle for _, middle in steps(rates, moving))
    sorts = (
        (middle for _, middle in peaks(rates, moving)),
        _zeros(rates, CONTINUOUS),
        itertools.chain(of_steps, _zeros(rates, DISCONTINUOUS)),
    )
    surfaces: set[sp.Expr] = set()
    by_sort = []
    for functions in sorts:
        distinct = (f for f in _distinct(filter(moving, functions)) if not surfaces & {f, -f})
        by_sort.append(tuple(itertools.islice(distinct, _MAX_SURFACES - len(surfaces))))
        surfaces.update(by_sort[-1])
    middles, kinks, jumps = by_sort
    return middles, kinks, jumps


def _parameter_surfaces(
    coordinates: Sequence[Coordinate], expressions: Sequence[sp.Expr]
) -> tuple[sp.Expr, ...]:
    """Functions of several parameters that vanish, or are least, where others are narrow."""
    parameters = {coordinate.symbol for coordinate in coordinates[1:]}

    def variables(expression: sp.Basic) -> list[sp.Expr]:
        return sorted(expression.free_symbols & parameters, key=str)

    narrow = itertools.chain(peaks(expressions, variables), steps(expressions, variables))
    surfaces = itertools.chain(
        (middle for _, middle in narrow),
        valleys(expressions),
        _zeros(expressions, (*CONTINUOUS, *DISCONTINUOUS)),
    )
    of_parameters = (f for f in surfaces if f.free_symbols <= parameters)
    several = (f for f in of_parameters if len(f.free_symbols) > 1 and not f.has(AppliedUndef))
    return tuple(_distinct(several)[:_MAX_SURFACES])


def _zeros(expressions: Sequence[sp.Expr], functions: tuple[type, ...]) -> Iterator[sp.Expr]:
    """Functions whose zeros are where some functions are not smooth."""
    for boundary, levels in boundaries(expressions, functions):
        if levels is None:
            yield sp.sin(sp.pi * boundary)
        elif len(levels) <= _MAX_SURFACES:
            yield from (boundary - sp.Rational(level) for level in levels)


def _distinct(functions: Iterable[sp.Expr]) -> list[sp.Expr]:
    """Each once up to its sign, in SymPy's order."""
    kept: dict[sp.Expr, None] = {}
    for function in sorted(set(functions), key=sp.default_sort_key):
        if -function not in kept:
            kept[function] = None
    return list(kept)


def switching_term(system: FirstOrderSystem, state: int | None = None) -> SwitchingTerm | None:
    """Which term switches over the unknowns, and how to smooth it; None if there is none.

    Parameters
    ----------
    system : FirstOrderSystem
    state : int, optional
        The state whose rate is known to switch; by default the first that may.
    """
    plain = {
        f: sp.Symbol(state.name) for f, state in zip(system.functions, system.states, strict=True)
    }
    for index in range(len(system.rhs)) if state is None else (state,):
        for term in sp.Add.make_args(system.rhs[index]):
            switches = [
                boundary
                for boundary, levels in boundaries([term], DISCONTINUOUS)
                if levels is not None and boundary.has(AppliedUndef)
            ]
            if not switches:
                continue
            boundary = min(switches, key=sp.default_sort_key).xreplace(plain)
            origin = system.origins[index]
            equation = f"the equation of {quote(system.states[index].name)}"
            equation = equation if origin is None else f"equation {origin}"
            smooth = f"tanh({boundary}/w)" if boundary.is_Symbol else f"tanh(({boundary})/w)"
            return SwitchingTerm(written(term.xreplace(plain)), equation, written(boundary), smooth)
    return None
