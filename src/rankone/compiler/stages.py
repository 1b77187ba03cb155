"""The stages of compilation, what each makes, and the call of one after the other.

===============  =====================  ==========================================================
stage            result                 what happens
===============  =====================  ==========================================================
first order      ``.first_order``       orders reduced, masses inverted: u' = f(t, p, u)
weak form        ``.weak_form``         residual times test function, integrated over all dimensions
separation       ``.separated``         every term factored into functions of one coordinate
lowering         ``.quadratic``         products of at most two states, terms grouped by factors;
                                        None if there are terms that do not separate
lifting          ``.lifted``            for those, functions of unknowns as further unknowns
code generation  ``.source``            kernels, factors and pointwise functions as readable text
import           ``.system``            the text is run as a module
solve            a ``Solution``         an engine enriches separated tensors over a domain
===============  =====================  ==========================================================

Each stage takes what the one before made, and nothing else, and is kept as it was made; what not
every solve needs is derived when it is first asked for. Each is timed in ``.timings`` (seconds) and
in the log ``rankone``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import sympy as sp

from rankone.compiler.agreement import AGREED, DisagreementError, check_problem, check_table
from rankone.compiler.codegen.kernels import equation_texts, general_equation_texts
from rankone.compiler.codegen.layout import ModuleSpecification, with_constants
from rankone.compiler.codegen.module import general_source, generated_module
from rankone.compiler.comparison import LOST_SHARE
from rankone.compiler.passes import (
    FirstOrderSystem,
    WeakForm,
    check_stages,
    check_start,
    symbolic_forms,
)
from rankone.compiler.passes.feature_pass import SymbolicFeatures, features_of
from rankone.compiler.passes.first_order import additive_parameters
from rankone.compiler.passes.well_posed import check_gaps
from rankone.compiler.reformulated import (
    LiftedProblem,
    StretchedProblem,
    check_totals,
    held_form,
    held_system,
    known_times,
    lifted_problem,
    other_numbers,
    renumbered,
)
from rankone.problem.forms import MOST_KERNEL_STATES, GeneralTerm, QuadraticSystem, SeparatedForm
from rankone.problem.problem import Problem
from rankone.solvers.outcome import SolutionMetadata
from rankone.solvers.selection import AUTO, ENGINES, engines_for
from rankone.support import __version__
from rankone.support.budget import timed
from rankone.support.errors import (
    OptionError,
    RankoneError,
    SeparationError,
    abridged,
    count,
    number,
    quote,
)
from rankone.support.options import RTOL
from rankone.tensors.coordinates import with_measure
from rankone.trajectories.system.system import System

_ANY_SYSTEM = (AUTO, "cross")  # Methods that need no separated terms


@dataclass(frozen=True, eq=False)
class CompiledStages:
    """The stages of a problem; :class:`rankone.CompiledProblem` solves and exports them."""

    problem: Problem
    first_order: FirstOrderSystem
    weak_form: WeakForm
    separated: SeparatedForm
    quadratic: QuadraticSystem | None
    source: str
    timings: dict[str, float]

    @cached_property
    def system(self) -> System:
        """The generated module; run again from its source after unpickling."""
        name = self.problem.name or "system"
        return ModuleSpecification(self.source, name, self.user_functions).load()

    @cached_property
    def lifted(self) -> LiftedProblem | None:
        """Functions of the unknowns as further unknowns, for the methods that need separated terms.

        None where all terms separate, or where something cannot be lifted. Printed, it gives for
        each further unknown its meaning, its equation and its initial value.
        """
        return self._lifting if isinstance(self._lifting, LiftedProblem) else None

    @cached_property
    def _lifting(self) -> LiftedProblem | sp.Expr | None:
        """The lifted form, what cannot be lifted, or None where there is nothing to lift."""
        if self.quadratic is not None or self.first_order.events:
            return None
        return lifted_problem(self.first_order, self.system, self.problem.name or "")

    @cached_property
    def _stretched(self) -> StretchedProblem | None:
        """The form over stretches, where all events are at known times."""
        if self.quadratic is not None or not known_times(self.first_order, self.system):
            return None
        name = self.problem.name or ""
        return StretchedProblem(self.first_order, self.system, self.separated, self.source, name)

    @cached_property
    def _held_form(self) -> FirstOrderSystem | None:
        """The equations with the sides of switches as states, if there are switches to hold.

        Rates that are polynomials of the states have none.
        """
        return None if self.quadratic is not None else held_form(self.first_order, self.system)

    @cached_property
    def _held(self) -> System | None:
        """The generated module of the same."""
        return held_system(self._held_form, self.system, self.problem.name or "system")

    @property
    def held_source(self) -> str | None:
        """Text of that module; None where no switches are held."""
        specification = None if self._held is None else self._held.specification
        return getattr(specification, "source", None)

    @cached_property
    def features(self) -> SymbolicFeatures:
        """All that is not smooth in the equations, or so narrow that samples may miss it.

        Printed, it lists the times, values of parameters and surfaces at which that is, with the
        names of switches whose crossings end stretches.
        """
        first_order = self.first_order
        jumps = (value for jump in first_order.jumps for value in jump.values)
        further = [*first_order.initial, *jumps, *first_order.event_expressions]
        features = features_of(first_order.coordinates, first_order.rhs, further)
        held = self._held_form
        if held is None:
            return features
        names = (event.name for event in held.events[-len(held.switches) :])
        return replace(features, switches=dict(zip(names, held.switches, strict=True)))

    @cached_property
    def _additive(self) -> tuple[str, ...]:
        """The parameters whose effects add up."""
        return additive_parameters(self.first_order)

    def form_for(self, method: str) -> CompiledStages | LiftedProblem | StretchedProblem:
        """What a method takes: an object with ``separated``, ``source`` and ``system``.

        Raises
        ------
        OptionError
            If the method needs separated terms, and there are events of the states or too many
            states.
        SeparationError
            If it needs them, and there is no lifted form.
        """
        if method in _ANY_SYSTEM or self._has_operators:
            return self
        if self._operators is not None:
            if self._many_states(method) is None:
                return self
            raise OptionError(
                f"method={method!r} does not apply: {self._many_states(method)}",
                remedy="leave method= out, or take cross",
            )
        if self.lifted is not None:
            return self.lifted
        if self._stretched is not None:
            return self._stretched
        if self.first_order.events:
            guessed = self.first_order.constraints.guessed
            which = "events at known times only"
            if guessed or self.first_order.rest is not None:
                which = "no events beside guessed unknowns and steady states at the start"
            raise OptionError(
                f"method={method!r} takes {which}", remedy="leave method= out, or take cross"
            )
        raise SeparationError(
            str(self.methods[method]),
            equation=self.separated.general[0].origin,
            term=self._lifting,
            remedy=_without_lifting(self._lifting),
        )

    @property
    def _operators(self) -> QuadraticSystem | None:
        """The quadratic system, for methods that follow no events."""
        return None if self.first_order.events else self.quadratic

    @property
    def _has_operators(self) -> bool:
        """Whether there are kernels, which methods other than cross need."""
        return bool(self._operators and self._operators.has_kernels)

    def _many_states(self, method: str) -> str | None:
        """Why a method does not take a separated system of very many states, if so."""
        assert self.quadratic is not None
        states, products = len(self.quadratic.differential), len(self.quadratic.products)
        if method == "train" and not products:
            return None
        count = f"there are {states + products} states" + (" and products" if products else "")
        if method == "train":
            return f"{count}, and above {MOST_KERNEL_STATES} no term may multiply three states"
        return f"{count}, and it takes at most {MOST_KERNEL_STATES}"

    @property
    def user_functions(self) -> Mapping[str, Callable[..., object]]:
        """The functions of the user that the source calls, by the names it calls them by."""
        return self.first_order.user_functions

    @property
    def methods(self) -> dict[str, str | None]:
        """For each method None if it applies, else the reason why not.

        With events at known times the order of events, found by :meth:`solve`, tells whether
        equations that depend on time separate over the stretches between them.
        """
        reason = None
        applies = self._has_operators or self.lifted is not None
        if applies or self._stretched is not None:
            pass
        elif self._operators is not None:
            return {
                name: None if name in _ANY_SYSTEM else self._many_states(name) for name in ENGINES
            }
        elif self.first_order.events:
            reason = "events of the states are followed by trajectories, which cross samples"
        else:
            reason = (
                f"{self.separated.general[0].reason}; {quote(self._lifting)} has no lifted form"
            )
        return {name: None if name in _ANY_SYSTEM else reason for name in ENGINES}

    @property
    def automatic(self) -> tuple[str, ...]:
        """The methods that ``method="auto"`` tries one after the other."""
        parameters = len(self.problem.parameters)
        tried = engines_for(
            AUTO,
            parameters=parameters,
            separated=self._has_operators,
            states=len(self.first_order.states),
        )
        return tuple(engine.name for engine in tried)

    def __getstate__(self) -> dict[str, object]:
        rebuilt = (
            "system",
            "_lifting",
            "_stretched",
            "_held",
            "_held_form",
            "features",
            "_outputs",
        )
        return {name: stage for name, stage in self.__dict__.items() if name not in rebuilt}

    def __repr__(self) -> str:
        clock, *parameters = self.separated.coordinates
        names = ", ".join(abridged([state.name for state in self.separated.states], str))
        distributions = self.problem.distributions
        box = ", ".join(
            with_measure(f"{c.name} in [{c.lower:g}, {c.upper:g}]", distributions.get(c.name))
            for c in (clock, *parameters)
        )
        general = count(len(self.separated.general), "general term")
        general = f"{general}, " if self.separated.general else ""
        return (
            f"CompiledProblem of {names} over {box}\n"
            f"{len(self.separated.terms)} separated terms, "
            f"{general}"
            f"{self.source.count(chr(10))} lines generated, "
            f"compiled in {sum(self.timings.values()):.2f} s"
        )

    def metadata(self, rtol: float = RTOL, method: str = "train") -> SolutionMetadata:
        """What a solution of the problem says was asked."""
        return replace(self._metadata, rtol=rtol, method=method)

    @cached_property
    def _metadata(self) -> SolutionMetadata:
        """The same for some tolerance and method: the texts of a thousand equations take long."""
        form, named = self.separated, self.problem.shorthand.named.values()
        clock, *parameters = form.coordinates
        return SolutionMetadata(
            states=tuple(state.name for state in form.states),
            roles=tuple(state.role for state in form.states),
            parameters=tuple(c.name for c in parameters),
            box=tuple((c.lower, c.upper) for c in parameters),
            time=clock.name,
            horizon=(clock.lower, clock.upper),
            rtol=RTOL,
            method="train",
            equations=tuple(
                general_equation_texts(self.first_order)
                if self.quadratic is None
                else equation_texts(self.quadratic, self.first_order.rest)
            )
            + tuple(f"{constant} = {number(float(constant))}" for constant in named),
            version=__version__,
            source=self.source,
            units=tuple((self.problem.units or {}).items()),
            distributions=tuple(self.problem.distributions.items()),
            correlations=tuple(
                (*pair, rho) for pair, rho in (self.problem.correlation or {}).items()
            ),
            name=self.problem.name or "",
            constants=tuple(
                (symbol.name, float(number))
                for symbol, number in (self.problem.constants or {}).items()
            ),
            definitions=tuple(self.problem.shorthand.texts),
            atol=tuple((self.problem.atol or {}).items()),
            additive=self._additive,
        )


def _without_lifting(expression: sp.Expr | LiftedProblem | None) -> str:
    """What to do about an expression that has no lifted form."""
    remedy = "method='cross', the default, takes it as it is"
    if not isinstance(expression, sp.Abs | sp.sign):
        return remedy
    (argument,) = expression.args
    plain = argument if isinstance(expression, sp.Abs) else sp.S.One
    return (
        f"{remedy}; where {quote(argument)} keeps its sign, write {quote(plain)} or {quote(-plain)}"
    )


# -----------------------------------------------------------------------------
# The pipeline: from a problem to a generated module.


_Stages = TypeVar("_Stages", bound=CompiledStages)


def with_numbers_of(compiled: _Stages, problem: Problem) -> _Stages | None:
    """What was compiled of a problem that differs in numbers of run-time constants alone.

    None if that does not hold for these numbers: then compiling anew says why, or does better.
    """
    if compiled.problem is problem:
        return compiled
    timings: dict[str, float] = {}
    try:
        with timed(timings, "constants"):
            numbers = other_numbers(compiled.problem, problem)
            constants = {c.name: float(c) for c in problem.shorthand.named.values()}
            other = type(compiled)(
                problem,
                renumbered(compiled.first_order, numbers),
                renumbered(compiled.weak_form, numbers),
                renumbered(compiled.separated, numbers),
                renumbered(compiled.quadratic, numbers),
                with_constants(compiled.source, constants),
                timings,
            )
            coordinates, first_order = other.separated.coordinates, other.first_order
            check_gaps(first_order.piecewise(), coordinates)
            check_stages(first_order, other.separated, other.system, coordinates)
        with timed(timings, "agreement"):
            lost = LOST_SHARE if other.quadratic is None else AGREED
            check_problem(problem, first_order, other.system, lost)
    except RankoneError:
        return None
    return other


def compiled_stages(kind: type[_Stages], problem: Problem) -> _Stages:
    """Every stage of a problem, up to the generated module."""
    timings: dict[str, float] = {}
    system, weak, separated = symbolic_forms(problem, timings)
    quadratic, specification = generated_module(system, separated, problem.name, timings)
    source = specification.source
    compiled = kind(problem, system, weak, separated, quadratic, source, timings)
    with timed(timings, "import"):
        vars(compiled)["system"] = specification.load()
    check_totals(problem, compiled.system)
    if separated.general or system.constraints.guessed or system.rest is not None:
        check_start(system, compiled.system, system.coordinates)
    with timed(timings, "agreement"):
        return _agreeing(compiled)


def _agreeing(compiled: _Stages) -> _Stages:
    """The compiled problem, checked against its equations; not separated where that loses digits.

    Multiplied out, a power of ``x - 310`` is a difference of large numbers.
    """
    problem, first_order = compiled.problem, compiled.first_order
    if problem.table is not None and compiled.quadratic is not None:
        check_table(problem, problem.table, compiled.system)
        return compiled
    if first_order.table is not None and first_order.table.forms:
        try:
            check_table(problem, first_order.table, compiled.system)
            return compiled
        except DisagreementError:  # or rounding, which the comparison below tells apart
            pass
    if compiled.quadratic is not None:
        try:
            check_problem(problem, first_order, compiled.system, AGREED)
            return compiled
        except DisagreementError as error:
            as_written = _not_separated(compiled, error)
        try:
            check_problem(problem, first_order, as_written.system, AGREED)
            return as_written
        except DisagreementError:
            pass  # no form keeps more digits
    check_problem(problem, first_order, compiled.system)
    return compiled


def _not_separated(compiled: _Stages, error: DisagreementError) -> _Stages:
    """The problem with functions as they are written, since multiplied out they lose digits."""
    first_order = compiled.first_order
    origins = first_order.origins
    state = origins.index(error.equation) if error.equation in origins else 0
    rate = first_order.rhs[state]
    reason = f"{quote(rate)} loses digits when it is multiplied out"
    remedy = "method='cross' takes it as it is; count the unknowns from where they are"
    term = GeneralTerm(state, rate, False, reason, remedy, error.equation)
    return replace(
        compiled,
        separated=replace(compiled.separated, general=(term,)),
        quadratic=None,
        source=general_source(first_order, compiled.problem.name),
    )
