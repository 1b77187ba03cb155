"""The generated module: its sections in the order a person reads them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from fractions import Fraction

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.compiler.codegen.kernels import general_header, header, kernel_blocks, sum_text
from rankone.compiler.codegen.law_code import FormWriter, constraint_blocks, rest_blocks
from rankone.compiler.codegen.layout import (
    Formula,
    ModuleSpecification,
    constants_table,
    described_table,
    docstring,
    literal,
    nested,
    quoted,
    table,
)
from rankone.compiler.codegen.pointwise import PointwiseWriter
from rankone.compiler.codegen.printer import numpy_text
from rankone.compiler.codegen.rates import ArrayWriter, GeneralWriter, SeparatedWriter, long_tables
from rankone.compiler.codegen.sums import coordinate_functions, quadratic_system
from rankone.compiler.passes.feature_pass import SymbolicFeatures, features_of, features_of_table
from rankone.compiler.passes.first_order import FirstOrderSystem, RestForm
from rankone.compiler.passes.well_posed import Gap, NamedExpression, gaps_in_unknowns
from rankone.problem.algebra.term_table import TermTable
from rankone.problem.expressions.admissible import known_functions
from rankone.problem.expressions.notation import named_constants
from rankone.problem.forms import (
    ConstraintForms,
    Coordinate,
    EventForm,
    Jump,
    QuadraticSystem,
    SeparatedForm,
    State,
    Term,
)
from rankone.problem.functions import known_applied
from rankone.support.arrays import MANY_STATES
from rankone.support.budget import timed
from rankone.support.errors import check_kind, number
from rankone.support.files import WIDTH
from rankone.tensors.coordinates import LINEAR

Block = Sequence[str]
"""Source lines that stand together."""


def generate_source(
    form: QuadraticSystem | SeparatedForm,
    title: str | None = None,
    meanings: Sequence[sp.Expr] = (),
    constraints: ConstraintForms | None = None,
    rest: RestForm | None = None,
    events: Sequence[EventForm] = (),
) -> str:
    """Python source of the module for a system.

    Parameters
    ----------
    form : QuadraticSystem or SeparatedForm
        The system; a separated form is lowered and grouped first.
    title : str, optional
        First line of the module's docstring.
    meanings : sequence of Expr
        What the last of the differential states stand for, in the others.
    constraints : ConstraintForms, optional
        What algebraic equations say of the states.
    rest : RestForm, optional
        The system before the start, where that is a steady state.
    events : sequence of EventForm, optional
        Events that interrupt nothing.

    Returns
    -------
    str
        A module that :func:`rankone.compiler.codegen.layout.load_module` makes a
        :class:`rankone.trajectories.system.system.System` of; it imports NumPy alone, or SciPy as
        well where functions need it. The same form gives the same text, byte for byte.

    Raises
    ------
    SeparationError
        If a factor cannot be written with NumPy, or a derivative has a factor.
    OptionError
        If the form is neither.
    """
    remedy = "give separate(problem) or quadratic_system(form); what is compiled has `.source`"
    check_kind("generate_source", form, QuadraticSystem, SeparatedForm, remedy=remedy)
    system = form if isinstance(form, QuadraticSystem) else quadratic_system(form)
    large = len(system.differential) >= MANY_STATES
    writer = ArrayWriter(system) if large else SeparatedWriter(system)
    factors = [tuple(factor.expression for factor in distinct) for distinct in system.factors]
    expressions = [expression for distinct in factors for expression in distinct]
    expressions += [value for jump in system.jumps for value in jump.values]
    expressions += [expression for event in events for expression in event.expressions]
    features = features_of(system.coordinates, (), expressions)
    before, printed_before = rest_blocks(rest)
    sections: dict[str, Sequence[Block]] = {
        "Factors": coordinate_functions(system.coordinates, factors),
        "Right-hand side": writer.functions(),
        "Initial values": [writer.initial()],
        "Before the start": before,
        "Lifted states": _lifted(writer, system.differential, meanings),
        "Constraints": constraint_blocks(writer, constraints or ConstraintForms()),
        **_further_sections(writer, features, system.jumps, system.differential, []),
        "Events": _events(writer, events, system.coordinates),
        "Kernels": kernel_blocks(system),
    }
    n = len(system.differential)
    start = number(system.coordinates[0].lower)
    rates = [(t.coefficient, t.equation, t.factors, t.monomial) for t in system.rhs]
    starts = [(_start(t, system), t.equation, t.factors[1:]) for t in system.initial]
    tables = _tables(True, system.states, n, system.products, system.coordinates)
    of_rates = "# coefficient, state, row of the factor of each coordinate, states multiplied"
    of_starts = "# coefficient, state, row of the factor of each parameter"
    if large:
        tables += long_tables({"TERMS": (of_rates, rates), "INITIAL": (of_starts, starts)})
    else:
        tables.append(of_rates)
        tables += described_table("TERMS", rates, _term_texts(system.rhs, "{}'", system))
        tables.append(of_starts)
        texts = _term_texts(system.initial, f"{{}}({start})", system)
        tables += described_table("INITIAL", starts, texts)
    printed = [*expressions, *writer.printed, *printed_before]
    return _module(
        lambda scipy: header(system, writer.operations, title, scipy, rest),
        tables,
        sections,
        printed,
    )


def general_source(system: FirstOrderSystem, title: str | None = None) -> str:
    """Python source of the module for a system that does not separate.

    It has what sampling trajectories needs: pointwise functions, features, and the known functions
    of one coordinate, which say where to look closely. There are no terms and no kernels. A
    ProblemError if NumPy and SciPy lack a function or its derivative.
    """
    table = system.table
    if table is not None and table.forms and len(system.states) >= MANY_STATES:
        return _tabulated_source(system, table, title)
    writer = GeneralWriter(system)
    further = [*system.initial, *(value for jump in system.jumps for value in jump.values)]
    further += system.event_expressions
    expressions = [*system.rhs, *further]
    factors = known_functions(system.coordinates, expressions)
    before, printed_before = rest_blocks(system.rest)
    features = features_of(system.coordinates, system.rhs, further)
    features = features.without(system.functions[len(system.functions) - len(system.switches) :])
    sections: dict[str, Sequence[Block]] = {
        "Factors": coordinate_functions(
            system.coordinates, [(sp.S.One, *functions) for functions in factors]
        ),
        "Right-hand side": writer.functions(),
        "Initial values": [writer.initial()],
        "Before the start": before,
        "Constraints": constraint_blocks(writer, system.constraints),
        **_further_sections(writer, features, system.jumps, system.states, writer.named_rates()),
        "Events": _events(writer, system.events, system.coordinates, len(system.switches)),
    }
    tables = _tables(False, system.states, len(system.states), (), system.coordinates)
    printed = [*expressions, *writer.printed, *printed_before]
    return _module(
        lambda scipy: general_header(system, writer.operations, title, scipy),
        tables,
        sections,
        printed,
    )


def _tabulated_source(system: FirstOrderSystem, terms: TermTable, title: str | None) -> str:
    """Source of the module for many states, from the table of their rates."""
    writer = FormWriter(system, terms)
    further = system.known_expressions
    factors = known_functions(system.coordinates, further)
    features = features_of_table(system, terms)
    sections: dict[str, Sequence[Block]] = {
        "Factors": coordinate_functions(
            system.coordinates, [(sp.S.One, *functions) for functions in factors]
        ),
        "Right-hand side": writer.functions(),
        "Initial values": [writer.initial()],
        **_further_sections(writer, features, (), system.states, ()),
    }
    tables = _tables(False, system.states, len(system.states), (), system.coordinates)
    return _module(
        lambda scipy: general_header(system, writer.operations, title, scipy),
        [*tables, *writer.tables()],
        sections,
        [*further, *writer.printed],
    )


def _module(
    header_of: Callable[[bool], list[str]],
    tables: Sequence[str],
    sections: Mapping[str, Sequence[Block]],
    printed: Sequence[sp.Expr],
) -> str:
    """The text of a module; sections without lines are left out.

    ``header_of`` makes the lines of the docstring from whether SciPy is imported. Functions defined
    by data that the expressions ``printed`` apply come first.
    """
    data = {type(applied).__name__: type(applied) for applied in known_applied(printed)}
    definitions = [function.definition() for _, function in sorted(data.items())]
    blocks: list[Block] = []
    for title, listed in {"Data": definitions, **sections}.items():
        first, *following = [block for block in listed if block] or [[]]
        if first:
            blocks += [[f"# --- {title} ".ljust(WIDTH, "-"), *first], *following]
    body = "\n\n\n".join(map("\n".join, blocks)) + "\n"
    imports = ["import numpy as np"]
    if "special." in body:
        imports.append("from scipy import special")
    if "sparse." in body:
        imports.append("from scipy import sparse")
    if "CubicSpline(" in body:
        imports.append("from scipy.interpolate import CubicSpline")
    lines = docstring(header_of(len(imports) > 1), indent="")
    constants = {c.name: float(c) for c in named_constants(printed)}
    before = ["", *constants_table(constants)] if constants else []
    return "\n".join([*lines, "", *imports, *before, "", *tables]) + "\n\n\n" + body


def _start(term: Term, system: QuadraticSystem) -> Fraction | float | Formula:
    """The coefficient of an initial value, times the constants in it."""
    if not term.factors[0]:
        return term.coefficient
    constants = system.factors[0][term.factors[0]].expression
    return Formula(numpy_text(sp.Rational(term.coefficient) * constants, {}))


def _tables(
    separated: bool,
    states: Sequence[State],
    n: int,
    products: Iterable[tuple[int, int]],
    coordinates: Sequence[Coordinate],
) -> list[str]:
    """Whether it separates, its states, its parameters, their domain, tolerances of states."""
    clock, *parameters = coordinates
    scaled = any(c.scale != LINEAR for c in parameters)
    atol = nested((s.name, float(s.atol)) for s in states if s.atol is not None)
    names_of: dict[str, list[str]] = {}
    for state in states:
        names_of.setdefault(state.unit, []).append(state.name)
    alike = [tuple(names) for unit, names in names_of.items() if unit and len(names) > 1]
    return [
        f"SEPARATED = {separated}",
        *table("STATES", [quoted(state.name) for state in states]),
        f"N_DIFFERENTIAL = {n}",
        *table("PRODUCTS", nested(products)),
        *table("PARAMETERS", [quoted(parameter.name) for parameter in parameters]),
        f"TIME = {literal((float(clock.lower), float(clock.upper)))}",
        *table("BOX", nested((float(c.lower), float(c.upper)) for c in parameters)),
        *(table("SCALES", [quoted(c.scale) for c in parameters]) if scaled else ()),
        *(table("ATOL", atol) if atol else ()),
        *(table("ALIKE", nested(alike)) if alike else ()),
    ]


def _term_texts(terms: Sequence[Term], left: str, system: QuadraticSystem) -> list[str]:
    """Each term with the left side of its equation: ``x': 1.5*x``."""
    names = system.names
    return [f"{left.format(names[t.equation])}: {sum_text([t], system)}" for t in terms]


