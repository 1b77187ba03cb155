"""The compiled model of a calibration problem, and its slopes in what varies.

It is compiled once. What varies between conditions, and all parameters of the table, are its
parameters; a condition is a point.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.inference.calibration.calibrated_parameters import Parameter, Records
from rankone.inference.calibration.experiment_conditions import Settings
from rankone.problem.expressions.boundaries import DISCONTINUOUS, boundaries
from rankone.problem.expressions.derivatives import Differentiator
from rankone.problem.expressions.stable import NUMPY, in_floats, stable
from rankone.solution.compiled import CompiledProblem, compile_problem
from rankone.support.arrays import Array
from rankone.support.errors import ProblemError
from rankone.support.wording import quote
from rankone.trajectories.system.system import System

_SPREAD = 2.0  # Around a nominal value, of the box that the problem is compiled over
_USUAL_END = 1.0  # Of the horizon where everything is measured at a steady state

Entries = Callable[..., Sequence[Any]]


class Dynamics:
    """A compiled model.

    Attributes
    ----------
    compiled : CompiledProblem
    inputs : tuple of str
        The parameters of the compiled problem: what varies.
    """

    def __init__(self, records: Records, settings: Settings) -> None:
        self.inputs = settings.varying
        end = records.last_time or _USUAL_END
        box = {name: _interval(records, settings, name) for name in self.inputs}
        problem = records.model.with_numbers(settings.constant).problem(box, time=(0.0, end))
        self.compiled: CompiledProblem = compile_problem(problem)

    def __getstate__(self) -> dict[str, Any]:
        """What is sent to workers: they write the functions of the derivatives anew."""
        return {"inputs": self.inputs, "compiled": self.compiled}

    @property
    def system(self) -> System:
        """The generated module."""
        return self.compiled.system

    @cached_property
    def _symbols(self) -> dict[sp.Expr, sp.Dummy]:
        """Real symbols for time, states and parameters, in the order of arguments."""
        form = self.compiled.first_order
        variables = [
            form.coordinates[0].symbol,
            *form.functions,
            *(each.symbol for each in form.coordinates[1:]),
        ]
        return {variable: sp.Dummy(real=True) for variable in variables}

    @cached_property
    def jumps_with_states(self) -> bool:
        """Whether rates jump where states cross a threshold."""
        return jumps_with_states(self.compiled)

    @cached_property
    def decisive(self) -> frozenset[str]:
        """Inputs that decide where rates jump: nothing can be differentiated by them."""
        return deciding_jumps(self.compiled)

    @cached_property
    def _rate_entries(self) -> _SlopeFunction:
        return _SlopeFunction(self.compiled.first_order.rhs, self._symbols, len(self.inputs))

    @cached_property
    def _initial_entries(self) -> _SlopeFunction:
        return _SlopeFunction(self.compiled.first_order.initial, self._symbols, len(self.inputs))

    def rate_slopes(self, times: Array, states: Array, points: Array) -> Array:
        """Derivatives (n, d, N) of rates by the inputs, at states (n, N) and points (N, d)."""
        return self._rate_entries(times, states, points)

    def initial_slopes(self, points: Array) -> Array:
        """Derivatives (n, d, m) of initial values by the inputs, at points (m, d)."""
        nothing = np.full((self.system.n_differential, len(points)), np.nan)
        return self._initial_entries(np.zeros(len(points)), nothing, points)


def jumps_with_states(compiled: CompiledProblem) -> bool:
    """Whether rates jump where states cross a threshold: derivatives of trajectories jump there."""
    surfaces = (surface for surface, _ in boundaries(compiled.first_order.rhs, DISCONTINUOUS))
    return any(surface.atoms(AppliedUndef) for surface in surfaces)


def deciding_jumps(compiled: CompiledProblem) -> frozenset[str]:
    """The parameters that decide where rates or initial values jump."""
    form = compiled.first_order
    surfaces = [s for s, _ in boundaries([*form.rhs, *form.initial], DISCONTINUOUS)]
    symbols = {symbol.name for surface in surfaces for symbol in surface.free_symbols}
    return frozenset(symbols & {each.symbol.name for each in form.coordinates[1:]})


class _SlopeFunction:
    """Derivatives of expressions by the last d of some variables."""

    def __init__(
        self, expressions: Sequence[sp.Expr], symbols: dict[sp.Expr, sp.Dummy], d: int
    ) -> None:
        self._shape = len(expressions), d
        plain = [expression.xreplace(symbols) for expression in expressions]
        arguments = list(symbols.values())
        derivatives = [Differentiator(symbol) for symbol in arguments[len(arguments) - d :]]
        entries = {
            (i, j): derivative(expression)
            for (i, expression), (j, derivative) in itertools.product(
                enumerate(plain), enumerate(derivatives)
            )
        }
        present = {place: entry for place, entry in entries.items() if entry != 0}
        self._places = [*present]
        written = [in_floats(stable(entry)) for entry in present.values()]
        self._compiled: Entries = sp.lambdify(
            arguments, written, [NUMPY, "numpy", "scipy"], cse=True
        )

    def __call__(self, times: Array, states: Array, points: Array) -> Array:
        slopes = np.zeros((*self._shape, times.size))
        entries = self._compiled(times, *states, *np.ascontiguousarray(points.T))
        for (i, j), entry in zip(self._places, entries, strict=True):
            slopes[i, j] = entry
        return slopes


def _interval(records: Records, settings: Settings, name: str) -> tuple[float, ...]:
    """The interval of an input in the box that the problem is compiled over.

    Nothing that is computed depends on it but whether the problem is accepted.
    """
    parameters = {parameter.name: parameter for parameter in records.parameters}
    assigned = {numbers[name] for numbers in settings.at.values()}
    usual = [_usual(parameters[a]) if isinstance(a, str) else a for a in assigned]
    lower, upper = min(usual), max(usual)
    if lower == upper:
        ends = (lower / _SPREAD, lower * _SPREAD) if lower else (0.0, 1.0)
        lower, upper = min(ends), max(ends)
    return lower, upper


def _usual(parameter: Parameter) -> float:
    """The nominal value, or else the middle of the bounds on the scale of the parameter."""
    if np.isfinite(parameter.nominal):
        return parameter.nominal
    ends = parameter.scaled(parameter.lower), parameter.scaled(parameter.upper)
    middle = parameter.value(0.5 * sum(ends))
    if not np.isfinite(middle):
        raise ProblemError(
            f"parameter {quote(parameter.name)} has neither a nominal value nor finite bounds",
            term=parameter.name,
        )
    return middle
