"""Problem: what the user wrote, validated once and immutable."""

from __future__ import annotations

import tomllib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import sympy as sp

from rankone.discretization.coordinates import Coordinates, name_of
from rankone.expressions.admissible import closed
from rankone.expressions.unknowns import rate_of
from rankone.frontend.algebraic import Reduction, has_constraints, reduced
from rankone.frontend.box import (
    check_correlation,
    check_parameters,
    check_time,
    check_tolerances,
    check_units,
)
from rankone.frontend.changes import changes_of, with_constants, with_parameters
from rankone.frontend.consistency import (
    check_consistent,
    check_impulses,
    consistent_events,
    consistent_initial,
    consistent_jumps,
)
from rankone.frontend.content import ProblemContent
from rankone.frontend.equations import (
    Symbols,
    algebraic_unknowns,
    check_equations,
    check_initial,
    check_lengths,
    check_names,
    check_symbols,
    check_unknowns,
    listed_equations,
    state_expressions,
    state_of,
)
from rankone.frontend.events import (
    Event,
    check_events,
    impulse_events,
    moving_jumps,
    without_rates,
)
from rankone.frontend.integration import LEAST_RTOL, MOST_RTOL, Integration
from rankone.frontend.jumps import (
    check_jumps,
    moving_impulses,
)
from rankone.frontend.mass import MassForm, check_mass
from rankone.frontend.matrices import MatrixSystem
from rankone.frontend.mistakes import check_symbols_as_unknowns
from rankone.frontend.numeric import NumericEquations
from rankone.frontend.run_time import coupled_by, with_decisive
from rankone.frontend.saving import toml_text
from rankone.frontend.shorthand import Shorthand, check_apart, check_shorthand
from rankone.frontend.steady_start import (
    SettledStart,
    SteadyState,
    check_autonomous,
    conditioned,
)
from rankone.frontend.text import problem_arguments
from rankone.frontend.toml_tables import text_arguments
from rankone.frontend.trajectory import Trajectory
from rankone.ir.functions import check_distinct
from rankone.support.errors import (
    EvaluationError,
    ProblemError,
    RankoneWarning,
    bounded_depth,
    warn,
)
from rankone.support.files import as_path, write_files
from rankone.support.options import checked_number
from rankone.support.wording import (
    is_line,
    quote,
    shown,
)

_IN_PYTHON = "keep it in a Python file with a variable `problem`"


