"""Problem: what the user wrote, validated once and immutable."""

from __future__ import annotations

import inspect
import time as clock
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, fields
from functools import cached_property, wraps
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import Any, ParamSpec

import sympy as sp

from rankone.problem.algebra.algebraic import Reduction
from rankone.problem.algebra.matrices import MatrixLike, MatrixSystem, initial_values
from rankone.problem.algebra.tabulated import Network
from rankone.problem.algebra.term_table import TermTable
from rankone.problem.box import check_time, counts_of, pieces_of
from rankone.problem.checked import CheckedProblem
from rankone.problem.field_conversions import field_of_matrices, scalar_arguments
from rankone.problem.field_problem import CheckedFields
from rankone.problem.fields import has_fields
from rankone.problem.integration import Trajectory, trajectory_of
from rankone.problem.numeric import NumericEquations
from rankone.problem.shorthand import Shorthand
from rankone.problem.steady_start import (
    SettledStart,
    SteadyState,
    changes_of,
    with_constants,
    with_parameters,
)
from rankone.problem.text import problem_arguments
from rankone.problem.toml_layout import save_problem
from rankone.problem.user_events import Event
from rankone.support.errors import ProblemError, bounded_depth
from rankone.tensors.coordinates import name_of

_P = ParamSpec("_P")


def _timed(build: Callable[_P, Problem]) -> Callable[_P, Problem]:
    """Keep on the problem the seconds that building it took, with reading its arguments."""

    @wraps(build)
    def built(*arguments: _P.args, **named: _P.kwargs) -> Problem:
        began = clock.perf_counter()
        problem = build(*arguments, **named)
        object.__setattr__(problem, "seconds", clock.perf_counter() - began)
        return problem

    return built


