"""How another process gets a generated module: modules cannot be pickled, their source can."""

from __future__ import annotations

import os
import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache, lru_cache
from typing import Any

from threadpoolctl import threadpool_limits

from rankone.codegen.module import load_module
from rankone.ir.system import System

__all__ = ["Recipe"]

_KEPT = 8
"""Number of modules that a process keeps loaded."""


@dataclass(frozen=True)
class Recipe:
    """What a generated module is loaded from; fulfils :class:`rankone.ir.system.Recipe`.

    Attributes
    ----------
    source, name : str
        As for :func:`rankone.codegen.load_module`.
    namespace : mapping of str to callable
        Functions of the user, by the names that the source calls them by.
    key : str
        Recipes are equal if their keys are.
    home : int
        The process that made it.
    """

    source: str = field(compare=False)
    name: str = field(compare=False)
    namespace: Mapping[str, Callable[..., Any]] = field(compare=False)
    key: str = field(default_factory=lambda: uuid.uuid4().hex)
    home: int = field(default_factory=os.getpid, compare=False)

    def load(self) -> System:
        """The module, with the recipe as its ``RECIPE``."""
        system = load_module(self.source, self.name, self.namespace)
        vars(system)["RECIPE"] = self
        return system

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """``function(system, *arguments)``; a process loads the module once.

        In a process other than its own the BLAS is set to one thread, as it is in a solve.
        """
        if os.getpid() != self.home:
            _one_blas_thread()
        return function(_loaded(self), *arguments)


@lru_cache(_KEPT)
def _loaded(recipe: Recipe) -> System:
    return recipe.load()


@cache
def _one_blas_thread() -> None:
    """For good: other tasks of this process may run at the same time."""
    threadpool_limits(1, user_api="blas")
