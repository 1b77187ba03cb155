"""Which parameters are amounts of doses whose effects add up."""

from __future__ import annotations

import pytest

import rankone as ro
from rankone.symbolic import first_order
from rankone.symbolic.superposition import additive_parameters

ORAL = {"A": "-ka*A", "C": "ka*A/V - CL/V*C"}
BOX = dict.fromkeys(("ka", "CL", "V", "T", "dose"), (1, 2))
START = {"A": "dose", "C": "0"}
LATER = {"A": "0", "C": "0"}


def additive(rhs=ORAL, initial=START, **options):
    problem = ro.Problem.from_strings(rhs, initial, BOX, (0, 24), **options)
    return additive_parameters(first_order(problem))


def test_a_dose_at_the_start():
    assert additive() == ("dose",)
    assert additive(initial={"A": "0.8*dose/V", "C": "0"}) == ("dose",)


def test_a_dose_after_a_lag():
    assert additive(initial=LATER, jumps={"T": {"A": "A + dose"}}) == ("dose",)
    assert additive(initial=LATER, jumps={2: {"A": "A + dose"}}) == ("dose",)


def test_an_infusion():
    given = {"A": "dose/T*Heaviside(T - t) - ka*A", "C": "ka*A/V - CL/V*C"}
    assert additive(given, LATER) == ("dose",)


OTHERS = {
    "saturated": {"rhs": {**ORAL, "C": "ka*A/V - CL*C/(V + C)"}},
    "changing in time": {"rhs": {**ORAL, "A": "-ka*exp(-t)*A"}},
    "changed by the dose": {"rhs": {**ORAL, "A": "-ka*dose*A"}},
    "with an input": {"rhs": {**ORAL, "A": "1 - ka*A"}},
    "with a baseline": {"initial": {"A": "dose", "C": "1"}},
    "with a second dose": {"initial": {"A": "dose", "C": "T"}},
    "not proportional": {"initial": {"A": "dose**2", "C": "0"}},
    "with a loss": {"jumps": {3: {"A": "A/2"}}},
    "with a reset": {"jumps": {3: {"A": "dose"}}},
    "after a lag that the dose changes": {
        "initial": LATER,
        "jumps": {"T*dose": {"A": "A + dose"}},
    },
    "set off by a state": {
        "events": [{"when": "C - 1", "then": {"A": "A + dose"}}],
    },
    "ended": {"events": [{"when": "C - 1", "terminal": True}]},
}


@pytest.mark.parametrize("options", OTHERS.values(), ids=OTHERS)
def test_what_does_not_add_up(options):
    assert additive(**options) == ()