@dataclass(frozen=True, eq=False, repr=False)
class Problem(ProblemContent):
    """A parametric initial value problem.

    Parameters
    ----------
    equations : sequence of Eq or Expr
        One for each unknown: an equation, or an expression that vanishes. An equation between
        matrices stands for its rows. Unknowns are applied
        functions of time such as ``x(t)``. The equations are linear in the highest derivatives
        with any coefficients (a mass matrix), and polynomial in everything below. Some may be
        algebraic, without any highest derivative, and unknowns may appear undifferentiated.
    time : tuple
        ``(t, t0, t1)``: the symbol of time, the start and the end.
    parameters : mapping of Symbol to (float, float) or distribution
        The box: an interval for each parameter; may be empty. An interval may end with a scale:
        ``(1e-3, 10, "log")`` is uniform in the logarithm, as ``scipy.stats.loguniform(1e-3, 10)``
        is, and ``"reciprocal"`` in ``1/k``; statistics, samples and plots are then in that measure.
        A frozen continuous distribution of scipy.stats stands for its support, or where that is
        unbounded for the interval between two quantiles, see ``tail``; statistics of solutions are
        then those under it.
    initial : mapping of Expr to Expr or number
        For each unknown its value at ``t0``, a number or an expression of the parameters. Unknowns
        of higher order need their derivatives as well: ``{x: 1, x.diff(t): v0}``. Those of
        unknowns that are not differentiated are starting guesses, needed only where no equation
        is linear in the unknown. Or a :class:`SteadyState`: the equilibrium of other conditions.
    name : str, optional
        A title.
    jumps : mapping of float to mapping, optional
        Times at which unknowns are reset, such as doses: ``{8.0: {x: x + dose}}`` gives the values
        right after that time in terms of those right before it. A tuple of times stands for
        several. A ``DiracDelta(t - 8)`` in an equation means the same. At such a time a solution
        has its value after the jump. A time that depends on parameters, ``{lag: {x: x + dose}}``
        or ``DiracDelta(t - lag)``, makes an event of the jump, named ``jump_0``, ``jump_1``, ...
    units : mapping to str, optional
        Units of time, parameters, unknowns and derivatives that are states, by symbols, functions
        or names: ``{x: "m", t: "s", k: "1/s"}``. They are shown with results; nothing is
        converted. A derivative of which none is given has ``m/s``.
    tail : float
        The probability that is cut off at each unbounded side of a distribution.
    correlation : mapping of (Symbol, Symbol) to float, optional
        Correlations of the Gaussian copula that joins parameters, ``{(k, c): 0.6}``; statistics of
        solutions are then those of correlated parameters.
    events : sequence of Event, optional
        What happens where an expression crosses zero: states are reset, time ends, or the instant
        is only marked. All trajectories of the box have to meet the same ones in the same order.
    constants : mapping of Symbol to number, optional
        Symbols that stand for numbers, ``{m: 3.0}``. :meth:`set` gives one another number,
        :meth:`vary` makes it a parameter.
    definitions : mapping of Symbol to Expr, optional
        Symbols that stand for expressions of unknowns, parameters, constants, time and each other,
        in any order: ``{F: k*x + c*v}``. One that is differentiated is a function of time,
        ``{F(t): k*x}``. Solutions give their values: ``solution.output("F")``.
    atol : mapping of Expr to float, optional
        Absolute tolerances of unknowns, for those that are or become numerically zero. The error of
        ``x`` is relative to its largest reference value plus ``atol/rtol``, so that with
        ``{x: 1e-6}`` one of up to 1e-6 is always within the tolerance.

    Attributes
    ----------
    equations, time, parameters, initial, name, jumps, units, tail, correlation, events
        As given, with numbers as floats, parameters as intervals, initial values in the order of
        the states, jumps by time, units and correlations by name, and a name for each event. In
        initial values, jumps and events constants and definitions are put in.
    constants : mapping of Symbol to Expr
        Exact numbers.
    atol : mapping of str to float
        By the names of states.
    definitions : mapping of (Symbol or applied function of time) to Expr
        In unknowns, time, parameters and constants.
    distributions : mapping of str to str
        The distributions of parameters as texts, by name.
    unknowns : tuple of Expr
        In the order in which their highest derivatives enter the equations; those that enter in
        the same equation are in the order of ``initial``. Algebraic unknowns are the last.
    residuals : tuple of Expr
        For each equation its left minus its right side, with constants and definitions put in.
    mass : MassForm
        The residuals as mass matrix times highest derivatives, and the rest; with algebraic
        equations the rates that follow from them.
    reduction : Reduction or None
        What algebraic equations were reduced to.
    rest : Problem or None
        Of a problem that starts at a steady state the one before the start, which comes to rest:
        ``initial`` is then where that one starts.

    Raises
    ------
    ProblemError
        If the problem is incomplete or contradictory; the message says where and what to do.

    Warns
    -----
    RankoneWarning
        If a parameter appears nowhere.

    Examples
    --------
    >>> import sympy as sp
    >>> t, k = sp.symbols("t k")
    >>> u = sp.Function("u")(t)
    >>> Problem([sp.Eq(u.diff(t) + k * u, 0)], (t, 0, 2), {k: (0.5, 5)}, {u: 1})
    Problem: 1 unknown, 1 parameter
      du/dt + k*u = 0
      u(0) = 1
      t in [0, 2], k in [0.5, 5]
    """

    equations: Sequence[sp.Basic]
    time: tuple[sp.Symbol, float, float]
    parameters: Mapping[sp.Symbol, tuple[float, float]]
    initial: Mapping[sp.Expr, Any]
    name: str | None = None
    jumps: Mapping[Any, Mapping[sp.Expr, Any]] | None = None
    units: Mapping[Any, str] | None = None
    tail: float = 1e-6
    correlation: Mapping[Any, float] | None = None
    events: Sequence[Event] = ()
    constants: Mapping[sp.Symbol, Any] | None = None
    definitions: Mapping[sp.Expr, Any] | None = None
    atol: Mapping[Any, float] | None = None
    distributions: Mapping[str, str] = field(init=False)
    unknowns: tuple[sp.Expr, ...] = field(init=False)
    residuals: tuple[sp.Expr, ...] = field(init=False)
    mass: MassForm = field(init=False)
    reduction: Reduction | None = field(init=False, default=None)
    rest: Problem | None = field(init=False, default=None)
    shorthand: Shorthand = field(init=False)
    written: Mapping[str, Any] = field(init=False)
    compiled: list[Any] = field(init=False)

    def __post_init__(self) -> None:
        written = {f.name: _kept(getattr(self, f.name)) for f in fields(self) if f.init}
        object.__setattr__(self, "written", MappingProxyType(written))
        object.__setattr__(self, "compiled", [])
        with bounded_depth():
            self._check()

    def _check(self) -> None:
        """Validate what was given, and set what follows from it."""
        if self.name is not None and not is_line(self.name):
            message = f"the name is {shown(self.name)}, not text in one line"
            raise ProblemError(message, term=self.name, remedy="give a title")
        time = check_time(self.time)
        box, distributions = check_parameters(self.parameters, time[0], self.tail)
        shorthand = check_shorthand(self.written["constants"], self.written["definitions"], time[0])
        check_apart(shorthand, box, self.initial)
        equations = listed_equations(self.written["equations"])
        declared = [*box, *shorthand.symbols]
        check_symbols_as_unknowns(equations, declared, self.initial, time[0])
        arguments = {**self.written, "equations": equations}
        shorthand = with_decisive(shorthand, arguments)
        residuals = check_equations(equations, time[0], shorthand)
        if coupled := coupled_by(residuals):
            shorthand = with_decisive(shorthand, arguments, coupled)
            residuals = check_equations(equations, time[0], shorthand)
        residuals = [closed(residual) for residual in residuals]
        unknowns = check_unknowns(residuals, self.initial, time[0])
        states = state_expressions(residuals, unknowns, time[0])
        named_states = [(name_of(state), state) for state in states]
        check_names(named_states, box, time[0], shorthand.owners)
        constrained = has_constraints(residuals, unknowns, time[0])
        highest = {rate_of(state, time[0]) for state in states} - {*states}
        rates = () if constrained else tuple(sorted(highest, key=sp.default_sort_key))
        symbols = Symbols(time, tuple(box), unknowns, states, shorthand, rates)
        check_symbols(residuals, symbols)
        rest = self.initial if isinstance(self.initial, SteadyState) else None
        free = algebraic_unknowns(residuals) if rest is None else states
        initial = check_initial(self.initial, symbols, free)
        initial = {state: closed(start) for state, start in initial.items()}
        if rest is not None:
            initial = {state: initial.get(state, sp.S.Zero) for state in states}
        known, moving = moving_jumps(self.jumps, symbols)
        jumps = {
            at: {state: closed(after) for state, after in reset.items()}
            for at, reset in check_jumps(known, symbols).items()
        }
        after_jumps = [after for reset in jumps.values() for after in reset.values()]
        events = check_events([*self.events, *moving] if moving else self.events, symbols)
        of_events = [expression for event in events for expression in event.expressions]
        check_lengths([*initial.values(), *after_jumps, *of_events], 0)
        expressions = [*residuals, *initial.values(), *after_jumps, *of_events]
        check_distinct(expressions)
        used = sp.Tuple(*expressions).free_symbols
        for symbol in box:
            if symbol not in used:
                warn(
                    f"parameter {quote(symbol)} appears nowhere in the problem",
                    remedy="remove it from `parameters`",
                )
        checked = {
            "equations": equations,
            "time": time,
            "parameters": MappingProxyType(box),
            "distributions": MappingProxyType(distributions),
            "correlation": MappingProxyType(check_correlation(self.correlation, box)),
            "initial": MappingProxyType(initial),
            "jumps": MappingProxyType(jumps),
            "events": events,
            "constants": MappingProxyType(dict(shorthand.constants)),
            "definitions": MappingProxyType(dict(shorthand.definitions)),
            "shorthand": shorthand,
            "units": MappingProxyType(check_units(self.units, time[0], declared, states)),
            "atol": MappingProxyType(check_tolerances(self.atol, states, time[0])),
            "unknowns": unknowns,
            "residuals": tuple(residuals),
        }
        for name, attribute in checked.items():
            object.__setattr__(self, name, attribute)
        if rest is not None:
            object.__setattr__(self, "rest", self._under_conditions(rest, symbols, constrained))
        if constrained:
            self._reduce(states)
            return
        object.__setattr__(self, "mass", check_mass(residuals, unknowns, self.coordinates))
        self._take_out_impulses(symbols, len(moving))
        self._take_out_rates()

    def _under_conditions(self, rest: SteadyState, symbols: Symbols, constrained: bool) -> Problem:
        """The problem before the start, which comes to rest."""
        if constrained:
            raise ProblemError(
                "the start is a steady state, and there are algebraic equations",
                term=rest,
                remedy="solve them for the unknowns that are not differentiated, and give these as "
                "definitions",
            )
        arguments = conditioned(self.written, rest, symbols)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RankoneWarning)
            try:
                before = type(self)(**arguments)
            except ProblemError as error:
                message = f"under the conditions of the start, {error.message}"
                raise ProblemError(message, term=error.term, remedy=error.remedy) from None
        check_autonomous(before.residuals, self.time[0])
        return before

    @property
    def start_states(self) -> set[sp.Expr]:
        """The states whose values were given, and do not follow."""
        symbols = Symbols(self.time, (), self.unknowns, [*self.initial])
        return {state_of(key, symbols) for key in self.written["initial"]}

    def _take_out_rates(self) -> None:
        """Put what equations say of highest derivatives in their place, where events cross zero."""
        leading = set(self.mass.leading)
        if any(event.when.atoms(sp.Derivative) & leading for event in self.events):
            rates = dict(zip(self.mass.leading, self.mass.solved()[0], strict=True))
            object.__setattr__(self, "events", without_rates(self.events, rates))

    def _reduce(self, states: Sequence[sp.Expr]) -> None:
        """Reduce algebraic equations, and complete initial values and resets by them."""
        check_impulses(self.residuals, self.time[0])
        reduction = reduced(self.residuals, self.unknowns, self.coordinates, self.initial)
        initial = consistent_initial(self.initial, states, reduction, self.time)
        check_consistent(initial, reduction, self.coordinates)
        jumps = consistent_jumps(self.jumps or {}, reduction, self.time[0])
        completed = {
            "reduction": reduction,
            "mass": reduction.mass,
            "initial": MappingProxyType(initial),
            "jumps": MappingProxyType(jumps),
            "events": consistent_events(self.events, reduction),
        }
        for name, attribute in completed.items():
            object.__setattr__(self, name, attribute)

    def _take_out_impulses(self, symbols: Symbols, first: int) -> None:
        """Make events of the impulses at times of parameters, numbered from ``first`` on."""
        if not any(residual.has(sp.DiracDelta) for residual in self.residuals):
            return
        time = self.time[0]
        solved, origins = self.mass.solved()
        highest = dict(zip(self.mass.leading, zip(solved, origins, strict=True), strict=True))
        pairs = [highest.get(rate_of(state, time), (sp.S.Zero, None)) for state in symbols.states]
        rates, numbers = [rate for rate, _ in pairs], [number for _, number in pairs]
        found, impulses = moving_impulses(rates, symbols.states, numbers, time, self.parameters)
        if not found:
            return
        gone = dict.fromkeys(found, sp.S.Zero)
        residuals = tuple(residual.xreplace(gone) for residual in self.residuals)
        changed = {
            "equations": tuple(equation.xreplace(gone) for equation in self.equations),
            "residuals": residuals,
            "events": check_events(
                [*self.events, *impulse_events(impulses, symbols, first)], symbols
            ),
            "mass": check_mass(residuals, self.unknowns, self.coordinates),
        }
        for name, attribute in changed.items():
            object.__setattr__(self, name, attribute)

    @classmethod
    def from_strings(
        cls,
        rhs: Mapping[str, str],
        initial: Mapping[str, str | float],
        parameters: Mapping[str, Any],
        time: tuple[float, float],
        name: str | None = None,
        jumps: Mapping[Any, Mapping[str, str | float]] | None = None,
        units: Mapping[str, str] | None = None,
        tail: float = 1e-6,
        correlation: Mapping[tuple[str, str], float] | None = None,
        events: Sequence[Mapping[str, Any]] = (),
        constants: Mapping[str, float | str] | None = None,
        definitions: Mapping[str, str | float] | None = None,
        atol: Mapping[str, float] | None = None,
        equations: Sequence[str] = (),
        unknowns: Sequence[str] = (),
    ) -> Problem:
        """Build a problem from text.

        Parameters
        ----------
        rhs : mapping of str to str
            For each unknown the right-hand side of its derivative, for example
            ``{"x": "x*(1.5 - y)", "y": "-y*(3 - x)"}``. ``t`` is time.
        initial : mapping of str to str or float
            For each unknown its initial value, a number or a formula of the parameters.
        parameters : mapping of str to (float, float), distribution or str
            The box, intervals with a scale ``(1e-3, 10, "log")`` included; a distribution of
            scipy.stats may be a text such as ``"norm(1, 0.1)"``.
        time : tuple of float
            ``(t0, t1)``.
        name : str, optional
            A title.
        jumps : mapping of float to mapping, optional
            Times at which unknowns are reset: ``{8.0: {"x": "x + dose"}}``, or
            ``{"lag": {"x": "x + dose"}}`` where they depend on parameters.
        units : mapping of str to str, optional
            Units by name: ``{"x": "m", "t": "s"}``.
        tail, correlation
            As for the class, by name.
        events : sequence of mapping, optional
            The fields of each :class:`Event`, with formulas: ``{"when": "x", "direction":
            "falling", "then": {"v": "-e*v"}, "name": "bounce"}``.
        constants : mapping of str to float or str, optional
            Numbers by name; a text is a formula of numbers, ``"2*pi"``.
        definitions : mapping of str to str or float, optional
            Formulas by name, in any order: ``{"F": "k*x + c*v"}``.
        atol : mapping of str to float, optional
            Absolute tolerances of unknowns by name.
        equations : sequence of str, optional
            Equations that give no single derivative, besides those in ``rhs``, which may be empty:
            ``"m*x_tt + c*x_t + k*x = F"``. ``x_t`` and ``x_tt`` are derivatives; they have initial
            values by these names.
        unknowns : sequence of str, optional
            Names of further unknowns, where ``equations`` have some without initial values.

        Raises
        ------
        ProblemError
            As for the class, and if a text is not a formula.
        """
        written = {
            "rhs": rhs,
            "initial": initial,
            "parameters": parameters,
            "time": time,
            "name": name,
            "jumps": jumps,
            "units": units,
            "tail": tail,
            "correlation": correlation,
            "events": events,
            "constants": constants,
            "definitions": definitions,
            "atol": atol,
            "equations": equations,
            "unknowns": unknowns,
        }
        return cls(**problem_arguments(written))

    @classmethod
    def from_matrices(
        cls,
        M: Any,
        C: Any = None,
        K: Any = None,
        force: Any = None,
        *,
        time: tuple[sp.Symbol, float, float],
        parameters: Mapping[sp.Symbol, Any],
        initial: Any,
        names: str | Sequence[str] = "q",
        **further: Any,
    ) -> Problem:
        """Build a problem ``M q'' + C q' + K q = force`` from matrices.

        Parameters
        ----------
        M, C, K : matrix or mapping of Expr to matrix
            Mass, damping and stiffness (n, n): a SymPy matrix, an array, a sparse matrix of SciPy,
            or a sum ``{1: K0, k: K1}`` of coefficients times such matrices. Coefficients and
            entries of SymPy matrices may have parameters, constants, time and unknowns. With
            ``M=None`` the system is of first order, ``C q' + K q = force``. The matrix of the
            highest derivatives is of numbers or diagonal if it has more than six rows.
        force : vector or mapping of Expr to vector, optional
            The right-hand side (n,), given in the same way: ``{F0 * sp.cos(w*t): b}``.
        time, parameters
            As for the class.
        initial : array, pair of arrays or mapping
            The values of the unknowns (n,), or a pair of these and their derivatives (n,), numbers
            or expressions of parameters; or a mapping from unknowns, or their names ``"q0"`` and
            ``"q0_t"``. What is left out is zero.
        names : str or sequence of str
            ``"q"`` calls the unknowns ``q0``, ``q1``, ...; or a name for each.
        **further
            ``name``, ``jumps``, ``units``, ``constants`` and other arguments of the class.

        Raises
        ------
        ProblemError
            As for the class, and if the matrices do not fit each other or M is singular.

        Examples
        --------
        >>> t, k = sp.symbols("t k")
        >>> stiffness = np.array([[2.0, -1.0], [-1.0, 1.0]])
        >>> Problem.from_matrices(
        ...     np.eye(2), K={k: stiffness}, time=(t, 0, 5), parameters={k: (1, 2)}, initial=[0, 1]
        ... )
        Problem: 2 unknowns, 1 parameter
          d²q0/dt² + 2*k*q0 - k*q1 = 0
          d²q1/dt² - k*q0 + k*q1 = 0
          q0(0) = 0, q1(0) = 1, q0_t(0) = 0, q1_t(0) = 0
          t in [0, 5], k in [1, 2]
        """
        matrices = {"M": M, "C": C, "K": K}
        system = MatrixSystem.of(matrices, force, check_time(time)[0], names)
        return cls(system.equations, time, parameters, system.initial(initial), **further)

    def trajectory(self, *at: object, rtol: float = 1e-8, **named: object) -> Trajectory:
        """Integrate one ordinary trajectory by SciPy, for a first check.

        It is integrated from the equations as they were written, and nothing is compiled. Jumps,
        impulses and events are included. Steps are those of SciPy's LSODA; none straddles a jump, a
        time at which a function of time and parameters switches, or an event that resets or ends.

        Events at one instant are applied in the order listed, each to what the one before has left;
        what they set off by a reset follows, up to 100 times. An event of which both crossings lie
        within 1/2000 of the horizon may be missed.

        Parameters
        ----------
        *at, **named
            Times, a number or an array inside the horizon, and one value for each parameter, as a
            solution takes them: ``trajectory(t=times, k=2.0)``, ``trajectory(times, {k: 2.0})``.
        rtol : float
            Tolerance of a step, relative to the states; from 1e-12 to 0.1. A parameter of that name
            is given in a mapping.

        Returns
        -------
        Trajectory
            Its ``.values`` have the shape of a solution, ``(unknowns, *shape of the times)``;
            ``trajectory[x]`` is one unknown, ``trajectory.events`` has the times of events by name.
            At the instant of a jump or an event values are those after it; after a terminal event
            they are NaN.

        Raises
        ------
        EvaluationError
            As for a solution; and if a parameter has several values.
        BlowUpError
            If the trajectory cannot be continued to the last of the times.
        ConvergenceError
            If it takes too many steps, or an event happens again and again at one instant.

        Examples
        --------
        >>> t, k = sp.symbols("t k")
        >>> u = sp.Function("u")(t)
        >>> problem = Problem([sp.Eq(u.diff(t), -k * u)], (t, 0, 2), {k: (0.5, 5)}, {u: 1})
        >>> trajectory = problem.trajectory([0.5, 1.0], k=2.0)
        >>> trajectory[u].round(6)
        array([0.367879, 0.135335])
        """
        rtol = checked_number("rtol", rtol, LEAST_RTOL, MOST_RTOL, float)
        coordinates = self.coordinates
        axes = Coordinates([c.name for c in coordinates], [(c.lower, c.upper) for c in coordinates])
        times, *values = axes.arrays(axes.gather(at, named))
        for coordinate, value in zip(coordinates[1:], values, strict=True):
            if value.size != 1:
                raise EvaluationError(
                    f"`{coordinate.name}` has {value.size} values; a trajectory has one for each "
                    "parameter",
                    term=coordinate.name,
                    remedy="call it for each",
                )
        point = np.array([value.item() for value in values])
        ascending, places = np.unique(times, return_inverse=True)
        integration = Integration(self._numeric, point, ascending, rtol)
        states = integration.values[:, places.reshape(times.shape)]
        names = [name_of(state) for state in self.initial]
        by_name = dict(zip(names, states, strict=True))
        unknowns = np.stack([by_name[name_of(unknown)] for unknown in self.unknowns])
        return Trajectory(times, unknowns, by_name, integration.events)

    @cached_property
    def _numeric(self) -> NumericEquations:
        """The equations as functions of numbers."""
        equations = NumericEquations(
            self.time,
            tuple(self.parameters),
            self.mass,
            self.initial,
            self.jumps or {},
            self.events,
            self.reduction,
        )
        if self.rest is not None:
            start = SettledStart(self.rest._numeric, self.time[2] - self.time[1])
            equations.initial = start
        return equations

    def set(self, values: Mapping[Any, Any] | None = None, /, **named: Any) -> Problem:
        """The same problem with other numbers of constants; of a parameter its fixed number.

        Parameters
        ----------
        values, **named
            Numbers by symbols or names: ``problem.set({m: 2.5})``, ``problem.set(m=2.5)``.

        Returns
        -------
        Problem
            A parameter that is set has become a constant. Where constants that enter smoothly keep
            their signs, what was compiled of one of the two problems serves the other.

        Raises
        ------
        ProblemError
            If there is no such constant or parameter, or the new problem is not well posed.

        Examples
        --------
        >>> t, k, m = sp.symbols("t k m")
        >>> u = sp.Function("u")(t)
        >>> equation = sp.Eq(m * u.diff(t), -k * u)
        >>> problem = Problem([equation], (t, 0, 2), {k: (0.5, 5)}, {u: 1}, constants={m: 3.0})
        >>> problem.set(m=2.5)
        Problem: 1 unknown, 1 parameter
          m*du/dt = -k*u
          u(0) = 1
          t in [0, 2], k in [0.5, 5]
          m = 2.5
        """
        states = map(name_of, self.initial)
        changed = type(self)(**with_constants(self.written, changes_of(values, named), states))
        if changed._is_like(self):
            object.__setattr__(changed, "compiled", self.compiled)
        return changed

    def _is_like(self, other: Problem) -> bool:
        """Whether the two differ in run-time constants alone, of the same other arguments."""
        pairs = [(self.shorthand, other.shorthand)]
        if self.rest is not None and other.rest is not None:
            pairs.append((self.rest.shorthand, other.rest.shorthand))
        return all(one.is_like(another) for one, another in pairs)

    def vary(self, intervals: Mapping[Any, Any] | None = None, /, **named: Any) -> Problem:
        """The same problem with constants set free, or other intervals of parameters.

        Parameters
        ----------
        intervals, **named
            Intervals or distributions as in ``parameters``, by symbols or names:
            ``problem.vary({k: (1, 2)})``, ``problem.vary(k=(1, 2))``.

        Returns
        -------
        Problem
            A constant that varies has become the last of the parameters.

        Raises
        ------
        ProblemError
            If there is no such constant or parameter, or the new problem is not well posed.
        """
        states = map(name_of, self.initial)
        return type(self)(**with_parameters(self.written, changes_of(intervals, named), states))

    def save(self, path: str | PathLike[str], *, overwrite: bool = False) -> Path:
        """Write the problem to a TOML file, which ``rankone solve`` and the like read.

        Parameters
        ----------
        path : path-like
            Ends in ``.toml``.
        overwrite : bool
            Whether to replace an existing file.

        Returns
        -------
        Path
            The file. It reads back to an equal problem, but for the assumptions of symbols.

        Raises
        ------
        ProblemError
            If the path has another suffix, exists or cannot be written, or if the problem has
            something that is not text: tables, functions of the user, names that are no
            identifiers, or a time of another name than ``t``.
        """
        place = as_path(path, ProblemError)
        if place.suffix != ".toml":
            message = f"`{place}` is no .toml file"
            raise ProblemError(message, term=path, remedy="give a name that ends in .toml")
        if self.time[0].name != "t":
            message = f"the time is called {quote(self.time[0])}, which is `t` in files"
            raise ProblemError(message, term=self.time[0], remedy="call it t")
        written = {**self.written, "equations": listed_equations(self.written["equations"])}
        parameters = {symbol.name: ends for symbol, ends in self.written_parameters().items()}
        text = toml_text(written, parameters, self.unknowns)
        again = type(self).from_strings(**text_arguments(tomllib.loads(text), str(place)))
        if self.content(plain=True) != again.content(plain=True):
            message = "the problem does not read back from text as it is"
            raise ProblemError(message, term=self.name, remedy=_IN_PYTHON)
        write_files({place: lambda stream: stream.write(text.encode())}, overwrite, ProblemError)
        return place

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuilt, (type(self), {**self.written, "parameters": self.written_parameters()})


def _kept(argument: Any) -> Any:
    """An argument that does not change when the caller changes his own."""
    if isinstance(argument, Mapping) and not isinstance(argument, SteadyState):
        return dict(argument)
    return tuple(argument) if isinstance(argument, list | Iterator) else argument


def _rebuilt(kind: type[Problem], arguments: dict[str, Any]) -> Problem:
    """A problem from its arguments, for unpickling."""
    return kind(**arguments)