@dataclass(frozen=True, eq=False, repr=False)
class Problem(CheckedProblem):
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
        ``{x: 1e-6}`` one of up to 1e-6 is always within the tolerance. An unknown that has none and
        shares its unit with others has 1e-12 of the largest of them; zero asks for its own size.
    mass : mapping of Field to matrix, optional
        Mass matrices of fields, see :class:`FieldProblem`.

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
    mass_form : MassForm
        The residuals as mass matrix times highest derivatives, and the rest; with algebraic
        equations the rates that follow from them.
    table : TermTable or None
        The terms of many equations that came as matrices or reactions: these are written out when
        they are read.
    reduction : Reduction or None
        What algebraic equations were reduced to.
    rest : Problem or None
        Of a problem that starts at a steady state the one before the start, which comes to rest:
        ``initial`` is then where that one starts.
    seconds : float
        What building the problem took.

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
    _: KW_ONLY
    name: str | None = None
    jumps: Mapping[Any, Mapping[sp.Expr, Any]] | None = None
    units: Mapping[Any, str] | None = None
    tail: float = 1e-6
    correlation: Mapping[Any, float] | None = None
    events: Sequence[Event] = ()
    constants: Mapping[sp.Symbol, Any] | None = None
    definitions: Mapping[sp.Expr, Any] | None = None
    atol: Mapping[Any, float] | None = None
    mass: Mapping[Any, Any] | None = None
    distributions: Mapping[str, str] = field(init=False)
    unknowns: tuple[sp.Expr, ...] = field(init=False)
    table: TermTable | None = field(init=False, default=None)
    reduction: Reduction | None = field(init=False, default=None)
    rest: Problem | None = field(init=False, default=None)
    shorthand: Shorthand = field(init=False)
    written: Mapping[str, Any] = field(init=False)
    compiled: list[Any] = field(init=False)
    seconds: float = field(init=False)

    def __new__(cls, *arguments: object, **named: object) -> Problem:
        """A :class:`FieldProblem` where equations or initial values have fields."""
        written = [*arguments, *named.values()]
        with_fields = cls is Problem and any(map(_mentions_fields, written))
        return super().__new__(FieldProblem if with_fields else cls)

    def __post_init__(self) -> None:
        began = clock.perf_counter()
        written = {f.name: _kept(getattr(self, f.name)) for f in fields(self) if f.init}
        object.__setattr__(self, "written", MappingProxyType(written))
        object.__setattr__(self, "compiled", [])
        with bounded_depth():
            self._check()
        object.__setattr__(self, "seconds", clock.perf_counter() - began)

    @classmethod
    @_timed
    def from_strings(
        cls,
        rhs: Mapping[str, str],
        initial: Mapping[str, str | float],
        parameters: Mapping[str, Any],
        time: tuple[float, float],
        *,
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
        fields: Mapping[str, int] | None = None,
        matrices: Mapping[str, Any] | None = None,
        mass: Mapping[str, Any] | None = None,
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
        fields : mapping of str to int, optional
            The unknowns that are vectors, and their numbers of entries, see :func:`field`. Their
            initial values may be arrays.
        matrices : mapping of str to array or sparse matrix, optional
            Matrices by name, for ``{"u": "D*apply(L, u) - u**3"}``; an array of one dimension is
            used like a field.
        mass : mapping of str to matrix, optional
            Mass matrices by the names of fields.

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
            "fields": fields,
            "matrices": matrices,
            "mass": mass,
        }
        return cls(**problem_arguments(written))

    @classmethod
    @_timed
    def from_matrices(
        cls,
        M: MatrixLike | None = None,
        C: MatrixLike | None = None,
        K: MatrixLike | None = None,
        force: MatrixLike | None = None,
        *,
        time: tuple[sp.Symbol, float, float],
        parameters: Mapping[sp.Symbol, Any],
        initial: MatrixLike | Sequence[MatrixLike],
        names: str | Sequence[str] = "q",
        fields: bool = False,
        **further: Any,
    ) -> Problem:
        """Build a problem ``M q'' + C q' + K q = force`` from matrices.

        Parameters
        ----------
        M, C, K : matrix or mapping of Expr to matrix
            Mass, damping and stiffness (n, n): a SymPy matrix, an array, a sparse matrix of SciPy,
            or a sum ``{1: K0, k: K1}`` of coefficients times such matrices. Coefficients and
            entries of SymPy matrices may have parameters, constants, time and unknowns. Without M
            the system is of first order, ``C q' + K q = force``. The matrix of the
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
        fields : bool
            Whether the unknowns are one field of the name ``names``, whose errors are relative to
            its largest value. Matrices are then of numbers, and initial values by ``"q"`` and
            ``"q_t"``.
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
        if fields:
            field_of = field_of_matrices(matrices, force, check_time(time)[0], initial, names)
            return cls(time=time, parameters=parameters, **field_of, **further)
        system = MatrixSystem.of(matrices, force, check_time(time)[0], names)
        return cls(system.equations, time, parameters, system.initial(initial), **further)

    @classmethod
    @_timed
    def from_reactions(
        cls,
        stoichiometry: MatrixLike,
        laws: Sequence[Any],
        *,
        orders: MatrixLike | None = None,
        time: tuple[sp.Symbol, float, float],
        parameters: Mapping[sp.Symbol, Any],
        initial: MatrixLike | Sequence[MatrixLike],
        names: str | Sequence[str] = "x",
        **further: Any,
    ) -> Problem:
        """Build a problem ``x' = N v(x)`` from a stoichiometric matrix and rate laws.

        Parameters
        ----------
        stoichiometry : matrix
            What a reaction adds to a species, or takes from it with a minus sign: (species,
            reactions) numbers, as an array or a sparse matrix of SciPy.
        laws : sequence of Expr or float
            The rate of each reaction, in unknowns, parameters and time; with ``orders`` its rate
            constant.
        orders : "reactants" or matrix, optional
            Mass action: laws are multiplied by powers of species, (species, reactions). For
            "reactants" they are what reactions take. What is not in the net change, such as a
            catalyst, needs the matrix.
        time, parameters
            As for the class.
        initial : array or mapping
            The values of the species (n,), numbers or expressions of parameters; or a mapping from
            unknowns or their names. What is left out is zero.
        names : str or sequence of str
            ``"x"`` calls the unknowns ``x0``, ``x1``, ...; or a name for each.
        **further
            ``name``, ``jumps``, ``units``, ``constants`` and other arguments of the class.

        Raises
        ------
        ProblemError
            As for the class, and if the laws do not fit the matrix.

        Examples
        --------
        >>> t, k1, k2 = sp.symbols("t k1 k2")
        >>> binding = [[-1, 1], [-1, 1], [1, -1]]
        >>> box = {k1: (1, 2), k2: (0.5, 1)}
        >>> Problem.from_reactions(
        ...     binding,
        ...     [k1, k2],
        ...     orders="reactants",
        ...     time=(t, 0, 5),
        ...     parameters=box,
        ...     initial=[1, 2, 0],
        ...     names=["a", "b", "ab"],
        ... )
        Problem: 3 unknowns, 2 parameters
          da/dt = -k1*a*b + k2*ab
          db/dt = -k1*a*b + k2*ab
          dab/dt = k1*a*b - k2*ab
          a(0) = 1, b(0) = 2, ab(0) = 0
          t in [0, 5], k1 in [1, 2], k2 in [0.5, 1]
        """
        network = Network.of(stoichiometry, laws, orders, check_time(time)[0], names)
        start = initial_values(initial, network.unknowns, network.time, order=1)
        return cls(network.equations, time, parameters, start, **further)

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
        states = map(name_of, self.unknowns)
        return trajectory_of(self._numeric, self.coordinates, list(states), rtol, (at, named))

    @cached_property
    def _numeric(self) -> NumericEquations:
        """The equations as functions of numbers."""
        equations = NumericEquations(
            self.time,
            tuple(self.parameters),
            self.mass_form,
            self.initial,
            self.jumps or {},
            self.events,
            self.reduction,
        )
        if self.rest is not None:
            start = SettledStart(self.rest._numeric, self.time[2] - self.time[1])
            equations.initial = start
        return equations

    @_timed
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
        changes = changes_of(values, named)
        changed = type(self)(**with_constants(self._arguments, changes, states))
        if changed._is_like(self):
            object.__setattr__(changed, "compiled", self.compiled)
        return changed

    def _is_like(self, other: Problem) -> bool:
        """Whether the two differ in run-time constants alone, of the same other arguments."""
        pairs = [(self.shorthand, other.shorthand)]
        if self.rest is not None and other.rest is not None:
            pairs.append((self.rest.shorthand, other.rest.shorthand))
        return all(one.is_like(another) for one, another in pairs)

    @_timed
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
        changes = changes_of(intervals, named)
        return type(self)(**with_parameters(self._arguments, changes, states))

    @property
    def _arguments(self) -> Mapping[str, Any]:
        """What it was made of, with the table of its terms if there is one."""
        return self.written if self.table is None else {**self.written, "equations": self.equations}

    def split(
        self, counts: Mapping[Any, Any] | None = None, /, **named: Any
    ) -> list[dict[str, tuple[float, float]]]:
        """Boxes that tile the box, for :func:`rankone.solve_many` and :meth:`Solution.join`.

        Parameters
        ----------
        counts, **named
            By symbols or names the number of pieces of a parameter, even on its scale, or the
            values at which to cut: ``problem.split({k: 4})``, ``problem.split(k=4, m=[0.3, 2])``.
            Other parameters are not cut.

        Returns
        -------
        list of dict
            For each piece the intervals of all parameters by name; the last one changes fastest.

        Raises
        ------
        OptionError
            If there is no such parameter, or cuts are not inside its interval in ascending order.

        Examples
        --------
        >>> t, k = sp.symbols("t k")
        >>> u = sp.Function("u")(t)
        >>> problem = Problem([sp.Eq(u.diff(t), -k * u)], (t, 0, 2), {k: (1, 2)}, {u: 1})
        >>> problem.split(k=2)
        [{'k': (1.0, 1.5)}, {'k': (1.5, 2.0)}]
        """
        return pieces_of(self.coordinates[1:], counts_of(counts, named))

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
        kind = type(self)
        return save_problem(self, path, lambda a: kind.from_strings(**a), overwrite=overwrite)

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuilt, (type(self), {**self.written, "parameters": self.written_parameters()})


@dataclass(frozen=True, eq=False, repr=False)
class FieldProblem(CheckedFields, Problem):
    """A problem with fields: vectors of unknowns, as :func:`rankone.field` declares them.

    :class:`Problem` makes one where the equations, or the initial values, have fields. It takes the
    arguments of that class.

    Parameters
    ----------
    equations : sequence of Eq, or mapping of Field to Expr
        One equation for each field and each scalar unknown ``x(t)`` beside them. ``{u: rate}`` is
        short for ``[sympy.Eq(u.diff(t), rate)]``. Rates are smooth, and written entry by entry;
        :func:`rankone.apply` takes one entry to another. Fields may have second derivatives in
        time, ``u.diff(t, 2)``; they become two fields, ``u`` and ``u_t``.
    time, parameters, name, units, tail, correlation, constants, definitions, atol
        As for :class:`Problem`; a tolerance holds for all entries of a field.
    initial : mapping of Field to number, array or Expr
        Numbers, arrays (n,), or elementwise expressions of parameters: ``{u: a *
        rankone.apply(shape, 1)}``.
    mass : mapping of Field to matrix, optional
        Mass matrices (n, n) of numbers, as of finite elements: with ``mass={u: M}`` the equation
        ``u.diff(t) = rate`` stands for ``M u' = rate``, and for second order ``M u'' = rate``.
    events : sequence of Event, optional
        Where one number crosses zero, such as ``rankone.apply(row, u) - level`` with a matrix of
        one row. It resets whole fields and scalar unknowns, or ends the trajectory. Without
        ``delay``, ``priority``, ``persistent`` and ``overlapping``.
    jumps : mapping, optional
        ``{time: {u: value after it}}``: short for events ``jump_0``, ``jump_1``, ... at these
        times, numbers or expressions of parameters.

    Attributes
    ----------
    unknowns : tuple of Expr
        Fields and scalar unknowns in the order of their equations.
    rates : mapping of Expr to Expr
        For each state, the unknowns and then the velocities of those of second order, its rate,
        with constants and definitions put in.
    masses : mapping of Expr to Operator
        The mass matrices by state.
    initial : mapping of Expr to Expr
        By state.
    fields : tuple of Field
        The fields among the states; ``problem.size`` counts the entries of all states.

    Raises
    ------
    ProblemError
        If the problem is incomplete or contradictory; the message says where and what to do.

    Examples
    --------
    >>> import numpy as np, scipy.sparse
    >>> from rankone import apply, field
    >>> t, D = sp.symbols("t D")
    >>> ones = np.ones(100)
    >>> L = scipy.sparse.diags_array([ones[1:], -2 * ones, ones[1:]], offsets=(-1, 0, 1))
    >>> u = field("u", 100)
    >>> start = np.linspace(0, 1, 100)
    >>> Problem({u: D * apply(L, u) - u**3}, (t, 0, 1), {D: (1, 2)}, {u: start})
    Problem: 1 field of 100 entries, 1 parameter
      du/dt = -u**3 + D*apply(<100 x 100>, u)
      u(0) = <100>
      t in [0, 1], D in [1, 2]
    """

    def scalar(self) -> Problem:
        """The same problem entry by entry: unknowns ``u0``, ``u1``, ... for the field ``u``.

        Other methods of :func:`rankone.solve` take it, and :meth:`trajectory` integrates it.

        Returns
        -------
        Problem
            Of first order; velocities are ``u_t0``, ``u_t1``, ...

        Raises
        ------
        ProblemError
            If the fields have more than 2,000 entries together.

        Examples
        --------
        >>> import numpy as np
        >>> from rankone import apply, field
        >>> t, D = sp.symbols("t D")
        >>> u = field("u", 2)
        >>> L = np.array([[-1.0, 1.0], [1.0, -1.0]])
        >>> Problem({u: D * apply(L, u)}, (t, 0, 1), {D: (1, 2)}, {u: [0, 1]}).scalar()
        Problem: 2 unknowns, 1 parameter
          du0/dt = D*(-u0 + u1)
          du1/dt = D*(u0 - u1)
          u0(0) = 0, u1(0) = 1
          t in [0, 1], D in [1, 2]
        """
        return Problem(**scalar_arguments(self))

    def trajectory(self, *at: object, rtol: float = 1e-8, **named: object) -> Trajectory:
        """Integrate one ordinary trajectory of :meth:`scalar`; see :meth:`Problem.trajectory`."""
        return self.scalar().trajectory(*at, rtol=rtol, **named)

    def save(self, path: str | PathLike[str], *, overwrite: bool = False) -> Path:
        """Raise a ProblemError: matrices and arrays are no text."""
        raise ProblemError(
            "a problem with fields has matrices, which a TOML file does not hold",
            term=path,
            remedy="keep the Python file that builds it, or pickle the problem",
        )


def _mentions_fields(argument: object) -> bool:
    """Whether an argument of a problem, or what it holds, has fields."""
    if isinstance(argument, Mapping) and not isinstance(argument, SteadyState):
        return has_fields([*argument, *argument.values()])
    return has_fields(argument if isinstance(argument, list | tuple) else [argument])


def _kept(argument: object) -> object:
    """An argument that does not change when the caller changes his own."""
    if isinstance(argument, Mapping) and not isinstance(argument, SteadyState):
        return dict(argument)
    return tuple(argument) if isinstance(argument, list | Iterator) else argument


def _rebuilt(kind: type[Problem], arguments: dict[str, Any]) -> Problem:
    """A problem from its arguments, for unpickling."""
    return kind(**arguments)


Problem.__new__.__signature__ = inspect.signature(Problem.__init__)  # type: ignore[attr-defined]
