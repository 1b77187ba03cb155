"""Which parameters are amounts of doses whose effects add up."""

from __future__ import annotations

import cProfile

import pytest

import rankone as ro
from rankone.compiler.passes import first_order
from rankone.compiler.passes.first_order import additive_parameters

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


@pytest.mark.parametrize(
    "infusion",
    [
        "dose/T*Heaviside(T - t)",
        "Piecewise((dose/T, t < T), (0, True))",
        "(dose + A)*(2 - CL) - 2*A + CL*A",
    ],
)
def test_an_infusion(infusion):
    given = {"A": f"{infusion} - ka*A", "C": "ka*A/V - CL/V*C"}
    assert additive(given, LATER) == ("dose",)


OTHERS = {
    "saturated": {"rhs": {**ORAL, "C": "ka*A/V - CL*C/(V + C)"}},
    "changing in time": {"rhs": {**ORAL, "A": "-ka*exp(-t)*A"}},
    "changed by the dose": {"rhs": {**ORAL, "A": "-ka*dose*A"}},
    "with an input": {"rhs": {**ORAL, "A": "1 - ka*A"}},
    "with a baseline": {"initial": {"A": "dose", "C": "1"}},
    "with a second dose": {"initial": {"A": "dose", "C": "T"}},
    "not proportional": {"initial": {"A": "dose**2", "C": "0"}},
    "changing with a switch": {
        "rhs": {**ORAL, "A": "Piecewise((-ka*A, t < T), (0, True))"},
    },
    "growing by the dose": {"jumps": {3: {"A": "A + dose*A"}}},
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


def calls_for_a_dense_system(n):
    names = [f"x{i}" for i in range(n)]
    rates = (" + ".join(f"{i + j + 1}.5*ka*{y}" for j, y in enumerate(names)) for i in range(n))
    start = dict.fromkeys(names, "0") | {"x0": "dose"}
    problem = ro.Problem.from_strings(dict(zip(names, rates, strict=True)), start, BOX, (0, 24))
    system = first_order(problem)
    profile = cProfile.Profile()
    with profile:
        assert additive_parameters(system) == ("dose",)
    return sum(each.callcount for each in profile.getstats())


def test_dense_systems_are_read_in_proportion_to_their_size():
    assert calls_for_a_dense_system(12) < 5.5 * calls_for_a_dense_system(6)
