"""Methods of a solution that belong to applications, which are imported when they are called."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any


class Application:
    """A method that another room defines as a function of the solution.

    Parameters
    ----------
    module : str
        The module of the function, below ``rankone``.
    name : str
        The name of the function; its first argument is the solution.
    """

    def __init__(self, module: str, name: str) -> None:
        self.module = module
        self.name = name

    def __get__(self, instance: object | None, owner: type) -> Callable[..., Any]:
        """The function where it is read from the class, the method of an instance otherwise."""
        function = getattr(importlib.import_module(f"rankone.{self.module}"), self.name)
        bound: Callable[..., Any] = function.__get__(instance, owner)
        return bound
