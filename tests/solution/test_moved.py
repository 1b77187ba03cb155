"""A problem solved on another box and horizon is the problem compiled anew there."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from tests.problems import EXAMPLES

MOVED = {
    "decay": ({"k": (0.4, 4.0)}, 1.5),
    "coupled": ({}, 0.4),
    "lotka_volterra": ({"x0": (7, 13)}, 4.0),
    "kirchhoff": ({"a1": (0.6, 0.9), "a6": (0.4, 1.0)}, 0.7),
}


CASES = [*((name, "train") for name in MOVED), ("decay", "greedy"), ("coupled", "greedy")]


@pytest.mark.parametrize(("name", "method"), CASES)
def test_equal_to_a_new_compile(name, method):
    parameters, t_final = MOVED[name]
    problem = EXAMPLES[name].problem
    rtol = 1e-3 if method == "greedy" else 1e-5
    moved = ro.compile(problem).solve(rtol, method=method, parameters=parameters, t_final=t_final)
    box = {k: parameters.get(k.name, bounds) for k, bounds in problem.parameters.items()}
    t, start, _ = problem.time
    again = ro.Problem(problem.equations, (t, start, t_final), box, problem.initial)
    wanted = ro.solve(again, rtol, method=method)
    assert moved.parameters == wanted.parameters
    assert moved.time == wanted.time
    random = np.random.default_rng(0)
    points = {k.name: a + (b - a) * random.random(50) for k, (a, b) in box.items()}
    points[t.name] = start + (t_final - start) * random.random(50)
    a, b = moved(points), wanted(points)
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * np.abs(b).max())


t, k, m = sp.symbols("t k m")
positive = sp.Symbol("p", positive=True)
x = sp.Function("x")(t)


@pytest.mark.parametrize(
    ("rate", "box", "moved", "message"),
    [
        (1 / k, (1, 2), {"parameters": {k: (-1, 2)}}, "`1/k` is not finite at k = 0"),
        (sp.sqrt(k), (1, 2), {"parameters": {"k": (-1, 2)}}, "`sqrt.k.` is not real at k = -1"),
        (1 / (t - 2), (1, 2), {"t_final": 3}, "not finite at t = 2, inside the horizon"),
        (k, (1, 2), {"parameters": {"q": (1, 2)}}, "there is no parameter `q`"),
        (k, (1, 2), {"parameters": {"k": (2, 1)}}, "range of `k` is .2, 1., not two numbers"),
        (k, (1, 2), {"parameters": {"k": 3}}, "not two numbers"),
        (k, (1, 2), {"parameters": [1]}, "not a mapping"),
        (k, (1, 2), {"t_final": -1}, "the horizon is"),
        (k, (1, 2), {"t_final": "late"}, "the horizon is"),
    ],
)
def test_where_it_cannot_be_moved(rate, box, moved, message):
    used = {k: box} if k in sp.sympify(rate).free_symbols else {}
    problem = ro.Problem([sp.Eq(x.diff(t), -rate * x)], (t, 0, 1), used, {x: 1})
    compiled = ro.compile(problem)
    with pytest.raises(ro.OptionError, match=message):
        compiled.solve(1e-3, **moved)


def test_assumptions_hold_where_it_is_moved_to():
    problem = ro.Problem([sp.Eq(x.diff(t), -positive * x)], (t, 0, 1), {positive: (1, 2)}, {x: 1})
    with pytest.raises(ro.OptionError, match="contradicts the assumption that p is positive"):
        ro.compile(problem).solve(1e-3, parameters={positive: (-1, 2)})
    mass = ro.Problem([sp.Eq((k - 1.5) * x.diff(t), (k - 1.5) * x)], (t, 0, 1), {k: (2, 3)}, {x: 1})
    with pytest.raises(ro.OptionError, match=r"vanishes at k = 1\.5"):
        ro.compile(mass).solve(1e-3, parameters={k: (1, 3)})
