"""A fixed part of the honesty suite: nothing wrong and marked successful, nothing unexpected."""

import numpy as np
import pytest

from tests.honesty.cases import KINDS
from tests.honesty.cases import case as make
from tests.honesty.verdicts import judged

COUNT = 1
"""Cases of each kind; the suite, ``python -m tests.honesty``, has as many as are asked for."""
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
CASES = sorted(QUICK | {(kind, seed) for kind in KINDS for seed in range(COUNT)})


ONE = {("systems", 1): 0, ("products", 1): 1, ("general", 3): 1, ("doses", 3): 0}
"""Cases of which one unknown alone is asked for, by position."""


@pytest.mark.parametrize(("kind", "seed"), list(ONE))
def test_the_statement_holds_for_one_unknown(kind, seed):
    made = make(kind, seed)
    asked = ONE[kind, seed] % len(made.unknowns)
    assert judged(made, longest=np.inf, asked=asked, effort="low").verdict == "ok"


@pytest.mark.parametrize(
    ("kind", "seed"),
    [pytest.param(*case, marks=() if case in QUICK else pytest.mark.slow) for case in CASES],
)
def test_the_statement_holds(kind, seed):
    verdict = judged(make(kind, seed), longest=np.inf, effort="low")
    allowed = ("ok",) if kind in SOLVED else ("ok", "refused", "unknown")
    assert verdict.verdict in allowed, verdict
