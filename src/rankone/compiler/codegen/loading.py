"""How generated source becomes a system, in this process and in others."""

from __future__ import annotations

import hashlib
import linecache
import os
import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from typing import TypeVar

from threadpoolctl import threadpool_limits

from rankone.support.errors import OptionError, check_kind
from rankone.support.tasks import KEPT
from rankone.support.wording import quote
from rankone.trajectories.steady.bifurcations import started
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
