"""A fixed part of the honesty suite: systems that a low effort solves, and rightly, or refuses."""

import numpy as np
import pytest

from tests.honesty.cases import KINDS
from tests.honesty.cases import case as make
from tests.honesty.verdicts import judged

POINTS = 100
"""Fewer than of the suite, ``python -m tests.honesty``, which has as many cases as one asks for."""
QUICK = {
    ("pulses", 0),
    ("features", 0),
    ("systems", 1),
    ("products", 1),
    ("steep", 0),
    ("general", 3),
    ("passages", 2),
    ("surfaces", 3),
    ("peaks", 0),
    ("doses", 3),
    ("events", 2),
    ("switches", 0),
}
"""What is tried in every run: one case of a kind, of those that take less than a second."""
FURTHER = {
    ("data", 2),
    ("levels", 3),
    ("moving", 4),
    ("orders", 1),
}
"""Further kinds, for the slow tests; other seeds of a kind may be refused with a low effort."""
REFUSED = {("surfaces", 3)}
"""What may be refused, and must not be solved wrongly."""
ONE = {("systems", 1): 0, ("products", 1): 1, ("general", 3): 1, ("doses", 3): 0}
"""Cases of which one unknown alone is asked for, by position."""


@pytest.mark.parametrize(("kind", "seed"), list(ONE))
def test_the_statement_holds_for_one_unknown(kind, seed):
    made = make(kind, seed)
    asked = ONE[kind, seed] % len(made.unknowns)
    assert judged(made, longest=np.inf, asked=asked, effort="low").verdict == "ok"


def test_every_kind_is_tried():
    assert {kind for kind, _ in QUICK | FURTHER} == {*KINDS}


@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        pytest.param(*case, marks=[pytest.mark.slow] * (case in FURTHER))
        for case in sorted(QUICK | FURTHER)
    ],
)
def test_the_statement_holds(kind, seed):
    verdict = judged(make(kind, seed), longest=np.inf, points=POINTS, effort="low")
    allowed = {"ok", "refused"} if (kind, seed) in REFUSED else {"ok"}
    assert verdict.verdict in allowed, verdict
