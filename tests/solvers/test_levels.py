"""Solves whose rates have staircases and tables of unknowns, against closed forms and SciPy."""

import numpy as np
import pytest
import sympy as sp

import rankone as ro

RTOL = 1e-5
t, k, c = sp.symbols("t k c")
x, y = sp.Function("x")(t), sp.Function("y")(t)
LINES = ro.table([-2, -0.5, 0.2, 0.6, 2], [0, 1, -1, 0.5, 3])
STEPS = ro.table([-2, -0.5, 0.2, 0.6, 2], [0, 1, -1, 0.5, 3], "previous")
BOX = {k: (0.8, 1.2), c: (0.95, 1.05)}


def problem(rate, other, start, end=4):
    equations = [sp.Eq(x.diff(t), rate), sp.Eq(y.diff(t), other)]
    return ro.Problem(equations, (t, 0, end), BOX, dict(zip((x, y), start)))


def points(count=4):
    ends = np.array(list(BOX.values()))
    return ends[:, 0] + np.ptp(ends, axis=1) * np.random.default_rng(8).random((count, len(ends)))


@pytest.mark.slow
def test_a_counter_that_goes_up_at_each_level():
    counter = problem(-k * x + sp.floor(y), c, (0, 0.1))
    solution = ro.solve(counter, RTOL)
    assert solution.success
    times = np.linspace(0, 4, 81)
    for rate, speed in points():
        steps = (np.arange(1, 5) - 0.1) / speed
        after = np.maximum(times - steps[:, None], 0.0)
        exact = ((1 - np.exp(-rate * after)) / rate).sum(axis=0)
        np.testing.assert_allclose(solution["x"](t=times, k=rate, c=speed), exact, atol=3 * RTOL)


@pytest.mark.parametrize(
    ("rate", "slope", "start", "level"),
    [
        pytest.param(k / 2 - sp.floor(x), lambda rate: rate / 2, 0.4, 1.0, marks=pytest.mark.slow),
        pytest.param(
            STEPS(x + 1) - k / 2, lambda rate: 1 - rate / 2, -0.9, -0.8, marks=pytest.mark.slow
        ),
    ],
    ids=["floor", "table"],
)
def test_a_state_slides_along_a_level(rate, slope, start, level):
    relay = problem(rate, -y * c, (start, 1))
    solution = ro.solve(relay, RTOL)
    assert solution.success
    times = np.linspace(0, 4, 41)
    for at, other in points():
        exact = np.minimum(start + slope(at) * times, level)
        np.testing.assert_allclose(solution["x"](t=times, k=at, c=other), exact, atol=3 * RTOL)


@pytest.mark.slow
@pytest.mark.parametrize(
    "rate",
    [
        -k * x + sp.ceiling(c * y / 2 + sp.Rational(17, 100)),
        -k * x + sp.frac(sp.Rational(13, 10) * c * y + sp.Rational(1, 20)),
        -k * x + sp.Mod(c * y, sp.Rational(7, 10)),
        -k * x + LINES(c * y),
        -k * LINES(x) / 3 + y,
        -k * x + STEPS(c * y),
    ],
    ids=str,
)
def test_levels_that_are_crossed(rate):
    crossed = problem(rate, sp.cos(t), (1, 0.1), 5)
    solution = ro.solve(crossed, 1e-4)
    assert solution.success
    assert solution.timeline.stretches > 1
    times = np.linspace(0, 5, 101)
    for at in points():
        named = dict(zip(("k", "c"), at.tolist()))
        exact = crossed.trajectory(times, rtol=1e-9, **named).values
        np.testing.assert_allclose(solution(t=times, **named), exact, atol=3e-4)


def test_levels_that_a_blow_up_reaches_are_not_written():
    blown = ro.Problem(
        [sp.Eq(x.diff(t), k * x**2 + sp.floor(x))], (t, 0, 9), {k: (1, 1.1)}, {x: 0.2}
    )
    assert ro.compile(blown).held_source is None


ENDING = ro.table([0, 0.4, 0.9, 1.6, 9], [3, 2, 1.4, 1, 1], "previous")


@pytest.mark.parametrize(
    ("rates", "start", "further"),
    [
        ((ENDING(x) - k / 2, -c * y), (0, 1), {}),
        ((k, sp.Piecewise((1, sp.Mod(x, 1) < 0.4), (0, True)) - c * y), (0.2, 0), {}),
        ((sp.Piecewise((k, x < 1.3), (0.5 + 0.2 * sp.floor(2 * x), True)), -c * y), (0.1, 1), {}),
        (
            (-k * x, sp.floor(2 * x) - c * y),
            (0.9, 0),
            {"jumps": {1: {x: x + 1}}, "events": [ro.Event(x - 0.4, "falling", then={x: x + 0.9})]},
        ),
    ],
    ids=["start at the end of a table", "condition", "branch", "resets"],
)
@pytest.mark.slow
def test_levels_where_rates_end_or_states_are_reset(rates, start, further):
    equations = [sp.Eq(u.diff(t), rate) for u, rate in zip((x, y), rates, strict=True)]
    box = {k: (0.95, 1.05), c: (0.45, 0.55)}
    levels = ro.Problem(equations, (t, 0, 2.3), box, dict(zip((x, y), start)), **further)
    solution = ro.solve(levels, 1e-4)
    assert solution.success, solution.message
    assert solution.timeline.stretches > 1
    times = np.linspace(0, 2.3, 47)
    for rate, other in ((0.96, 0.46), (1.01, 0.53), (1.04, 0.49)):
        exact = levels.trajectory(times, rtol=1e-9, k=rate, c=other).values
        np.testing.assert_allclose(solution(t=times, k=rate, c=other), exact, atol=3e-4)
