"""A system as solvers see it: what a generated module defines, complete and typed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, TypeAlias, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import COINCIDENT, NEGLIGIBLE, Array
from rankone.support.errors import OptionError, ProblemError, listing
from rankone.tensors.coordinates import LINEAR
from rankone.trajectories.system.features import (
    BOTH,
    CROSSINGS,
    GAP_REMEDY,
    Constraints,
    EventOrder,
    Features,
    ForcedOrder,
    Gaps,
    Jumps,
    Marker,
    OfMarks,
    OfParameters,
    OfStates,
    OfTrajectory,
    Row,
    SystemEvent,
    VectorLike,
    no_rows,
    unchanged,
)


@dataclass(frozen=True, eq=False)
class PatternJacobian:
    """The Jacobian df/du (size, size, ...) of t, u and p, which is zero outside of a pattern.

    The pattern has ``rows`` and ``columns``, each (k,), sorted by rows; ``entries`` are (k, ...).
    Called, it is an array with all zeros.
    """

    size: int
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    entries: OfStates

    def __call__(self, t: float | Array, u: VectorLike, p: VectorLike) -> Array:
        entries = self.entries(t, u, p)
        dense = np.zeros((self.size, self.size, *entries.shape[1:]))
        dense[self.rows, self.columns] = entries
        return dense


def pattern_of(jacobian: OfStates) -> PatternJacobian | None:
    """The pattern of a Jacobian, if it has one."""
    return jacobian if isinstance(jacobian, PatternJacobian) else None


# -----------------------------------------------------------------------------
# The system under whose conditions trajectories come to rest before another one starts.


@dataclass(frozen=True, eq=False)
class Rest:
    """The system before a start at its steady state.

    ``initial`` values at p (d, m) are where its trajectories start, (n, m); ``rhs`` and its
    ``jacobian`` are as those of a system. ``after`` resets the states at rest at the start, if it
    is not None. Trajectories are looked at from the time ``settle[0]`` on, up to ``settle[1]``.
    """

    initial: OfParameters
    rhs: OfStates
    jacobian: OfStates
    after: OfStates | None
    settle: tuple[float, float]


# -----------------------------------------------------------------------------
# A system as solvers see it: what a generated module defines, complete and typed.
#
# A generated module is plain NumPy. It holds a *quadratic* system in separated form: products of
# more than two states are lowered by auxiliary algebraic states ("products", ``w = s_a s_b``),
# which follow the differential states in ``states``. Terms are grouped by *signature*: the tuple of
# parameter-factor rows they share, so that one contraction over the parameters serves a whole
# group.
#
# Within the group ``g`` the right-hand side is
#
#     prod_j parameter_factors(j, p_j)[signatures[g][j]]
#         * (constant_g(t) + linear_g(t) x + quadratic_g(t)(x, x)),
#
# and the kernels below evaluate the bracket on ``P`` time points for ``r`` columns at once.
#
# =====================================  =======================================================
# kernel                                 meaning (n states in all, P points)
# =====================================  =======================================================
# ``constant(phi)``                      y (n, P)
# ``linear(phi, x)``                     x (n, P, r) -> y (n, P, r)
# ``linear_adjoint(phi, w)``             w (n, P, s) -> v (n, P, s): <w, linear(x)> = <v, x>
# ``quadratic(phi, x, z)``               x (n, P, r), z (m, P, r, s) -> y (n, P, s); for every
#                                        monomial x_a x_b of row c with b = paired[g][k]:
#                                        y[c][P, s] += coefficient phi x[a][P, r] z[k][P, r, s],
#                                        summed over r
# ``quadratic_adjoint(phi, x, w)``       x (n, P, r), w (n, P, s) -> v (m, P, r, s):
#                                        v[k][P, r, s] += coefficient phi x[a][P, r] w[c][P, s]
# =====================================  =======================================================
#
# ``phi`` is the array of time factors at the P points, shape (number of time factors, P).
#
# A module leaves out what its system does not have; :func:`system_of` fills in what is empty.


Kernel: TypeAlias = Callable[..., Array]
"""One of the functions of the table above."""
Box: TypeAlias = Sequence[tuple[float, float]]
"""An interval for each parameter."""
UserFunction: TypeAlias = Callable[..., object]
"""A function that the user gave for an expression."""
SHARED_UNIT = 1e-12
"""Part of the largest of the states that share a unit below which errors do not count."""
Answer = TypeVar("Answer")
Member = TypeVar("Member")


class PointRates(Protocol):
    """Rates at a point of the box; the ``cost`` of a call is operations."""

    @property
    def cost(self) -> float: ...

    def rates(self, t: float, u: Array) -> Array:
        """The derivatives (n,) of the states u (n,)."""

    def jacobian(self, t: float, u: Array) -> Array:
        """Their derivatives (n, n) by the states."""


class ModuleSpecification(Protocol):
    """What a system is loaded from, in any process. Pickles."""

    @property
    def namespace(self) -> Mapping[str, UserFunction]:
        """The functions of the user that the system calls."""

    def call(self, function: Callable[..., Answer], *arguments: object) -> Answer:
        """``function(system, *arguments)``, in any process."""


@dataclass(frozen=True, eq=False)
class Kernels:
    """The separated right-hand side, group by group; no groups where it does not separate.

    ``signatures`` has for each group and parameter the row of ``parameter_factors``, row 0 is one;
    ``paired`` for each group the second states of its quadratic monomials, the order of z and v.
    Each kernel is None for groups that have no such terms.
    """

    signatures: tuple[tuple[int, ...], ...] = ()
    paired: tuple[tuple[int, ...], ...] = ()
    constant: tuple[Kernel | None, ...] = ()
    linear: tuple[Kernel | None, ...] = ()
    linear_adjoint: tuple[Kernel | None, ...] = ()
    quadratic: tuple[Kernel | None, ...] = ()
    quadratic_adjoint: tuple[Kernel | None, ...] = ()


@dataclass(frozen=True, eq=False)
class System:
    """A system to be solved. Every member is there, empty where the system has nothing of it.

    ``states`` are the ``n_differential`` differential states, of which the last ``n_lifted`` are
    functions of the others, then one state for each of the ``products`` (a, b) of two states. Where
    the right-hand side is not ``separated``, there are no kernels and no terms.

    ``terms`` are the right-hand sides term by term, of any degree: (coefficient, differential
    state, rows of the time factor and of the factor of each parameter, differential states
    multiplied). ``initial_terms`` are the initial values: (coefficient, differential state, row for
    each parameter). ``unseparated_initial`` adds what does not separate, or gives all of them where
    the system does not separate, at p (d, ...): (n_differential, ...); it is empty where
    ``initial_separates``.

    Functions of one coordinate take points (N,) and return (factors, N); row 0 is one.
    ``parameter_factors`` takes the index of the parameter first. Functions of t, u
    (n_differential, ...) and p (d, ...) are f itself, ``rhs``; its ``jacobian`` df/du
    (n_differential, n_differential, ...), of many states a
    :class:`~rankone.trajectories.system.system.PatternJacobian`; and the ``meanings`` of lifted
    states, (n_lifted, ...).
    ``with_products`` appends the products to u. ``quadratic_jacobian`` takes all states and is
    (n, n, ...): rows of differential states hold f with products as states, the row of a product
    the derivative of ``s_a s_b - w``.

    ``scales`` are those of the parameters, words of
    :data:`~rankone.tensors.coordinates.SCALES`. ``features`` say where the system is not
    smooth, ``jumps`` where its states are reset, ``gaps`` where piecewise functions in its rates
    have no branch. ``specification`` is what it is loaded from, if rankone compiled it. ``events``
    reset its trajectories or end them; a system in stretches between them has the ``clock`` that
    it runs by. ``separated_stretches`` makes a separated system of that kind, of a clock and a
    box, where that is asked for. The last ``n_sides`` of the differential states are the sides of
    switches, set by as many of the last events; ``held`` is the same system with such states,
    where there are any. ``constraints`` vanish on all trajectories. ``atol`` has absolute
    tolerances of states by name; the states of each tuple in ``alike`` share a unit.
    Where trajectories start at steady states, ``rest`` is what has them, and ``at_rest`` finds them
    at p (d, m), without lifted states. ``at_point`` has the rates at parameters (d,), where these
    are faster alone than those of many points. Steps up to ``longest_step`` pass over nothing
    narrow in the rates, where that is known.
    """

    separated: bool
    states: tuple[str, ...]
    n_differential: int
    n_lifted: int
    products: tuple[tuple[int, int], ...]
    parameters: tuple[str, ...]
    horizon: tuple[float, float]
    box: tuple[tuple[float, float], ...]
    scales: tuple[str, ...]
    terms: tuple[tuple[float, int, tuple[int, ...], tuple[int, ...]], ...]
    initial_terms: tuple[tuple[float, int, tuple[int, ...]], ...]
    initial_separates: bool
    unseparated_initial: OfParameters
    time_factors: Callable[[Array], Array]
    parameter_factors: Callable[[int, Array], Array]
    rhs: OfStates
    jacobian: OfStates
    with_products: Callable[[VectorLike], Array]
    quadratic_jacobian: OfStates
    meanings: OfStates
    kernels: Kernels
    features: Features
    jumps: Jumps
    gaps: Gaps
    specification: ModuleSpecification | None = None
    events: tuple[SystemEvent, ...] = ()
    clock: Clock | None = None
    separated_stretches: Callable[[Clock, Box], System] | None = None
    constraints: Constraints = field(default_factory=Constraints)
    atol: tuple[tuple[str, float], ...] = ()
    alike: tuple[tuple[str, ...], ...] = ()
    n_sides: int = 0
    held: System | None = None
    rest: Rest | None = None
    at_rest: OfParameters | None = None
    at_point: Callable[[Array], PointRates] | None = None
    longest_step: float | None = None

    @property
    def limit_of_steps(self) -> float:
        """The longest step that trajectories may take."""
        return math.inf if self.longest_step is None else self.longest_step

    def tolerances(self, sizes: Array) -> Array:
        """Absolute tolerances of the differential states, whose largest values are ``sizes`` (n,).

        One without a tolerance of its own that shares its unit has a part of the largest of them.
        """
        names = self.states[: len(sizes)]
        absolute = dict.fromkeys(names, 0.0)
        for alike in self.alike:
            shared = SHARED_UNIT * max(sizes[names.index(name)] for name in alike)
            absolute.update(dict.fromkeys(alike, float(shared)))
        absolute.update(self.atol)
        return np.array([absolute[name] for name in names])

    @property
    def unknowns(self) -> tuple[str, ...]:
        """The states that the user asked for: differential, and not lifted."""
        return self.states[: self.n_differential - self.n_lifted - self.n_sides]

    @property
    def user_functions(self) -> frozenset[str]:
        """Names of the functions of the user that the system calls."""
        return frozenset(self.specification.namespace if self.specification else ())

    def starting_at(self, initial: OfParameters) -> System:
        """The system with other initial values, as functions of the parameters."""
        return replace(
            self,
            initial_terms=(),
            initial_separates=False,
            unseparated_initial=initial,
            rest=None,
            at_rest=None,
        )

    def with_rates(self, rhs: OfStates, jacobian: OfStates) -> System:
        """The system with other rates; those at one point are not carried over."""
        return replace(self, rhs=rhs, jacobian=jacobian, at_point=None)

    def initial(self, p: Array) -> Array:
        """Initial values at p (d, m): shape (n_differential, m)."""
        start = self._initial(p)
        if self.at_rest is not None:
            states = self.at_rest(p)
            start[: len(states)] = states
        elif self.constraints.guessed:
            start = self.constraints.consistent(self.horizon[0], start, p)
        else:
            return start
        for _ in range(self.n_lifted):  # some stand for functions of others
            start[self.n_differential - self.n_lifted :] = self.meanings(self.horizon[0], start, p)
        return start

    def _initial(self, p: Array) -> Array:
        """The initial values as they were written; those of some states may be guesses."""
        if not self.separated:
            with np.errstate(all="ignore"):
                return self.unseparated_initial(p)
        m = p.shape[1]
        rows = [self.parameter_factors(j, p[j]) for j in range(len(p))]
        start = np.zeros((self.n_differential, m))
        for coefficient, state, factors in self.initial_terms:
            product = np.full(m, coefficient)
            for row, index in zip(rows, factors, strict=True):
                product = product * row[index] if index else product  # row 0 is one
            start[state] += product
        coupled = self.unseparated_initial(p)
        return start + coupled if coupled.size else start


_STEEP = 100.0  # Swings on a stretch, at the fastest rate, from which the flow is steep


@dataclass(frozen=True, eq=False)
class Clock:
    """The system over clock time that runs in stretches, and the order of its events.

    Its jumps, the ``cuts`` of its time and its ``markers`` are events. Where none interrupts,
    trajectories may go ``in_step`` from mark to mark, and ``foreseen_marks`` tell about when those
    at points (m, d) have passed so many of them.
    Where the order is ``forced``, trajectories follow it also where others would come first. Where
    they repeat, from about so many marks on, those that have come back go on as over their last
    period. ``swings`` are how many times a state would go through its size over the horizon at its
    fastest.
    """

    system: System
    order: EventOrder
    horizon: tuple[float, float]
    cuts: tuple[float, ...] = ()
    markers: tuple[Marker, ...] = ()
    in_step: bool = False
    foreseen_marks: OfMarks | None = None
    forced: ForcedOrder | None = None
    repeats_from: int = 0
    swings: float = 0.0

    @property
    def steep(self) -> bool:
        """Whether the flow is so steep somewhere that stacks have to pass its marks together."""
        return self.swings > _STEEP * self.order.stretches

    @property
    def marks_per_period(self) -> int:
        """How many marks an oscillator passes in a period."""
        return sum(CROSSINGS if each.direction == BOTH else 1 for each in self.system.events)

    @property
    def n_guards(self) -> int:
        """Number of guards and clearances behind the states."""
        forced = self.forced
        return 0 if forced is None else len(forced.guards) + len(forced.clearances)

    @property
    def n_states(self) -> int:
        """Number of its differential states but for the sides of switches."""
        return self.system.n_differential - self.system.n_sides

    @property
    def terminal(self) -> bool:
        """Whether the last event ends the trajectories."""
        last = self.order.instants[-1:]
        return any(self.system.events[k].terminal for instant in last for k in instant)

    @property
    def length(self) -> float:
        """Length of the horizon."""
        return self.horizon[1] - self.horizon[0]


_REQUIRED = (
    *("SEPARATED", "STATES", "N_DIFFERENTIAL", "PRODUCTS", "PARAMETERS", "TIME", "BOX"),
    *("time_factors", "parameter_factors", "rhs", "with_products"),
)
_REQUIRED_BY_FORM = {
    True: ("TERMS", "INITIAL", "SIGNATURES", "PAIRED", "KERNELS"),
    False: ("unseparated_initial",),
}
"""Names of every system, and by whether it separates."""


def system_of(names: Mapping[str, object], held: Mapping[str, object] | None = None) -> System:
    """The system that the names of a generated module make: the one way a System is built.

    ``held`` has those of the module with the sides of its switches as states, if there is one.

    Any mapping will do that has the module's names, such as ``vars(module)``. Features, jumps, gaps
    and what else a system may be without become empty members where the module leaves them out.

    Raises
    ------
    OptionError
        If a name is missing that every system has.
    """
    required = [*_REQUIRED, *_REQUIRED_BY_FORM[bool(names.get("SEPARATED"))]]
    required += [] if "jacobian_entries" in names else ["jacobian"]
    if missing := [name for name in required if name not in names]:
        raise OptionError(
            f"the module defines no {listing(missing)}",
            remedy="give the text of generate_source(form)",
        )

    def member(name: str, empty: Member) -> Member:
        return cast(Member, names.get(name, empty))

    box: tuple[tuple[float, float], ...] = member("BOX", ())
    no_cuts: tuple[tuple[()], ...] = ((),) * (1 + len(box))
    jacobian: OfStates = member("jacobian", no_rows)
    if "jacobian_entries" in names:
        places = np.array(names["JACOBIAN_PLACES"], dtype=np.intp).reshape(-1, 2)
        entries: OfStates = member("jacobian_entries", no_rows)
        rows, columns = places.T
        jacobian = PatternJacobian(member("N_DIFFERENTIAL", 0), rows, columns, entries)
    peaks, kinks, steps = member("STATE_SURFACES", (0, 0, 0))
    jumps: tuple[tuple[float, int], ...] = member("JUMPS", ())
    constraints = Constraints(
        names=member("CONSTRAINTS", ()),
        guessed=member("GUESSED", ()),
        residuals=member("constraints", no_rows),
        slopes=member("constraint_slopes", no_rows),
    )
    return System(
        separated=member("SEPARATED", False),
        states=member("STATES", ()),
        n_differential=member("N_DIFFERENTIAL", 0),
        products=member("PRODUCTS", ()),
        parameters=member("PARAMETERS", ()),
        horizon=member("TIME", (0.0, 0.0)),
        box=box,
        scales=member("SCALES", (LINEAR,) * len(box)),
        time_factors=member("time_factors", no_rows),
        parameter_factors=member("parameter_factors", no_rows),
        rhs=member("rhs", no_rows),
        jacobian=jacobian,
        with_products=member("with_products", no_rows),
        quadratic_jacobian=member("quadratic_jacobian", jacobian),
        initial_separates=not {"unseparated_initial", "GUESSED", "SETTLE"} & names.keys(),
        unseparated_initial=member("unseparated_initial", no_rows),
        terms=member("TERMS", ()),
        initial_terms=member("INITIAL", ()),
        n_lifted=member("N_LIFTED", 0),
        meanings=member("meanings", no_rows),
        kernels=Kernels(
            signatures=member("SIGNATURES", ()),
            paired=member("PAIRED", ()),
            **member("KERNELS", {}),
        ),
        features=Features(
            cuts=member("CUTS", no_cuts),
            periodic_cuts=member("PERIODIC_CUTS", no_cuts),
            n_moving_cuts=member("N_MOVING_CUTS", 0),
            n_moving_steps=member("N_MOVING_STEPS", 0),
            moving_cuts=member("moving_cuts", no_rows),
            n_parameter_surfaces=member("N_PARAMETER_SURFACES", 0),
            parameter_surfaces=member("parameter_surfaces", no_rows),
            n_peaks=peaks,
            n_kinks=kinks,
            n_steps=steps,
            state_surfaces=member("state_surfaces", no_rows),
        ),
        jumps=Jumps(
            times=tuple(time for time, _ in jumps),
            kinds=tuple(kind for _, kind in jumps),
            rough_kinds=member("ROUGH_JUMPS", ()),
            jumped=member("jumped", unchanged),
            gaps=Gaps(member("JUMP_GAPS", ()), member("jump_gaps", no_rows)),
        ),
        gaps=Gaps(member("GAPS", ()), member("gaps", no_rows)),
        events=_events(names),
        constraints=constraints,
        atol=member("ATOL", ()),
        alike=member("ALIKE", ()),
        n_sides=member("N_SIDES", 0),
        held=None if held is None else system_of(held),
        rest=_rest(names),
        longest_step=member("LONGEST_STEP", None),
        at_point=cast("Callable[[Array], PointRates] | None", names.get("at_point")),
    )


def _rest(names: Mapping[str, object]) -> Rest | None:
    """The system before the start of a generated module, if there is one."""
    if "SETTLE" not in names:
        return None
    return Rest(
        initial=cast(OfParameters, names["rest_initial"]),
        rhs=cast(OfStates, names["rest_rhs"]),
        jacobian=cast(OfStates, names["rest_jacobian"]),
        after=cast("OfStates | None", names.get("after_rest")),
        settle=cast("tuple[float, float]", names["SETTLE"]),
    )


def _events(names: Mapping[str, object]) -> tuple[SystemEvent, ...]:
    """The events of a generated module."""
    listed = cast("Sequence[tuple[str, int, bool, bool]]", names.get("EVENTS", ()))
    scheduled, delayed, ranked, withdrawn, single = (
        cast("Sequence[int]", names.get(f"{kind}_EVENTS", ()))
        for kind in ("KNOWN", "DELAYED", "RANKED", "WITHDRAWN", "SINGLE")
    )

    first_side = len(listed) - cast(int, names.get("N_SIDES", 0))
    rows = cast("Sequence[tuple[int, tuple[float, ...]]]", names.get("AFFINE_EVENT_TIMES", ()))
    coefficients = dict(rows)

    def row(function: str, i: int) -> OfTrajectory:
        return Row(cast(OfTrajectory, names[function]), i)

    def event(k: int, name: str, direction: int, terminal: bool, resets: bool) -> SystemEvent:
        def at(p: Array) -> Array:
            times = cast(OfParameters, names["known_event_times"])
            return np.broadcast_to(times(p)[scheduled.index(k)], p.shape[1:])

        return SystemEvent(
            row("event_heights", k),
            direction,
            cast("OfStates | None", names[f"after_event_{k}"] if resets else None),
            terminal,
            name,
            at if k in scheduled else None,
            switch=k >= first_side,
            delay=row("event_delays", delayed.index(k)) if k in delayed else None,
            priority=row("event_priorities", ranked.index(k)) if k in ranked else None,
            persistent=k not in withdrawn,
            overlapping=k not in single,
            coefficients=coefficients.get(k),
        )

    return tuple(event(k, *each) for k, each in enumerate(listed))


AHEAD = (0.0, COINCIDENT, NEGLIGIBLE, 1e-6, 1e-4)
"""Relative changes of states and time over which it is looked what rates are ahead."""


def refuse_gap(system: System, time: float, state: Array, point: Array) -> None:
    """Raise a ProblemError if a trajectory, state (n,) at a point (d,), enters a gap.

    ``state`` is where it got to, before what is reset at that time.
    """
    p = np.ascontiguousarray(point[:, None])
    jump_gaps = system.jumps.gaps if time in system.jumps.times else Gaps()
    with np.errstate(all="ignore"):
        if (text := jump_gaps.entered(time, state[:, None], p)) is not None:
            raise _gap_error(system, text, time, state, point)
        if not system.gaps.texts:
            return
        rates = np.nan_to_num(system.rhs(time, state[:, None], p)[:, 0])
        for distance in AHEAD:
            later = state + distance * np.abs(state) * np.sign(rates)
            ahead = time + distance * abs(system.horizon[1] - system.horizon[0])
            if (text := system.gaps.entered(ahead, later[:, None], p)) is not None:
                raise _gap_error(system, text, ahead, later, point)


def _gap_error(system: System, text: str, time: float, state: Array, point: Array) -> ProblemError:
    """The error for a trajectory in a gap."""
    names = *system.states[: system.n_differential], *system.parameters
    pairs = zip(names, (*state, *point), strict=True)
    place = ", ".join(f"{name} = {coordinate:.6g}" for name, coordinate in pairs)
    return ProblemError(f"{text}: entered at t = {time:.6g}, where {place}", remedy=GAP_REMEDY)
