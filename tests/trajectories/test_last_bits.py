"""What trajectories meet does not depend on the last bits of times, states and constants."""

import dataclasses

import numpy as np
import pytest

import rankone as ro
from rankone.trajectories.events import event_crossings as crossings
from rankone.trajectories.events import forced
from rankone.trajectories.system.features import SystemEvent
from tests.trajectories.test_events import INTEGRATORS, system_of, trajectories

ULPS = 4.0 * np.finfo(float).eps
SEEDS = [None, 1, 2, 3]  # None changes nothing


def level(at, direction, then=None, **further):
    return SystemEvent(lambda t, u, p: u[0] - at, direction, then, **further)


def add(*changes):
    return lambda t, u, p: u + np.array(changes)[:, None]


def put(*values):
    return lambda t, u, p: np.array(values)[:, None] + 0.0 * u


def line(rate, start=0.0, end=1.0):
    """x moves evenly; a second state moves alike from zero."""
    rates = {"x": f"{rate}*k", "y": "k"}
    return system_of(rates, {"x": repr(float(start)), "y": "0"}, {"k": (1, 2)}, end)


def shaken(random, event):
    """The event, whose resets are rounded in another way."""
    if event.then is None:
        return event

    def then(t, u, p):
        after = np.asarray(event.then(t, u, p))
        return after * (1.0 + ULPS * random.uniform(-1.0, 1.0, after.shape))

    return dataclasses.replace(event, then=then)


def met(monkeypatch, seed, system, point, events, integrator):
    """The events of a trajectory in their order, and where it ends."""
    if seed is not None:
        random = np.random.default_rng(seed)
        root = crossings.roots_or_jumps

        def shaken_root(*arguments):
            roots = root(*arguments)
            return roots + ULPS * random.uniform(-1.0, 1.0, roots.shape)

        monkeypatch.setattr(crossings, "roots_or_jumps", shaken_root)
        events = [shaken(random, event) for event in events]
    (each,) = trajectories(system, [point], events, integrator)
    return [o.event for o in each.occurrences], each


# A system, its events, and those that a trajectory meets
CASES = {
    "lands on a surface from below and goes on": (
        line(1.0),
        [level(0.25, 1, add(0.5, 0.0)), level(0.75, 1, put(0.8, 0.0))],
        [0, 1],
    ),
    "lands on a surface from below and goes back": (
        line(-1.0, 1.0, 1.75),
        [level(0.5, -1, add(0.7, 0.0)), level(1.2, 0, put(9.0, 0.0))],
        [0, 0],
    ),
    "lands on a surface from above and goes on": (
        line(-1.0, 1.0, 0.75),
        [level(0.9, -1, add(-0.6, 0.0)), level(0.3, -1, add(-0.3, 0.0)), level(0.3, 1)],
        [0, 1],
    ),
    "lands on the surface of a mark, whose rising crossing it is": (
        line(1.0),
        [level(0.25, 1, add(0.5, 0.0)), level(0.75, 1), level(0.75, -1), level(0.75, 0)],
        [0, 1, 3],
    ),
    "starts on a surface and rises": (line(1.0, 0.1 + 0.2), [level(0.3, 0, put(0.0, 0.0))], []),
    "starts just below a surface": (
        line(1.0, 0.3 * (1.0 - 2.0 * ULPS)),
        [level(0.3, 1, put(0.0, 0.0))],
        [],
    ),
    "is reset to its surface": (line(1.0), [level(0.3, 1, put(0.1 + 0.2, 0.0))], [0]),
    "is turned back by another at the same instant": (
        line(1.0),
        [
            level(0.5, 1, add(-0.2, 0.0), priority=lambda t, u, p: 1.0 + 0.0 * t),
            level(0.5, 1, add(5.0, 0.0), persistent=False),
        ],
        [0, 0, 0],
    ),
    "is left where it is by another at the same instant": (
        line(1.0),
        [
            level(0.5, 1, add(0.0, -9.0), priority=lambda t, u, p: 1.0 + 0.0 * t),
            level(0.5, 1, add(5.0, 0.0), persistent=False),
        ],
        [0, 1],
    ),
    "reaches a surface at the known time of another event": (
        line(1.0),
        [
            SystemEvent(lambda t, u, p: t - 0.5, 1, add(0.0, -9.0), at=lambda p: 0.5 + 0.0 * p[0]),
            level(0.5, 1, put(0.8, 0.0)),
        ],
        [0, 1],
    ),
    "lands on a surface with one event, and rises from there": (
        line(1.0),
        [level(0.25, 1, put(0.75, 0.0)), level(0.75, 1, add(0.0, -9.0))],
        [0, 1],
    ),
    "bounces twice on a floor far from zero": (
        system_of({"y": "v", "v": "-2 + 0*y"}, {"y": "h + 30", "v": "0"}, {"h": (0.5, 2)}, 2.4),
        [SystemEvent(lambda t, u, p: u[0] - 30, -1, lambda t, u, p: np.stack([u[0], -0.5 * u[1]]))],
        [0, 0],
    ),
}


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("case", CASES)
def test_events_in_their_order(monkeypatch, case, seed, integrator):
    system, events, expected = CASES[case]
    found, each = met(monkeypatch, seed, system, [1.0], events, integrator)
    assert found == expected
    assert not each.stuck


def near(number, ulps):
    return repr(float(number * (1.0 + ulps * np.finfo(float).eps)))


def swapping(rates, initial, box, end, *events):
    """Events next to a dose of y, whose time ``a`` changes the order."""
    dose = {"when": "t - a", "then": {"y": "y + 1"}, "name": "dose"}
    return ro.Problem.from_strings(
        {**rates, "y": "-y"}, {**initial, "y": 1}, {"k": (0.8, 1.2), **box}, (0, end),
        events=[*events, dose],
    )  # fmt: skip


