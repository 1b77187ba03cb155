"""How generated source becomes a system, and the functions of arrays made of outputs."""

from __future__ import annotations

import hashlib
import linecache
import os
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cache, cached_property, lru_cache
from typing import TypeVar, cast

import numpy as np
from scipy import special
from threadpoolctl import threadpool_limits

from rankone.support.arrays import Array
from rankone.support.errors import OptionError, check_kind, quote
from rankone.support.tasks import KEPT
from rankone.trajectories.bifurcations import started
from rankone.trajectories.system.system import System, UserFunction, system_of

Answer = TypeVar("Answer")


def load_module(
    source: str, name: str, namespace: Mapping[str, UserFunction] | None = None
) -> System:
    """The system that generated source defines, without a file or an entry in ``sys.modules``.

    Tracebacks show the generated lines.

    Parameters
    ----------
    source : str
        Text written by :func:`generate_source`.
    name : str
        Name of the module.
    namespace : mapping of str to callable, optional
        Functions of the user that the source calls by these names.

    Raises
    ------
    OptionError
        If the source or the name is not a text.
    """
    check_kind("load_module", source, str, remedy="give the text of generate_source(form)")
    check_kind("load_module", name, str, remedy="give the name of the module as text")
    digest = hashlib.sha256(source.encode(errors="replace")).hexdigest()[:8]
    filename = f"<rankone {name} {digest}>"
    names = {"__name__": name, "__file__": filename, **(namespace or {})}
    try:
        code = compile(source, filename, "exec")
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise OptionError(
            f"the source of {quote(name)} is not a module that Python can compile: {error}",
            remedy="give the text of generate_source(form)",
        ) from None
    exec(code, names)
    linecache.cache[filename] = (len(source), None, source.splitlines(keepends=True), filename)
    return started(system_of(names))


@dataclass(frozen=True)
class ModuleSpecification:
    """What a generated module is loaded from; modules cannot be pickled, their source can.

    Fulfils :class:`rankone.trajectories.system.system.ModuleSpecification`, with the arguments of
    :func:`load_module`. Specifications are equal if their keys are; ``home`` is the process that
    made it.
    """

    source: str = field(compare=False)
    name: str = field(compare=False)
    namespace: Mapping[str, UserFunction] = field(compare=False)
    key: str = field(default_factory=lambda: uuid.uuid4().hex)
    home: int = field(default_factory=os.getpid, compare=False)

    def load(self) -> System:
        """The system, with this specification as its own."""
        return replace(load_module(self.source, self.name, self.namespace), specification=self)

    def call(self, function: Callable[..., Answer], *arguments: object) -> Answer:
        """``function(system, *arguments)``; a process loads the module once.

        In a process other than its own the BLAS is set to one thread, as it is in a solve.
        """
        if os.getpid() != self.home:
            _one_blas_thread()
        return function(_loaded(self), *arguments)


@lru_cache(KEPT)
def _loaded(specification: ModuleSpecification) -> System:
    return specification.load()


@cache
def _one_blas_thread() -> None:
    """For good: other tasks of this process may run at the same time."""
    threadpool_limits(1, user_api="blas")


# -----------------------------------------------------------------------------
# Quantities of interest as functions of arrays, without symbols.


@dataclass(frozen=True)
class WrittenFunction:
    """A function of arrays as text: the expressions, and the names of its arguments.

    ``called`` are functions of the user and tables by the names that the text calls them by. The
    text is compiled when it is first called, also in another process.
    """

    arguments: str
    texts: tuple[str, ...]
    called: Mapping[str, Callable[..., Array]] = field(default_factory=dict)

    @cached_property
    def function(self) -> Callable[..., Sequence[Array]]:
        """The function that the text says."""
        namespace = {"np": np, "special": special, **self.called}
        text = f"lambda {self.arguments}: [{', '.join(self.texts)}]"
        return cast(Callable[..., Sequence[Array]], eval(text, namespace))

    def __call__(self, *arguments: object) -> Sequence[Array]:
        return self.function(*arguments)

    def __getstate__(self) -> dict[str, object]:
        return {name: held for name, held in vars(self).items() if name != "function"}


class Kind(Enum):
    """How a function of time is reduced."""

    INTEGRAL = "integral"
    RUNNING = "running integral"
    MAXIMUM = "maximum"
    MINIMUM = "minimum"
    CROSSING = "first crossing"
    DURATION = "duration"
    INSTANT = "value at an instant"


@dataclass(frozen=True)
class Border:
    """The end of a stretch of a timeline, by its place from 1, or behind it the next beginning."""

    place: int
    after: bool = False


@dataclass(frozen=True)
class Reduction:
    """A reduction of the integrand at a position, a function of time.

    It has the limits of an integral or else of the horizon; a running integral has no end. The
    value at an instant, which is its start, is asked for over stretches alone.
    """

    kind: Kind
    integrand: int
    start: float | Border
    end: float | Border
    direction: int  # of a crossing of zero: 1 upwards, -1 downwards, 0 either
    text: str  # in messages


@dataclass(frozen=True)
class Source:
    """A state of the solution, or its time derivative of some order.

    Or, of solutions with events, the derivative by the parameter at a position, at fixed time.
    """

    row: int
    order: int = 0
    parameter: int | None = None

    @property
    def is_state(self) -> bool:
        return self.order == 0 and self.parameter is None


@dataclass(frozen=True)
class Quantities:
    """Functions of states, time and parameters, with their definitions as texts.

    They take times (T, 1), the sources (k, T, m) and parameters (d, m), those of surfaces of
    parameters the last alone, and ``values`` also the reductions, (m,) or (T, m). They give
    sequences of arrays that broadcast to (T, m). Surfaces are zero where a narrow feature is
    largest or steepest, or kinks; the ``state_surfaces`` behind the first ``n_state_surfaces`` are
    zero where something jumps. Those of parameters are functions of several of them.
    """

    names: tuple[str, ...]
    texts: tuple[str, ...]
    timeless: bool
    sources: tuple[Source, ...]
    integrands: Callable[[Array, Array, Array], Sequence[Array]]
    reductions: tuple[Reduction, ...]
    n_state_surfaces: int
    state_surfaces: Callable[[Array, Array, Array], Sequence[Array]]
    parameter_surfaces: Callable[[Array], Sequence[Array]]
    # for time and each parameter the places where functions of it alone are narrow, kink or jump
    cuts: tuple[tuple[float, ...], ...]
    values: Callable[[Array, Array, Array, Sequence[Array]], Sequence[Array]]
    # one where a piecewise function of the states has no branch, and zero elsewhere
    gaps: Callable[[Array, Array, Array], Sequence[Array]]
    gap_texts: tuple[str, ...]
    # pairs of a state and a number, which are summed: rows of sources behind those of the states
    sums: tuple[tuple[tuple[int, float], ...], ...] = ()
