"""A fixed part of the honesty suite: nothing wrong and marked successful, nothing unexpected."""

import numpy as np
import pytest

from tests.honesty.cases import KINDS
from tests.honesty.cases import case as make
from tests.honesty.verdicts import judged

COUNTS = {
    "pulses": 6,
    "features": 6,
    "systems": 3,
    "products": 3,
    "steep": 2,
    "general": 4,
    "passages": 3,
    "surfaces": 4,
    "peaks": 3,
    "moving": 1,
    "data": 2,
    "doses": 4,
    "events": 4,
    "switches": 3,
    "levels": 2,
    "orders": 2,
}
"""Cases of each kind."""
SOLVED = ("pulses", "features")
"""Kinds that have to be solved, not only to be refused where they are not."""
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
CASES = [(kind, seed) for kind, count in COUNTS.items() for seed in range(count)]


ONE = {("systems", 1): 0, ("products", 1): 1, ("general", 3): 1, ("doses", 3): 0}
"""Cases of which one unknown alone is asked for, by position."""


@pytest.mark.parametrize(("kind", "seed"), list(ONE))
def test_the_statement_holds_for_one_unknown(kind, seed):
    made = make(kind, seed)
    asked = ONE[kind, seed] % len(made.unknowns)
    assert judged(made, longest=np.inf, asked=asked, effort="low").verdict == "ok"


def test_every_kind_is_tried():
    assert COUNTS.keys() == KINDS.keys()


@pytest.mark.parametrize(
    ("kind", "seed"),
    [pytest.param(*case, marks=() if case in QUICK else pytest.mark.slow) for case in CASES],
)
def test_the_statement_holds(kind, seed):
    verdict = judged(make(kind, seed), longest=np.inf, effort="low")
    allowed = ("ok",) if kind in SOLVED else ("ok", "refused", "unknown")
    assert verdict.verdict in allowed, verdict