def _lifted(
    writer: PointwiseWriter, states: Sequence[State], meanings: Sequence[sp.Expr]
) -> list[Block]:
    """How many states are lifted, and what they stand for."""
    if not meanings:
        return []
    n, names = len(states), [state.name for state in states[len(states) - len(meanings) :]]
    summary = f"What the lifted states stand for at u ({n}, ...): ({len(meanings)}, ...)."
    return [
        [f"N_LIFTED = {len(meanings)}"],
        writer.vector("meanings", "t, u, p", summary, meanings, names),
    ]


def _further_sections(
    writer: PointwiseWriter,
    features: SymbolicFeatures,
    jumps: Sequence[Jump],
    states: Sequence[State],
    rates: Sequence[NamedExpression],
) -> dict[str, list[Block]]:
    """Features, jumps and gaps."""
    resets = [
        (f"the value of {state.name} after the jump at {number(jump.time)}", None, value)
        for jump in jumps
        for state, value in zip(states, jump.values, strict=True)
    ]
    return {
        "Features": _features(writer, features),
        "Jumps": [
            _jump_tables(writer, jumps),
            writer.jumped(jumps),
            *_gaps(writer, "jump_gaps", gaps_in_unknowns(resets)),
        ],
        "Gaps": _gaps(writer, "gaps", gaps_in_unknowns(rates)),
    }


