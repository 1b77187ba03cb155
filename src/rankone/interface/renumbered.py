"""A compiled problem with other numbers of its run-time constants: nothing is compiled again."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

import sympy as sp

from rankone.expressions.named_constants import NamedConstant
from rankone.frontend.problem import Problem

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