def lifted(ulps):
    """Each lift lands on the surface of another event and crosses it."""
    lift = {"when": "x - 0.25", "then": {"x": f"x + {near(0.5, ulps)}"}, "name": "lift"}
    empty = {"when": "x - 0.75", "then": {"x": 0}, "name": "empty"}
    lift["direction"] = "rising"
    return swapping({"x": "k"}, {"x": 0}, {"a": (0.1, 0.4)}, 0.48, lift, empty)


def put_on_a_mark(ulps):
    """A dose puts x on the surface of a mark, which it crosses from there or before."""
    mark = {"when": "x - 0.3", "direction": "rising", "then": {"z": "z + 2"}, "name": "mark"}
    put = {"when": "t - b", "then": {"x": near(0.3, ulps)}, "name": "put"}
    rates, initial = {"x": "k", "z": "-z"}, {"x": 0, "z": 1}
    return swapping(rates, initial, {"a": (0.5, 0.6), "b": (0.2, 0.35)}, 0.8, mark, put)


def bouncing(ulps):
    """A floor far from zero."""
    bounce = {"when": "x - 30", "direction": "falling", "then": {"v": "-v/2"}, "name": "bounce"}
    initial = {"x": f"k + {near(30, ulps)}", "v": 0}
    return swapping({"x": "v", "v": "-2"}, initial, {"a": (0.8, 1.2)}, 2.0, bounce)


def turned_back(ulps):
    """Two events at one instant, the second of which the first one turns back."""
    turn = {"when": "x - 0.5", "direction": "rising", "name": "turn"}
    turn |= {"then": {"x": f"x - {near(0.2, ulps)}"}, "priority": 1}
    never = {"when": "x - 0.5", "direction": "rising", "then": {"x": 5}, "name": "never"}
    never["persistent"] = False
    return swapping({"x": "k"}, {"x": 0}, {"a": (0.4, 0.65)}, 0.7, turn, never)


def orders_of(monkeypatch, problem, seed):
    """The orders of the branches of a solution, where roots along forced orders are shaken."""
    with monkeypatch.context() as patch:
        if seed is not None:
            random, nearest = np.random.default_rng(seed), forced.nearest_roots

            def shaken_roots(flow, *arguments):
                roots = nearest(flow, *arguments)
                sizes = np.abs(flow.starts) + np.abs(roots)
                return roots + ULPS * sizes * random.uniform(-1.0, 1.0, roots.shape)

            patch.setattr(forced, "nearest_roots", shaken_roots)
        solution = ro.solve(problem, 1e-3)
    assert solution.success, solution.message
    branches = solution.timeline.branches
    assert len(branches) > 1
    return {str(branch) for branch in branches}


@pytest.mark.slow
@pytest.mark.parametrize("problem_of", [lifted, put_on_a_mark, bouncing, turned_back])
def test_orders_that_are_forced(monkeypatch, problem_of):
    """Roots that are rounded in another way, and constants, leave the orders as they are."""
    shaken = [orders_of(monkeypatch, problem_of(u), seed) for u, seed in [(0, None), (2, 2)]]
    assert shaken[1:] == shaken[:-1]


@pytest.mark.parametrize("direction", [1.0, -1.0])
@pytest.mark.parametrize("method", ["solve", "trajectory"])
def test_resets_to_a_surface_over_a_box(method, direction):
    """All trajectories land on 3/4 from below: those that rise go on to zero from there."""
    falls = direction < 0.0
    events = [
        {
            "when": "x - 0.25" if not falls else "x - 0.45",
            "direction": "falling" if falls else "rising",
            "then": {"x": "x + 0.3" if falls else "x + 0.5"},
            "name": "lift",
        },
        {"when": "x - 0.75", "then": {"x": 0}, "name": "empty"},
    ]
    problem = ro.Problem.from_strings(
        {"x": f"{direction}*k + b*x"},
        {"x": "0.7" if falls else "0"},
        {"k": (0.8, 1.2), "b": (0.01, 0.02)},
        (0, 0.4),
        events=events,
    )
    points = [{"k": k, "b": b} for k, b in [(0.8, 0.01), (0.97, 0.013), (1.2, 0.02)]]
    solution = ro.solve(problem, 1e-3) if method == "solve" else problem
    for point in points:
        if method == "solve":
            count = {name: solution.event_times(name, point).size for name in ("lift", "empty")}
        else:
            events = problem.trajectory(np.array([0.4]), point).events
            count = {name: events[name].size for name in ("lift", "empty")}
        assert count == {"lift": 1, "empty": 0 if falls else 1}


@pytest.mark.parametrize("horizon", [(0.3, 1.0), (0.0, 0.3)])
@pytest.mark.parametrize("ulps", [-2, -1, 0, 1, 2])
def test_known_times_at_an_end_of_the_horizon(horizon, ulps):
    """That of the dose is 0.2 + 0.1, next to the number 0.3."""
    dose = {"when": "t - lag - 0.1", "then": {"x": "x + 1"}, "name": "dose"}
    problem = ro.Problem.from_strings(
        {"x": "-x"}, {"x": 1}, {"lag": (0.1, 0.5)}, horizon, events=[dose]
    )
    lag = 0.2 + ulps * np.spacing(0.2)
    found = problem.trajectory(np.array(horizon), lag=lag)
    np.testing.assert_allclose(found.events["dose"], [0.3], rtol=1e-12)
    assert found.values[0, horizon.index(0.3)] > 1.5
