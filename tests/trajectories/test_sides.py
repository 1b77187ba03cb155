"""Generated functions of states of which the last ones are known numbers."""

from __future__ import annotations

import itertools
from functools import cache

import numpy as np
import pytest

import rankone as ro
from rankone.trajectories.events.sides import of_known_states, on_sides

POINTS = 20


RATES = {
    "saturation and friction": (
        {"x": "w", "w": "Max(-2, Min(2, k*(1 - x) - w)) - c*sign(w)"},
        {"k": (1, 5), "c": (0.1, 1)},
    ),
    "cases": (
        {"x": "Piecewise((0, (x >= 1) & (k > v)), (k - v, True))", "v": "Abs(x - 1/2) - v"},
        {"k": (1, 2)},
    ),
    "steps of the clock": (
        {"x": "Heaviside(t - a) + Max(x, y) - k*x*x", "y": "cos(t) - y*Heaviside(x - 1)"},
        {"a": (0.2, 0.8), "k": (1, 2)},
    ),
}


@cache
def held(name):
    """The system with the sides of its switches as states."""
    rates, box = RATES[name]
    start = dict.fromkeys(rates, 0.1)
    problem = ro.Problem.from_strings(rhs=rates, initial=start, parameters=box, time=(0.0, 1.0))
    return ro.compile(problem)._held


@pytest.mark.parametrize("name", RATES)
def test_known_sides_change_no_value(name):
    system, random = held(name), np.random.default_rng(3)
    n = system.n_differential - system.n_sides
    t, u = random.random(POINTS), random.standard_normal((n, POINTS))
    p = random.uniform(*np.array(system.box).T[:, :, None], (len(system.box), POINTS))
    for sides in [*itertools.product((-1, 0, 1), repeat=system.n_sides)][::4]:
        alone = on_sides(system, sides)
        rows = np.concatenate([u, np.repeat(np.array(sides, float)[:, None], POINTS, axis=1)])
        with np.errstate(all="ignore"):
            exact = system.rhs(t, rows, p)[:n]
            assert np.array_equal(alone.rhs(t, u, p), exact, equal_nan=True)
            exact = system.jacobian(t, rows, p)[:n, :n]
            assert np.array_equal(alone.jacobian(t, u, p), exact, equal_nan=True)
            for one, other in zip(alone.events, system.events, strict=True):
                own, exact = (each.when(t, v, p) for each, v in ((one, u), (other, rows)))
                assert np.array_equal(own, exact, equal_nan=True)


def test_known_sides_leave_out_what_they_do_not_select():
    system = held("saturation and friction")
    sides = (1,) * system.n_sides
    rhs = of_known_states(system.rhs, tuple(map(float, sides)), (0, 1))
    assert "where" in system.rhs.__code__.co_names
    assert "where" not in rhs.__code__.co_names
    assert rhs(0.0, np.ones((2, 3)), np.ones((2, 3))).shape == (2, 3)


def test_functions_that_are_not_generated_or_divide_by_zero_have_no_shorter_form():
    namespace = {"np": np}
    text = "def rates(t, u, p):\n    x, side = u\n    out = np.empty((2, x.size))\n"
    text += "    out[0] = x / side\n    return out\n"
    exec(text, namespace)
    assert of_known_states(namespace["rates"], (0.0,), (0,)) is None  # no text at hand
    assert of_known_states(_divided, (0.0,), (0,)) is None
    assert of_known_states(_divided, (2.0,), (0,))(0.0, np.ones((1, 1)), ()) == 1.5
    assert of_known_states(_in_cases, (1.0,), (0,)) is None


def _divided(t, u, p):
    x, side = u
    c0 = 1.0 / side
    out = np.empty((2, x.size))
    out[0] = x + c0
    out[1] = side
    return out


def _in_cases(t, u, p):
    x, side = u
    out = np.empty((2, x.size))
    if side:
        out[0] = x
    return out
