"""Solves of states that rest at a limit, against closed forms and modes written by hand."""

import numpy as np
import pytest
import scipy.integrate

import rankone as ro

RTOL = 1e-4
TIMES = np.linspace(0, 6, 41)


def assert_right(problem, exact, points):
    """A success whose states are those of ``exact(times, **point)``, for each point."""
    solution = ro.solve(problem, RTOL)
    assert solution.success, solution.message
    for point in points:
        states = np.atleast_2d(exact(TIMES, **point))
        found = np.array([solution[name](t=TIMES, **point) for name in problem_states(problem)])
        found = found[: len(states)]
        np.testing.assert_allclose(found, states, atol=3 * RTOL * np.abs(states).max())


def problem_states(problem):
    return [f.func.__name__ for f in problem.unknowns]


def held(rates, start, brim, leaves):
    """A state that rests at a brim from where it comes there until a time that it leaves."""
    full = scipy.integrate.solve_ivp(
        rates,
        (0, 6),
        [start],
        rtol=1e-10,
        atol=1e-12,
        dense_output=True,
        events=[reach := (lambda t, u: u[0] - brim)],
    )
    assert reach is not None
    comes = full.t_events[0][0]
    after = scipy.integrate.solve_ivp(
        rates, (leaves, 6), [brim], rtol=1e-10, atol=1e-12, dense_output=True
    )
    values = np.where(comes > TIMES, full.sol(TIMES)[0], brim)
    return np.where(leaves < TIMES, after.sol(np.maximum(TIMES, leaves))[0], values)


@pytest.mark.parametrize(
    "rate", ["k*Heaviside(1 - x)", "Piecewise((k, x < 1), (0, True))", "k*(1 - sign(x - 1))/2"]
)
def test_it_fills_up_to_a_limit(rate):
    filled = ro.Problem.from_strings(
        {"x": rate}, {"x": "a"}, {"k": (0.5, 2), "a": (0, 0.5)}, (0, 6)
    )
    points = [{"k": k, "a": a} for k, a in ((0.5, 0.1), (1.3, 0.4))]
    assert_right(filled, lambda t, k, a: np.minimum(a + k * t, 1), points)


@pytest.mark.slow
def test_what_is_used_up_rests_also_after_a_jump_of_what_uses_it():
    used = "Piecewise((k*e, S > 0), (0, True))"
    depleted = ro.Problem.from_strings(
        {"S": f"-{used}", "P": used, "e": "0"},
        {"S": 2, "P": 0, "e": 0.5},
        {"k": (0.6, 1.5)},
        (0, 6),
        jumps={1.0: {"e": "e + 1"}, 5.0: {"e": "3*e"}},
    )

    def exact(t, k):
        product = np.minimum(k * (0.5 * np.minimum(t, 1) + 1.5 * np.maximum(t - 1, 0)), 2)
        return [2 - product, product]

    assert_right(depleted, exact, [{"k": 0.7}, {"k": 1.4}])


def test_a_dose_ends_a_rest():
    emptied = ro.Problem.from_strings(
        {"S": "-Piecewise((k, S > 0), (0, True))"},
        {"S": 1},
        {"k": (0.5, 1)},
        (0, 6),
        jumps={3.0: {"S": "S + 1"}},
    )

    def exact(t, k):
        return np.where(t < 3, np.maximum(1 - k * t, 0), np.maximum(1 - k * (t - 3), 0))

    solution = ro.solve(emptied, RTOL)
    assert solution.success
    times = TIMES[np.abs(TIMES - 3) > 1e-9]
    for k in (0.55, 0.9):
        np.testing.assert_allclose(solution["S"](t=times, k=k), exact(times, k), atol=3 * RTOL)


@pytest.mark.slow
def test_it_leaves_a_limit_when_time_says_so():
    rate = "Piecewise((0, (x >= 1) & (cos(t) > 0)), (k*cos(t), True))"
    clipped = ro.Problem.from_strings({"x": rate}, {"x": 0}, {"k": (1.2, 2)}, (0, 4))

    def exact(t, k):
        free = k * np.sin(t)
        return np.where(t > np.pi / 2, 1 + k * (np.sin(t) - 1), np.minimum(free, 1))

    solution = ro.solve(clipped, RTOL)
    assert solution.success
    times = np.linspace(0, 4, 41)
    for k in (1.25, 1.9):
        np.testing.assert_allclose(solution["x"](t=times, k=k), exact(times, k), atol=3 * RTOL)


@pytest.mark.parametrize(
    "full",
    [
        pytest.param("0, (h >= 1) & (net > 0)", marks=pytest.mark.slow),
        pytest.param("Min(0, net), h >= 1", marks=pytest.mark.slow),
    ],
)
def test_a_tank_overflows_until_less_flows_in_than_out(full):
    tank = ro.Problem.from_strings(
        {"h": f"Piecewise(({full}), (net, True))"},
        {"h": "h0"},
        {"a": (1.6, 2), "h0": (0.2, 0.6)},
        (0, 6),
        definitions={"net": "a - t*h/2"},
    )

    def exact(t, a, h0):
        return held(lambda t, u: a - t * u / 2, h0, 1, 2 * a)

    assert_right(tank, exact, [{"a": 1.65, "h0": 0.25}, {"a": 1.95, "h0": 0.5}])


@pytest.mark.parametrize("start", ["1", "3/2"])
def test_a_start_at_a_limit_or_beyond_it_rests(start):
    rates = {"x": "k*Heaviside(1 - x)", "y": "1 - x/k"}
    filled = ro.Problem.from_strings(rates, {"x": start, "y": 0}, {"k": (0.5, 2)}, (0, 6))
    level = 1.0 if start == "1" else 1.5

    def exact(t, k):
        return [np.full_like(t, level), (1 - level / k) * t]

    assert_right(filled, exact, [{"k": 0.6}, {"k": 1.9}])


@pytest.mark.slow
def test_a_limit_that_a_part_of_the_box_misses_is_refused_with_a_part():
    """Over clock time its trajectories seem to stall."""
    rate = "Piecewise((0, (x >= 1) & (cos(t) > 0)), (k*cos(t), True))"
    grazing = ro.Problem.from_strings({"x": rate}, {"x": 0}, {"k": (0.5, 2)}, (0, 10))
    with pytest.raises(ro.ConvergenceError, match="it was solved") as refused:
        ro.solve(grazing, RTOL)
    ((lower, upper),) = refused.value.part
    assert ro.solve(grazing, RTOL, parameters={"k": (lower, upper)}).success