def _features(writer: PointwiseWriter, features: SymbolicFeatures) -> list[Block]:
    """Cuts and surfaces, and how many there are; nothing of what the system has not."""
    n = len(writer.states)
    tables: list[str] = []
    if any(cuts.points for cuts in features.cuts):
        tables += table("CUTS", nested(tuple(sorted(cuts.points)) for cuts in features.cuts))
    if any(cuts.periodic for cuts in features.cuts):
        periodic = (tuple(sorted(cuts.periodic)) for cuts in features.cuts)
        tables += table("PERIODIC_CUTS", nested(periodic))
    moving, surfaces = features.moving_cuts, features.parameter_surfaces
    tables += [f"N_MOVING_CUTS = {len(moving)}"] if moving else []
    if steps := len(features.moving_steps):
        tables.append(f"N_MOVING_STEPS = {steps}  # the first: functions jump or peak there")
    tables += [f"N_PARAMETER_SURFACES = {len(surfaces)}"] if surfaces else []
    if features.state_surfaces:
        counts = len(features.peaks), len(features.kinks), len(features.steps)
        tables.append(f"STATE_SURFACES = {counts}  # peaks, kinks, steps")
    times = f"Times at which functions of time and of p (d, ...) switch: ({len(moving)}, ...)."
    of_p = f"Zero where functions of p (d, ...) switch or peak: ({len(surfaces)}, ...)."
    over_states = features.state_surfaces
    of_u = f"Zero where functions of u ({n}, ...) switch or peak: ({len(over_states)}, ...)."
    return [
        tables,
        writer.vector("moving_cuts", "p", times, moving),
        writer.vector("parameter_surfaces", "p", of_p, surfaces),
        writer.vector("state_surfaces", "t, u, p", of_u, over_states),
    ]


