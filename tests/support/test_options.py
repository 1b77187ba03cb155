"""Options are declared at the field and checked in one place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.support.errors import OptionError
from rankone.support.options import Options, choice, integer, integers, number


@dataclass(frozen=True)
class Some(Options):
    count: int = integer(3)
    few: int | None = integer(None, 2, 5)
    part: float = number(0.5, 0.0, 1.0)
    nodes: int | tuple[int, ...] | None = integers(None, 2)
    colour: str = choice("red", ("red", "green"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"count": 0}, "count=0 is not valid; remedy: choose an integer from 1 to 1e.09"),
        ({"count": None}, "count=None is not valid"),
        ({"count": True}, "count=True"),
        ({"few": 6}, "few=6 is not valid; remedy: choose an integer from 2 to 5"),
        ({"part": 1.5}, "part=1.5 is not valid; remedy: choose a number from 0 to 1"),
        ({"part": float("nan")}, "part=nan"),
        ({"nodes": (2, 1)}, "nodes=1"),
        ({"colour": "blue"}, "colour='blue' is unknown; remedy: choose one of red, green"),
        ({"colour": ["red"]}, "colour="),
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


@pytest.mark.parametrize("large", [10**400, 10**5000], ids=["400", "5000"])
def test_huge_numbers_are_refused(large: int) -> None:
    t, k = sp.symbols("t k")
    x = sp.Function("x")(t)
    equations = [sp.Eq(x.diff(t), -k * x)]
    compiled = ro.compile(ro.Problem(equations, (t, 0, 1), {k: (1, 2)}, {x: 1}))
    wrong: list[dict[str, Any]] = [
        {"max_seconds": large},
        {"t_final": large},
        {"parameters": {"k": (0, large)}},
        {"check": large},
        {"check": 10**20},
        {"rtol": large},
    ]
    for given in wrong:
        with pytest.raises(ro.OptionError):
            compiled.solve(**given)
    with pytest.raises(ro.OptionError, match="an integer from 0 to 100000"):
        compiled.solve(check=100001)
    with pytest.raises(ro.ProblemError, match="not a real number"):
        ro.Problem(equations, (t, 0, 1), {k: (0, large)}, {x: 1})


def test_the_name_of_a_problem_is_text() -> None:
    t = sp.Symbol("t")
    x = sp.Function("x")(t)
    name: Any = [5]
    with pytest.raises(ro.ProblemError, match=r"the name is \[5\], not text"):
        ro.Problem([sp.Eq(x.diff(t), -x)], (t, 0, 1), {}, {x: 1}, name=name)
