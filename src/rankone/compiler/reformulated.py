"""Problems in other unknowns, and quantities that a solve holds in place of the states."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Collection, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import sympy as sp

from rankone.compiler.agreement import AGREED, POINTS, ComparedPoints, disagreeing_rate
from rankone.compiler.codegen.layout import ModuleSpecification, Quantities
from rankone.compiler.codegen.module import general_source, generate_source
from rankone.compiler.codegen.output_expressions import OutputFormulas, output_formulas
from rankone.compiler.codegen.sums import quadratic_system
from rankone.compiler.passes import FirstOrderSystem, separate, weak_form
from rankone.compiler.passes.lifting import Lifting, NotLiftable, lift
from rankone.compiler.passes.over_stretches import (
    KnownStretches,
    KnownTime,
    by_levels,
    exact_number,
    levelled,
    over_stretches,
)
from rankone.compiler.passes.surfaces import moving_cuts
from rankone.compiler.passes.switches import NotHeld, held_switches
from rankone.problem.expressions.notation import NamedConstant
from rankone.problem.expressions.stable import NUMPY, in_floats, stable
from rankone.problem.forms import GeneralTerm, QuadraticSystem, SeparatedForm
from rankone.problem.functions import known_applied, namespace_of
from rankone.problem.problem import Problem
from rankone.solvers.outcome import SolutionMetadata
from rankone.solvers.request import Domain, Observation, SolveRequest, counted_states
from rankone.solvers.verification.points import branch_points, check_points
from rankone.support.arrays import MINOR, SAMPLES, Array
from rankone.support.budget import limited
from rankone.support.errors import (
    EvaluationError,
    OptionError,
    ProblemError,
    SeparationError,
    listing,
    quote,
)
from rankone.tensors.coordinates import name_of
from rankone.trajectories.bifurcations import RestingStart
from rankone.trajectories.events.stretches import fixed_times, in_stretches
from rankone.trajectories.integrators.diagnosis import coarse_states
from rankone.trajectories.system.features import Ending
from rankone.trajectories.system.system import Box, Clock, System

Stage = TypeVar("Stage")
Numbers = Mapping[NamedConstant, NamedConstant]


def other_numbers(before: Problem, after: Problem) -> Numbers:
    """The run-time constants of a problem, and those of one that differs in their numbers alone."""
    old, new = before.shorthand.named, after.shorthand.named
    return {old[symbol]: new[symbol] for symbol in old if old[symbol] != new[symbol]}


def renumbered(stage: Stage, numbers: Numbers) -> Stage:
    """A stage of the compilation with other numbers in all of its expressions."""
    changed: Any = stage
    if isinstance(stage, sp.Basic):
        changed = stage.xreplace(dict(numbers))
    elif isinstance(stage, tuple):
        changed = tuple(renumbered(member, numbers) for member in stage)
    elif dataclasses.is_dataclass(stage) and not isinstance(stage, type):
        members = {f.name: getattr(stage, f.name) for f in dataclasses.fields(stage) if f.init}
        changed = dataclasses.replace(
            stage, **{name: renumbered(member, numbers) for name, member in members.items()}
        )
    return changed  # type: ignore[no-any-return]


# -----------------------------------------------------------------------------
# Checks of starts at steady states: of totals when compiled, of branches when solved.


def check_totals(problem: Problem, system: System) -> None:
    """Raise a ProblemError for a conserved sum of states that `start` leaves out: it is zero."""
    start = system.at_rest
    if not isinstance(start, RestingStart):
        return
    symbols = problem.start_states
    centre = np.array([[0.5 * (lower + upper)] for lower, upper in system.box])
    for row in start.steady.conserved(centre.reshape(len(system.box), 1))[:, :, 0]:
        inside = [state for state, c in zip(problem.initial, row, strict=True) if c != 0.0]
        if not symbols.intersection(inside):
            raise ProblemError(
                f"no rate changes a sum of {listing(inside)}, and all of these start at zero",
                term=inside[0],
                remedy="give their values before the start: SteadyState(..., start="
                f"{{{inside[0]}: 1}})",
            )


def check_rest(system: System, request: SolveRequest) -> None:
    """Raise a ConvergenceError unless steady states at the start are on one branch in the box."""
    if isinstance(system.at_rest, RestingStart):
        points = branch_points(request.domain)
        with limited(request.limits.operations, request.limits.seconds):
            system.at_rest.check(points)


# -----------------------------------------------------------------------------
# The lifted form of a problem, for the methods that need separated terms.


@dataclass(frozen=True, eq=False, repr=False)
class LiftedProblem:
    """A system with functions of its states as further states, so that its terms separate.

    ``lifting`` has the lifted states, with their equations and initial values, and invariants;
    ``name`` is of the problem.
    """

    lifting: Lifting
    separated: SeparatedForm
    quadratic: QuadraticSystem
    name: str

    @cached_property
    def source(self) -> str:
        """Text of the generated module."""
        system = self.lifting.system
        return generate_source(
            self.quadratic, self.name, self.lifting.meanings, system.constraints, system.rest
        )

    @cached_property
    def system(self) -> System:
        """The generated module."""
        jumps = (after for jump in self.lifting.system.jumps for after in jump.values)
        name = f"{self.name or 'system'} lifted"
        return ModuleSpecification(self.source, name, namespace_of(jumps)).load()

    def __getstate__(self) -> dict[str, object]:
        return {name: stage for name, stage in self.__dict__.items() if name != "system"}

    def __str__(self) -> str:
        return str(self.lifting)

    __repr__ = __str__


def lifted_problem(
    first_order: FirstOrderSystem, system: System, name: str
) -> LiftedProblem | sp.Expr:
    """The lifted form of a first-order system, or the expression that has none.

    It has none either where numbers overflow once it is multiplied out.
    """
    try:
        lifting = lift(first_order)
    except NotLiftable as part:
        return part.expression
    try:
        separated = separate(weak_form(lifting.system))
    except ProblemError as error:
        return sp.sympify(error.term)
    for term in separated.general:
        if not term.initial:
            return term.expression
    lifted = LiftedProblem(lifting, separated, quadratic_system(separated), name)
    wrong = disagreeing_rate(lifted.system, system)
    return lifted if wrong is None else first_order.rhs[wrong]


# -----------------------------------------------------------------------------
# The form of a problem in which each switch of its rates is held on one side of its surface.


_COARSE_POINTS, _COARSE_STEPS = 8, 512  # Trajectories, besides corners, that reach levels


def held_form(first_order: FirstOrderSystem, system: System) -> FirstOrderSystem | None:
    """The first-order system with the sides of its switches as states, if they can be held.

    ``system`` is the module of the same equations as they are written.
    """
    if first_order.constraints.names or first_order.rest is not None:
        return None
    try:
        return held_switches(_by_levels(first_order, system))
    except (NotHeld, ProblemError, np.linalg.LinAlgError):  # of coarse steps
        return None


def _by_levels(first_order: FirstOrderSystem, system: System) -> FirstOrderSystem:
    """The first-order system with a switch for each level that coarse trajectories reach."""
    arguments = levelled(first_order.examined_rates)
    if not arguments:
        return first_order
    lower, upper = _reached(arguments, first_order, system)
    if not np.isfinite([lower, upper]).all():
        raise NotHeld
    spans = zip(lower.tolist(), upper.tolist(), strict=True)
    reached = dict(zip(arguments, spans, strict=True))
    rates = tuple(by_levels(rate, reached) for rate in first_order.examined_rates)
    return replace(first_order, rhs=rates)


def _reached(
    arguments: Sequence[sp.Expr], first_order: FirstOrderSystem, system: System
) -> tuple[Array, Array]:
    """The smallest and the largest values of expressions (k,) along coarse trajectories."""
    bounds = np.array(system.box, dtype=float).reshape(-1, 2)
    points = check_points(bounds, _COARSE_POINTS, every_corner=True)
    times, states = coarse_states(system, points, _COARSE_STEPS)
    clock, *parameters = (coordinate.symbol for coordinate in first_order.coordinates)
    symbols = [clock, *first_order.functions, *parameters]
    dummies = {symbol: sp.Dummy(real=True) for symbol in symbols}
    expressions = [in_floats(stable(each)).xreplace(dummies) for each in arguments]
    function = sp.lambdify([*dummies.values()], expressions, [NUMPY, "numpy", "scipy"])
    with np.errstate(all="ignore"):
        values = function(times, *states, *points.T[:, :, None])
    at_all = np.stack([np.broadcast_to(each, states.shape[1:]) for each in values])
    flat = np.where(np.isfinite(at_all), at_all, np.nan).reshape(len(arguments), -1)
    return np.fmin.reduce(flat, axis=1), np.fmax.reduce(flat, axis=1)


def held_system(held: FirstOrderSystem | None, system: System, name: str) -> System | None:
    """The system of a held form, if there is one whose rates are those of a system."""
    try:
        source = "" if held is None else general_source(held, name)
    except ProblemError:
        return None
    if held is None:
        return None
    loaded = ModuleSpecification(source, f"{name} held", held.user_functions).load()
    return loaded if _agrees(loaded, system) else None


def with_sides(held: System, t: Array, u: Array, p: Array) -> Array:
    """States (n, m) beside the surfaces of a held system, with the sides that they are on."""
    sides = np.ones((held.n_sides, u.shape[1]))
    for _ in range(2):  # inner surfaces come first; sides may tell which others count
        for k, event in enumerate(held.events[-held.n_sides :]):
            sides[k] *= np.sign(event.when(t, np.concatenate([u, sides]), p))
    return np.concatenate([u, sides])


def _agrees(held: System, system: System) -> bool:
    """Whether the rates of both are the same at states beside the initial ones.

    And whether the factors of the held ones are finite.
    """
    bounds = np.array(system.box, dtype=float).reshape(-1, 2)
    p = np.ascontiguousarray(check_points(bounds, SAMPLES, every_corner=True).T)
    n, t = system.n_differential, np.full(p.shape[1], system.horizon[0])
    with np.errstate(all="ignore"):
        start = system.initial(p)
        beside = np.random.default_rng(0).standard_normal(start.shape)
        u = with_sides(held, t, start + beside * MINOR, p)
        ours = np.broadcast_to(held.rhs(t, u, p), u.shape)[:n]
        theirs = np.broadcast_to(system.rhs(t, u[:n], p), ours.shape)
        factors = (held.parameter_factors(j, values) for j, values in enumerate(p))
        if not all(np.isfinite(each).all() for each in factors):
            return False
        both = np.isfinite(ours) & np.isfinite(theirs) & np.isfinite(u).all(axis=0)
        size = np.abs(theirs).max(axis=1, keepdims=True, where=both, initial=0.0)
    return bool(both.any() and (np.abs(ours - theirs) <= AGREED * size)[both].all())


# -----------------------------------------------------------------------------
# The form over stretches of a problem with events, for methods that need separated terms.


@dataclass(frozen=True, eq=False)
class StretchedProblem:
    """A problem whose events are all at times that are known functions of the parameters.

    Its ``system`` separates once the order of its events is known.
    """

    first_order: FirstOrderSystem
    original: System
    separated: SeparatedForm
    source: str
    name: str

    @cached_property
    def system(self) -> System:
        """The system over clock time, which can be written over its stretches."""
        return replace(self.original, separated_stretches=self.separated_stretches)

    def separated_stretches(self, clock: Clock, box: Box) -> System:
        """The separated system over the pseudo-time of stretches.

        Raises
        ------
        SeparationError
            If the terms do not separate there either.
        """
        moved = zip(self.first_order.coordinates, (clock.horizon, *box), strict=True)
        coordinates = tuple(replace(c, lower=a, upper=b) for c, (a, b) in moved)
        first_order = replace(self.first_order, coordinates=coordinates)
        bounds = np.array(box, dtype=float).reshape(-1, 2)
        points = check_points(bounds, SAMPLES, every_corner=True)
        form = over_stretches(first_order, self._stretches(clock), np.ascontiguousarray(points.T))
        if form.coupled is not None:
            raise _does_not_separate(form.coupled)
        source = generate_source(quadratic_system(form.separated), self.name, form.meanings)
        functions = self.first_order.user_functions
        name = f"{self.name or 'system'} over stretches"
        system = ModuleSpecification(source, name, functions).load()
        whole = in_stretches(clock)
        n = whole.n_differential
        return replace(
            system,
            states=(*whole.states, *system.states[n:]),
            rhs=system.rhs if form.meanings else whole.rhs,
            specification=whole.specification,
            clock=clock,
        )

    def _stretches(self, clock: Clock) -> KnownStretches:
        """The known times of a clock, in their order."""
        order, jumps = clock.order, {jump.time: jump.values for jump in self.first_order.jumps}
        coordinates = self.first_order.coordinates
        events = [KnownTime(e.at, e.then) for e in self.first_order.events if e.at is not None]
        fixed = fixed_times(self.original, clock.cuts)
        events += [KnownTime(exact_number(time), jumps.get(time)) for time in fixed]
        steps, others = moving_cuts(coordinates, self.first_order.rhs)
        events += [KnownTime(time) for time in (*steps, *others)]
        instants = tuple(tuple(events[k] for k in instant) for instant in order.instants)
        end = None
        if order.ending is Ending.HORIZON:
            end = exact_number(clock.horizon[1])
        elif order.ending is Ending.LENGTH:
            end = instants[-1][0].at + exact_number(order.length)
        return KnownStretches(instants, end)


def _does_not_separate(term: GeneralTerm) -> SeparationError:
    """The error for a term that couples pseudo-time and parameters, or is no polynomial."""
    return SeparationError(
        f"over the stretches between events, {term.reason}",
        equation=term.origin,
        term=term.expression,
        remedy="method='cross', the default, takes it as it is",
    )


def known_times(first_order: FirstOrderSystem, system: System) -> bool:
    """Whether all events are at known times, and there are some, or switches that move.

    Not where initial values are guesses or at rest.
    """
    events = first_order.events
    if first_order.constraints.guessed or first_order.rest is not None:
        return False
    plain = all(
        e.at is not None and e.delay is None and e.priority is None and e.persistent for e in events
    )
    return plain and bool(events or system.features.n_moving_cuts)


# -----------------------------------------------------------------------------
# Outputs of a solve: quantities that are evaluated along its trajectories.


_ASK_SOLUTION = "name the unknowns in it in unknowns=, and ask that solution: .output(...)"
_Key = tuple[tuple[tuple[str, object], ...], tuple[float, float]]
"""Outputs by name, and the horizon."""
_EXAMPLE = 'give for example outputs={"energy": x**2 / 2}, or the name of a definition'


class SolveOutputs:
    """The outputs of solves of a compiled problem.

    They are translated once: solves on other boxes take the same functions. ``seconds`` is what
    the translation of the last ones took.
    """

    def __init__(self, system: System, metadata: SolutionMetadata) -> None:
        self.system, self.metadata, self.seconds = system, metadata, 0.0
        self._last: tuple[_Key | None, OutputFormulas] | None = None

    def over(self, domain: Domain, outputs: object, unknowns: object) -> Observation:
        """What trajectories on a domain are reduced to: unknowns, then outputs.

        An OptionError where outputs are no functions of the states at a time, or not smooth over
        time or the parameters.
        """
        system = self.system
        if system.events or system.at_rest is not None or system.jumps.times:
            what = (
                "events" if system.events else "jumps" if system.jumps.times else "a steady start"
            )
            raise OptionError(
                f"outputs along trajectories do not take {what}",
                remedy="solve for the unknowns, and ask the solution: solve(...).output(...)",
            )
        kept: dict[str, object] = {}
        if unknowns is not None:
            rows = counted_states(system, unknowns) or ()
            kept = {system.states[row]: system.states[row] for row in rows}
        asked = _named(outputs, kept)
        formulas = self._formulas(asked, {**kept, **asked}, domain)
        quantities = formulas.over(domain.box, domain.horizon)
        if not_smooth := _not_smooth(quantities, formulas):
            which = "the output" if len(quantities.names) == 1 else "one of the outputs"
            raise OptionError(
                f"{which} {listing(quantities.names)} {not_smooth}",
                term=quantities.names,
                remedy=_ASK_SOLUTION,
            )

        def values(times: Array, states: Array, points: Array) -> list[Array]:
            return [*quantities.values(times, states, points, [])]

        rows = tuple(source.row for source in quantities.sources)
        names, texts = quantities.names, quantities.texts

        def surfaces(times: Array, states: Array, points: Array) -> Sequence[Array]:
            narrow = quantities.state_surfaces(times, states, points)
            return narrow[: quantities.n_state_surfaces]

        looked_at = surfaces if quantities.n_state_surfaces else None
        return Observation(names, texts, rows, values, surfaces=looked_at)

    def _formulas(
        self, asked: Mapping[str, object], named: Mapping[str, object], domain: Domain
    ) -> OutputFormulas:
        """The functions of unknowns and outputs; those of the last solve if they are the same."""
        key = _key(named, domain)
        if self._last is not None and key is not None and self._last[0] == key:
            return self._last[1]
        began, unknowns = time.perf_counter(), self.system.unknowns
        for name, output in asked.items():
            _check_name(name, {*unknowns, *dict(self.metadata.definitions)})
            whose = _owner(name, unknowns)
            if whose and not _is_name(output, name):
                raise OptionError(
                    f"the output {quote(name)} has the name of {whose}, and is {quote(output)}",
                    term=name,
                    remedy="give the output another name",
                )
        compared = ComparedPoints.of(self.system, POINTS)
        samples = compared.time, compared.parameters, compared.states
        formulas = output_formulas(named, self.metadata, domain.horizon, samples)
        _check_states_alone(formulas.quantities)
        self.seconds = time.perf_counter() - began
        self._last = key, formulas
        return formulas


def _key(named: Mapping[str, object], domain: Domain) -> _Key | None:
    """What tells outputs apart; None where that is not known.

    Functions of the user are equal for SymPy if their names are.
    """
    terms = [term for term in named.values() if isinstance(term, str | sp.Basic)]
    symbolic = [term for term in terms if isinstance(term, sp.Basic)]
    if len(terms) < len(named) or known_applied(symbolic):
        return None
    return (*named.items(),), domain.horizon


def _owner(name: str, unknowns: Collection[str]) -> str:
    """Whose name it is in a problem, such as ``x_tt`` of a derivative; empty if it is free."""
    if name in unknowns:
        return "an unknown"
    of, _, order = str(name).rpartition("_")
    return "the derivative of an unknown" if of in unknowns and set(order) == {"t"} else ""


def _is_name(output: object, name: str) -> bool:
    """Whether an output is the unknown of a name."""
    try:
        return name_of(output) == name
    except EvaluationError:
        return False


def _check_name(name: object, held: Set[str]) -> None:
    """Raise an OptionError for a name that is neither an identifier nor in the problem."""
    if isinstance(name, str) and name.strip() and not name.isidentifier() and name not in held:
        raise OptionError(
            f"the name {quote(name)} of an output is not an identifier",
            term=name,
            remedy="use letters, digits and underscores, with no digit first",
        )


def _named(outputs: object, kept: Mapping[str, object]) -> dict[str, object]:
    """Outputs by name, as a mapping or as names of definitions; none has the name of a kept one."""
    if isinstance(outputs, str):
        outputs = {outputs: outputs}
    elif isinstance(outputs, list | tuple) and all(isinstance(name, str) for name in outputs):
        outputs = {name: name for name in outputs}
    if not isinstance(outputs, Mapping):
        raise OptionError(
            f"outputs={outputs!r} is not a mapping from names to expressions",
            term=outputs,
            remedy=_EXAMPLE,
        )
    if not outputs:
        raise OptionError("outputs is empty", remedy=_EXAMPLE)
    for name in outputs:
        if name in kept:
            raise OptionError(
                f"{quote(name)} is both an output and among unknowns",
                term=name,
                remedy="give the output another name",
            )
    return dict(outputs)


def _not_smooth(quantities: Quantities, formulas: OutputFormulas) -> str | None:
    """What outputs do that trajectories cannot be sampled for; None if they are smooth."""
    for name, places in zip(formulas.metadata.coordinates, quantities.cuts, strict=True):
        if places:
            return f"jumps, kinks or is narrow at {name} = {places[0]:.6g}"
    if formulas.narrow:
        return "kinks or is narrow over several parameters at once"
    if quantities.gap_texts:
        return f"has no value somewhere: {quantities.gap_texts[0]}"
    return None


def _check_states_alone(quantities: Quantities) -> None:
    """Raise an OptionError for what is no function of states, parameters and time."""
    if quantities.reductions:
        raise OptionError(
            f"{quote(quantities.reductions[0].text)} is over the whole of time",
            term=quantities.reductions[0].text,
            remedy="solve for what is inside as an output, and ask that solution: .output(...)",
        )
    derivatives = [source for source in quantities.sources if source.order]
    if derivatives:
        raise OptionError(
            "an output has a derivative that is no state",
            remedy="write what the equation says it is",
        )