def _jump_tables(writer: PointwiseWriter, jumps: Sequence[Jump]) -> list[str]:
    """The times with their kinds, and the kinds that are not polynomials of the unknowns."""
    if not jumps:
        return []
    kinds = list(Jump.kinds(jumps))
    rows = ((jump.time, kinds.index(jump.values)) for jump in jumps)
    rough = (k for k, after in enumerate(kinds) if not all(map(writer.is_polynomial, after)))
    return [*table("JUMPS", nested(rows)), *table("ROUGH_JUMPS", nested(rough))]


def _events(
    writer: PointwiseWriter,
    events: Sequence[EventForm],
    coordinates: Sequence[Coordinate],
    sides: int = 0,
) -> list[Block]:
    """The events, what crosses zero, and the states after those that reset some."""
    if not events:
        return []
    n, k = len(writer.states), len(events)
    times = [e.at for e in events if e.at is not None]
    delays = [e.delay for e in events if e.delay is not None]
    priorities = [e.priority for e in events if e.priority is not None]
    of_times = f"Times of events of parameters p (d, ...): ({len(times)}, ...)."
    of_heights = f"What crosses zero at events, at u ({n}, ...): ({k}, ...)."
    of_delays = f"Time from an event to its resets, at u ({n}, ...): ({len(delays)}, ...)."
    of_order = f"Which event at one instant is first, at u ({n}, ...): ({len(priorities)}, ...)."
    after = f"States right after it from u ({n}, ...) before, at p (d, ...): ({n}, ...)."
    names = [state.name for state in writer.states]
    return [
        _event_tables(events, [c.symbol for c in coordinates[1:]], sides),
        writer.vector("known_event_times", "p", of_times, times),
        writer.vector("event_heights", "t, u, p", of_heights, [e.when for e in events]),
        writer.vector("event_delays", "t, u, p", of_delays, delays),
        writer.vector("event_priorities", "t, u, p", of_order, priorities),
        *(
            writer.vector(f"after_event_{i}", "t, u, p", after, e.then, names)
            for i, e in enumerate(events)
            if e.then is not None
        ),
    ]


