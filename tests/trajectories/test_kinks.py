"""Steps that are divided at kinks, where trajectories of a stack cross them at their own times."""

import numpy as np
import pytest
import scipy.integrate

import rankone as ro
from rankone.trajectories.integrators.integrator import Tolerances
from rankone.trajectories.stacks.kinks import (
    DividedSteps,
    Kinks,
    SingleSteps,
    crossed_once,
    divided_steps,
)
from rankone.trajectories.stacks.stack import StackedIntegrator

TIMES = np.linspace(0.05, 2.0, 40)
POINTS = np.linspace(0.1, 2.0, 200)[:, None]
TOLERANCES = Tolerances(1e-8, np.full((1, 1), 1e-10))


def system_of(rate: str, start: str = "0"):
    problem = ro.Problem.from_strings({"x": rate}, {"x": start}, {"k": (0.1, 2)}, (0, 2))
    return ro.compile(problem).system


def exact(times, k):
    """Of x' = 1 + |x - k| from 0, which comes to the kink at log(1 + k)."""
    later = np.maximum(times - np.log1p(k), 0.0)
    return np.where(later > 0.0, k + np.expm1(later), -(1.0 + k) * np.expm1(-times))


@pytest.mark.slow
def test_trajectories_cross_a_kink_in_few_steps_and_no_less_accurately():
    steps, system = list[float](), system_of("1 + Abs(x - k)")
    every = np.linspace(0.0, 2.0, 2001)[1:]
    expected = exact(every[:, None], POINTS.T)
    integrator = StackedIntegrator(watch=steps.append)
    divided = integrator.sample(system, POINTS, [0.0, 2.0], TOLERANCES, every)
    whole = StackedIntegrator().run(system, POINTS, [0.0, 2.0], TOLERANCES)
    assert 20 * len(steps) < whole.steps
    error = np.abs(divided.states[:, 0] - expected).max()
    assert error < np.abs(whole(every)[0].T - expected).max()
    assert error < 100 * TOLERANCES.relative


@pytest.mark.parametrize(
    ("rate", "start"),
    [
        ("cos(4*t) + Abs(x - k)", "k"),  # begins at the kink, and comes back
        ("cos(4*t)*k + Max(x, 0.1*k) - Abs(x - k)", "0"),  # two kinks, crossed again and again
        ("-100*Abs(x - k/2) + 10", "0"),  # fast, and at rest beside the kink
    ],
)
def test_where_steps_cannot_be_divided_they_are_short(rate, start):
    system = system_of(rate, start)
    some = POINTS[::40]
    sampled = StackedIntegrator().sample(system, some, [0.0, 2.0], TOLERANCES, TIMES)
    for j, point in enumerate(some):

        def rates(time, state, at=point):
            return system.rhs(time, state, at)

        first = system.initial(point)
        settings = {"rtol": 1e-10, "atol": 1e-12, "max_step": 0.01, "t_eval": TIMES}
        alone = scipy.integrate.solve_ivp(rates, (0.0, 2.0), first, method="DOP853", **settings)
        np.testing.assert_allclose(sampled.states[:, 0, j], alone.y[0], rtol=1e-6, atol=1e-8)


def step_of(h: float) -> DividedSteps | None:
    """A step of x' = 1 + |x - k| from 0, divided at the kink of each trajectory."""
    system, columns = system_of("1 + Abs(x - k)"), np.arange(3)
    k = np.array([[0.2, 0.5, 0.9]])
    kinks = Kinks.of(system, k)
    heights, start = kinks.heights(columns), np.zeros((1, 3))
    last = heights(np.full(3, h), exact(h, k))
    crossed, which = crossed_once(heights(np.zeros(3), start), last)
    assert crossed.tolist() == [0, 1, 2]
    assert which.tolist() == [0, 0, 0]
    return divided_steps(
        columns,
        lambda t, u: system.rhs(t, u, k),
        lambda t, u: heights(t, u)[0],
        (0.0, h, start, system.rhs(0.0, start, k)),
        last[0],
        (1e-8, np.full((1, 3), 1e-10)),
    )


def test_a_step_is_divided_where_each_trajectory_crosses():
    divided = step_of(0.7)
    k = np.array([0.2, 0.5, 0.9])
    np.testing.assert_allclose(0.7 * divided.shares, np.log1p(k), atol=3e-6)
    np.testing.assert_allclose(divided.after.end[0], exact(0.7, k), rtol=3e-6)
    interpolant, columns = divided.interpolant(), np.array([0, 1, 2])
    for share in (0.1, 0.3, 0.7, 0.99):
        states, slopes = interpolant(columns, np.full(3, share), slopes=True)
        np.testing.assert_allclose(states[0], exact(0.7 * share, k), rtol=3e-6)
        np.testing.assert_allclose(slopes[0], 0.7 * (1.0 + np.abs(states[0] - k)), rtol=1e-5)


def test_the_parts_of_a_step_have_the_order_of_the_method():
    errors = []
    for h in (1.6, 0.8):
        before = SingleSteps(
            lambda t, u: np.cos(t) * u, np.zeros(1), np.ones((1, 1)), np.ones((1, 1)), np.array([h])
        )
        errors.append(abs(before.end[0, 0] - np.exp(np.sin(h))))
    assert np.log2(errors[0] / errors[1]) > 7.5


def test_heights_that_change_their_sign_in_two_rows_are_left_alone():
    first = np.array([[1.0, 1.0, 1.0], [-1.0, -1.0, 2.0]])
    last = np.array([[-1.0, -1.0, 3.0], [-1.0, 2.0, 1.0]])
    columns, which = crossed_once(first, last)
    assert columns.tolist() == [0]
    assert which.tolist() == [0]


def test_a_smooth_system_has_no_kinks():
    assert Kinks.of(system_of("-k*x"), POINTS.T) is None
