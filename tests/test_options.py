"""Options are declared at the field and checked in one place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest

from rankone.errors import OptionError
from rankone.options import Options, choice, integer, integers, number


@dataclass(frozen=True)
class Some(Options):
    renamed: ClassVar[Mapping[str, str]] = {"amount": "count"}

    count: int = integer(3)
    few: int | None = integer(None, 2, 5)
    part: float = number(0.5, 0.0, 1.0)
    nodes: int | tuple[int, ...] | None = integers(None, 2)
    colour: str = choice("red", ("red", "green"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"count": 0}, "count=0 is not valid; remedy: choose an integer of at least 1"),
        ({"count": None}, "count=None is not valid"),
        ({"count": True}, "count=True"),
        ({"few": 6}, "few=6 is not valid; remedy: choose an integer from 2 to 5"),
        ({"part": 1.5}, "part=1.5 is not valid; remedy: choose a number from 0 to 1"),
        ({"part": float("nan")}, "part=nan"),
        ({"nodes": (2, 1)}, "nodes=1"),
        ({"colour": "blue"}, "colour='blue' is unknown; remedy: choose one of red, green"),
        ({"colour": ["red"]}, "colour="),
        ({"amount": 2}, "option 'amount' is now called 'count'"),
        (
            {"cuont": 2},
            r"unknown option 'cuont' \(did you mean `count`\?\); remedy: choose from co",
        ),
        ({"zzz": 2}, "unknown option 'zzz'; remedy"),
    ],
)
def test_what_is_not_declared_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        Some.of(**changes)


def test_the_caller_says_its_own_keywords() -> None:
    with pytest.raises(
        OptionError, match=r"did you mean `tol`\?\); .*; solve itself takes tol, at"
    ):
        Some.of(("tol", "at"), tl=2)
    with pytest.raises(OptionError, match=r"choose from colour, count, few, nodes, part$"):
        Some.of(tl=2)
    assert Some.of().max_attempts == 1


def test_numbers_become_plain() -> None:
    some = Some.of(count=np.int64(7), part=np.float32(0.25), nodes=[3, np.int32(4)])
    assert some == Some(7, None, 0.25, (3, 4), "red")
    assert [type(value) for value in (some.count, some.part)] == [int, float]
    assert Some.of(few=None, nodes=5).nodes == 5