def _event_tables(
    events: Sequence[EventForm], parameters: Sequence[sp.Symbol], sides: int
) -> Block:
    """What each event is, and the positions of those that are scheduled, delayed and so on."""
    rows = ((quoted(e.name), e.direction, e.terminal, e.then is not None) for e in events)
    affine = [(i, a) for i, e in enumerate(events) if (a := e.coefficients(parameters)) is not None]
    scheduled = tuple(i for i, e in enumerate(events) if e.at is not None)
    others = {
        "DELAYED": tuple(i for i, e in enumerate(events) if e.delay is not None),
        "RANKED": tuple(i for i, e in enumerate(events) if e.priority is not None),
        "WITHDRAWN": tuple(i for i, e in enumerate(events) if not e.persistent),
        "SINGLE": tuple(i for i, e in enumerate(events) if not e.overlapping),
    }
    return [
        "# name, direction, whether it ends the trajectory, whether it resets states",
        *table("EVENTS", [f"({', '.join(map(str, row))})" for row in rows]),
        *([f"N_SIDES = {sides}"] if sides else []),
        *([f"KNOWN_EVENTS = {scheduled}"] if scheduled else []),
        *(table("AFFINE_EVENT_TIMES", nested(affine)) if affine else []),
        *(f"{kind}_EVENTS = {positions}" for kind, positions in others.items() if positions),
    ]


def _gaps(writer: PointwiseWriter, name: str, gaps: Sequence[Gap]) -> list[Block]:
    """The texts of gaps, and the function that says which ones a state lies in."""
    texts = []
    for gap in gaps:
        unknowns = gap.function.atoms(AppliedUndef) | gap.region.atoms(AppliedUndef)
        text = gap.text({u: sp.Symbol(u.func.__name__) for u in unknowns})
        texts.append(text if gap.equation is None else f"equation {gap.equation}: {text}")
    regions = [sp.Piecewise((1, gap.region), (0, True)) for gap in gaps]
    summary = f"One where a piecewise function has no branch, else zero: ({len(gaps)}, ...)."
    listed = table(name.upper(), [quoted(text) for text in texts]) if gaps else []
    return [listed, writer.vector(name, "t, u, p", summary, regions)]


def generated_module(
    system: FirstOrderSystem, separated: SeparatedForm, name: str | None, timings: dict[str, float]
) -> tuple[QuadraticSystem | None, ModuleSpecification]:
    """The module of a system, and its quadratic form if it separates; timed."""
    with timed(timings, "lowering"):
        general = bool(separated.general) or any(event.interrupts for event in system.events)
        quadratic = None if general else quadratic_system(separated)
    with timed(timings, "code generation"):
        if quadratic is None:
            source = general_source(system, name)
        else:
            further = system.constraints, system.rest, system.events
            source = generate_source(quadratic, name, (), *further)
    return quadratic, ModuleSpecification(source, name or "system", system.user_functions)
