"""The generated module: its parts in the order a person reads them, and how it is imported."""

from __future__ import annotations

import hashlib
import linecache
import os
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache, partial
from typing import TypeVar, cast

import sympy as sp
from threadpoolctl import threadpool_limits

from rankone.codegen.definitions import constants, cut_table, definitions, module_source
from rankone.codegen.events import parameter_surfaces
from rankone.codegen.factors import coordinate_functions
from rankone.codegen.gaps import gap_functions, gap_tables
from rankone.codegen.header import header, sum_text
from rankone.codegen.initial import coupled_initial
from rankone.codegen.jumps import jump_function, jump_table, jumped_values
from rankone.codegen.kernels import KERNELS, KernelWriter, helpers
from rankone.codegen.lowering import quadratic_system
from rankone.codegen.meanings import meanings_function
from rankone.codegen.pointwise import PointwiseWriter
from rankone.codegen.printer import factor_text
from rankone.codegen.text import INDENT, described_table, nested, table, tuple_lines
from rankone.codegen.variables import Variables
from rankone.ir.forms import QuadraticSystem, SeparatedForm, Term
from rankone.ir.system import GeneratedNames, System, UserFunction, system_of
from rankone.support.errors import OptionError, check_kind
from rankone.support.wording import number, quote

__all__ = ["ModuleSpecification", "generate_source", "load_module"]

Answer = TypeVar("Answer")


def generate_source(
    form: QuadraticSystem | SeparatedForm,
    title: str | None = None,
    meanings: Sequence[sp.Expr] = (),
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

    Returns
    -------
    str
        A module that fulfils :class:`rankone.ir.system.System` and imports NumPy alone, or SciPy as
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
    pointwise = PointwiseWriter(system)
    functions = pointwise.functions()
    factors = [tuple(factor.expression for factor in distinct) for distinct in system.factors]
    known = [expression for distinct in factors for expression in distinct]
    surface_table, surfaces = _surfaces(system)
    blocks = [
        *definitions([*known, *jumped_values(system.jumps)]),
        *coordinate_functions(system.coordinates, factors),
        *kernel_functions(system),
        *functions,
        coupled_initial(system),
        jump_function(system.differential, system.coordinates, system.jumps),
        *gap_functions([], system.jumps, system.differential, system.coordinates),
        meanings_function(system.differential, system.coordinates, meanings),
        surfaces,
    ]
    head = partial(header, system, pointwise.operations, title)
    cuts = cut_table(system.coordinates, known)
    more = [f"N_LIFTED = {len(meanings)}"] if meanings else []
    more += [*jump_table(system.jumps), *gap_tables([], system.jumps, system.differential)]
    return module_source(head, [*tables(system), *more, *cuts, *surface_table], blocks)


def _surfaces(system: QuadraticSystem) -> tuple[list[str], list[str]]:
    """Where functions of several parameters in jumps are narrow: tables and functions."""
    found = parameter_surfaces(system.coordinates, jumped_values(system.jumps))
    if not found:
        return [], []
    variables = Variables(system.differential, system.coordinates)
    about = f"Zero where functions of p (d, ...) switch or peak: ({len(found)}, ...)."
    shape = "    shape = np.broadcast_shapes(*map(np.shape, p)) or np.shape(p)[1:]"
    written = variables.function("parameter_surfaces(p)", about, shape, found)
    return [f"N_PARAMETER_SURFACES = {len(found)}"], written


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
            f"the source of {quote(name)} is no module that Python can compile: {error}",
            remedy="give the text of generate_source(form)",
        ) from None
    exec(code, names)
    linecache.cache[filename] = (len(source), None, source.splitlines(keepends=True), filename)
    return system_of(cast(GeneratedNames, names))


_MAX_LOADED = 8
"""Modules that a process keeps loaded: enough for the problems one session works on at a time."""


@dataclass(frozen=True)
class ModuleSpecification:
    """What a generated module is loaded from; modules cannot be pickled, their source can.

    Fulfils :class:`rankone.ir.system.ModuleSpecification`.

    Attributes
    ----------
    source, name : str
        As for :func:`load_module`.
    namespace : mapping of str to callable
        Functions of the user, by the names that the source calls them by.
    key : str
        Specifications are equal if their keys are.
    home : int
        The process that made it.
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


@lru_cache(_MAX_LOADED)
def _loaded(specification: ModuleSpecification) -> System:
    return specification.load()


@cache
def _one_blas_thread() -> None:
    """For good: other tasks of this process may run at the same time."""
    threadpool_limits(1, user_api="blas")


def tables(system: QuadraticSystem) -> list[str]:
    """The tables that describe the system."""
    n = len(system.differential)
    return [
        *constants(True, system.names, n, system.products, system.coordinates),
        *rhs_table(system),
        *table("SIGNATURES", nested(group.signature for group in system.groups)),
        *initial_table(system),
    ]


def rhs_table(system: QuadraticSystem) -> list[str]:
    """The terms of f as rows of numbers, each with what it says."""
    rows = [(term.coefficient, term.equation, term.factors, term.monomial) for term in system.rhs]
    return described_table("TERMS", rows, [term_text(t, "{}'", system) for t in system.rhs])


def initial_table(system: QuadraticSystem) -> list[str]:
    """The terms of the initial values as rows of numbers, each with what it says."""
    rows = [(term.coefficient, term.equation, term.factors[1:]) for term in system.initial]
    left = f"{{}}({number(system.coordinates[0].lower)})"
    return described_table("INITIAL", rows, [term_text(t, left, system) for t in system.initial])


def term_text(term: Term, left: str, system: QuadraticSystem) -> str:
    """One term of an equation: ``x': 1.5*x``."""
    return f"{left.format(system.names[term.equation])}: {sum_text([term], system)}"


def kernel_functions(system: QuadraticSystem) -> list[list[str]]:
    """What the kernels share, the kernels of every group, then the tables that list them."""
    time_factors = [factor_text(factor.expression) for factor in system.factors[0]]
    writers = [KernelWriter(system, group, time_factors) for group in system.groups]
    blocks = [helpers(writers)]
    listed: dict[str, list[str]] = {kernel: [] for kernel in KERNELS}
    for writer in writers:
        functions = writer.functions()
        blocks += [writer.tables(), *functions.values()]
        for kernel, entries in listed.items():
            entries.append(f"{kernel}_{writer.group.index}" if kernel in functions else "None")
    listing = ["KERNELS = {"]
    for kernel in KERNELS:
        listing += tuple_lines(f'"{kernel}": ', listed[kernel], ",", INDENT)
    listing.append("}")
    paired = table("PAIRED", nested(group.paired for group in system.groups))
    return [*blocks, [*listing, *paired]]
