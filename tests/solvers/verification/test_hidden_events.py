"""No event that takes place between the steps of trajectories is missing from a success."""

import pytest

import rankone as ro
from rankone.solvers.verification import reference_set as reference_sets
from rankone.trajectories.system.verdict import HiddenEvent, Status

DIP = "1 - 2*exp(-1e12*(x + 1/x - 2))"
"""Below zero within 1e-6 of x = 1, which is at t = 0.8/k."""
PEAK = "2*exp(-1e12*((t + 1)/(1 + 0.8/k) + (1 + 0.8/k)/(t + 1) - 2)) - 1"
"""Above zero at about that time."""
DOSE = {"when": "y - 0.6", "direction": "rising", "then": {"y": "y + 0.1"}, "name": "dose"}
WASH = {"when": "x - 0.8", "direction": "rising", "then": {"y": "y/2"}, "name": "wash"}


def event(when, direction="falling", **more):
    return {"when": when, "direction": direction, "then": {"x": 0}, "name": "hit", **more}


def solved(*events):
    rates, start = {"x": "k", "y": "1"}, {"x": 0.2, "y": 0}
    problem = ro.Problem.from_strings(rates, start, {"k": (0.8, 1.2)}, (0, 2), events=[*events])
    return ro.solve(problem, 1e-4)


@pytest.mark.parametrize(
    "events",
    [
        [event(DIP)],
        [event(DIP, "rising")],
        [event(DIP, "both", then=None, terminal=True)],
        [event(PEAK, "rising")],
        [DOSE, event(DIP)],
        [DOSE, WASH, event(DIP)],
    ],
    ids=["falling", "rising", "terminal", "in time", "after another", "on a branch"],
)
def test_hidden_events_are_no_success(events):
    solution = solved(*events)
    assert solution.status is Status.NARROW
    cause = solution.outcome.cause
    assert isinstance(cause, HiddenEvent)
    assert cause.event == "hit"
    assert cause.time == pytest.approx(0.8 / dict(cause.at)["k"], abs=1e-5)
    assert "the condition of `hit` crosses zero so briefly near t = " in solution.message
    assert "a condition with the same zeros that varies more slowly" in solution.message


@pytest.mark.parametrize(
    ("when", "direction"),
    [
        ("tanh(1e6*(x - 1))", "rising"),
        ("Heaviside(x - 1) - 1/2", "rising"),
        ("Piecewise((x - 1, x < 1), (1e6*(x - 1), True))", "rising"),
        ("Max(x - 1, x - 2)", "rising"),
        ("exp(30*(x - 1)) - 1", "rising"),
        ("sin(3*x)", "falling"),
        ("exp(-1e3*x) + 1e-3", "falling"),
    ],
)
def test_events_that_steps_meet_are_no_doubt(when, direction, monkeypatch):
    looked = []

    def look(*given):
        looked.append(hidden_event(*given))
        return looked[-1]

    hidden_event = reference_sets.hidden_event
    monkeypatch.setattr(reference_sets, "hidden_event", look)
    assert solved(event(when, direction)).success
    assert looked == [None]


def test_crossings_beside_one_another_are_all_met():
    """Marks alone, several of them on a step."""
    mark = {"when": "sin(60*x) - 0.9", "direction": "rising", "name": "mark"}
    assert solved(mark).success
