"""Piecewise functions whose branches leave something out: an error that names the gap."""

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.problem.expressions.admissible import closed, gaps

t, a = sp.symbols("t a")
x = sp.Function("x")(t)


def either(*branches):
    return sp.Piecewise(*branches)


def problem(rate=-a * x, initial=1, jumps=None, T=1):
    box = {a: (1, 2)}
    return ro.Problem([sp.Eq(x.diff(t), rate)], (t, 0, T), box, {x: initial}, jumps=jumps)


@pytest.mark.parametrize(
    ("function", "total"),
    [
        (either((a, t < 0.5), (x, t > 0.5)), either((a, t < 0.5), (x, True))),
        (either((a, t > 0.5), (x, t < 0.5)), either((a, t >= 0.5), (x, True))),
        (either((a, -t > -0.5), (x, t > 0.5)), either((a, t < 0.5), (x, True))),
        (either((a, t < 0.3), (x, t >= 0.1 * 3)), either((a, t < 0.3), (x, True))),
        (
            either((1, t < 1), (2, (t > 1) & (t < 2)), (3, t > 2)),
            either((1, t < 1), (2, t < 2), (3, True)),
        ),
        (either((1, x < 2), (a, x > 2)), either((1, x < 2), (a, True))),
        (either((1, x < 2 * a), (2, x > 2 * a)), None),
        (either((1, (t < 1) & (x < 1)), (2, (t >= 1) | (x >= 1))), None),
        (either((1, sp.Ne(t, 1))), sp.S.One),
        (either((either((1, t < 1)), t < 1), (0, True)), None),
    ],
)
def test_single_points_take_the_branch_to_their_right(function, total):
    assert not list(gaps(closed(function)))
    assert total is None or closed(1 + x * function) == 1 + x * total


@pytest.mark.slow
def test_every_value_is_that_of_the_first_branch_that_holds():
    """Closing a function changes it at single points alone, to the value on their right."""
    rng = np.random.default_rng(1)
    for _ in range(30):
        ends = np.sort(rng.integers(0, 6, 3))
        kinds = [(sp.Lt, sp.Gt), (sp.Le, sp.Gt), (sp.Lt, sp.Ge), (sp.Le, sp.Ge)]
        below, above = kinds[rng.integers(4)]
        branches = [
            (1, below(t, int(ends[0]))),
            (2, above(t, int(ends[0])) & below(t, int(ends[1]))),
            (3, above(t, int(ends[1]))),
        ]
        rng.shuffle(branches)
        function = sp.Piecewise(*branches)
        for at in np.arange(-1, 7, 0.5):
            value = function.subs(t, at)
            if value is sp.nan:
                value = function.subs(t, at + 0.25)
            assert closed(function).subs(t, at) == value, (function, at)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"rate": -x * either((a, t < 0.5), (2 * a, t > 0.7))}, r"for 0\.5 < t < 0\.7"),
        ({"rate": -x * either((a, t < 0.5), (0, t > 0.7))}, r"for 0\.5 < t < 0\.7"),
        ({"rate": -x * either((a, a < 1.3), (2, a > 1.5))}, r"for 1\.3 < a < 1\.5"),
        ({"rate": -x * either((a, t**2 < 0.25), (2, t > 0.6))}, r"for 0\.5 < t < 0\.6"),
        ({"rate": -x * either((a, sp.sin(40 * t) > 0))}, r"for 0\.078\d+ < t < 0\.157"),
        ({"rate": -x * either((1, (t < 0.5) & (a < 1.5)), (2, (t >= 0.5) | (a > 1.6)))},
         r"for 0 < t < 0\.5 and 1\.5 < a < 1\.6"),
        ({"rate": -x * either((1, t < 0.5 * a), (2, t > 0.5 * a + 1e-7))}, r"for example at t = "),
        ({"initial": either((1, a < 1.3), (2, a > 1.5))}, r"initial value of .* no branch"),
        ({"jumps": {0.5: {x: x * either((1, a < 1.3), (2, a > 1.5))}}}, r"jump at t = 0\.5 has no"),
    ],
)  # fmt: skip
def test_gaps_in_time_and_parameters_are_found_when_compiled(given, said):
    with pytest.raises(ro.ProblemError, match=said):
        ro.compile(problem(**given))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"rate": -either((a * x, x > 0.8), (2 * a * x, x < 0.6))}, r"equation 1: .*x < 0\.8\)"),
        ({"rate": -either((a * x, x > 0.8), (2 * a * x, x < 0.8 - 1e-7))}, r"entered at t = "),
        ({"rate": -a * x / either((1, x < 0.5))}, r"no branch where `x > 0\.5`: entered at t = 0"),
        ({"jumps": {0.5: {x: either((x, x < 0.3), (2 * x, x > 0.7))}}}, r"entered at t = 0\.5"),
    ],
)  # fmt: skip
def test_gaps_in_unknowns_are_named_where_they_are_met(given, said):
    with pytest.raises(ro.ProblemError, match=said):
        ro.compile(problem(**given)).solve(1e-3)


def test_gaps_outside_are_none_until_the_horizon_reaches_them():
    rate = "-x*Piecewise((a, t < 0.5), (2*a, (t >= 0.5) & (t < 1.5)))"
    given = {"initial": {"x": 1}, "parameters": {"a": (1, 2)}, "time": (0, 1)}
    compiled = ro.compile(ro.Problem.from_strings({"x": rate}, **given))
    solution = compiled.solve(1e-4)
    assert solution.success
    assert solution(t=1.0, a=1.5)[0] == pytest.approx(np.exp(-2.25), rel=1e-3)
    with pytest.raises(ro.OptionError, match=r"no branch for 1\.5 < t < 2"):
        compiled.solve(1e-4, t_final=2)


def test_a_piecewise_of_text_needs_no_branch_for_everything_else():
    branches = "(a, t < 0.5), (2*a, t > 0.5)"
    given = {"initial": {"x": 1}, "parameters": {"a": (1, 2)}, "time": (0, 1)}
    solution = ro.solve(ro.Problem.from_strings({"x": f"-x*Piecewise({branches})"}, **given), 1e-5)
    assert solution.success
    assert solution.method == "train"
    assert solution(t=1.0, a=1.5)[0] == pytest.approx(np.exp(-2.25), rel=1e-4)


def test_gaps_of_outputs():
    solution = ro.solve(problem(-a * x), 1e-5)
    good = solution.output({"q": either((x, t < 0.5), (2 * x, t > 0.5))})
    assert good(t=0.9, a=1.5)[0] == pytest.approx(2 * np.exp(-1.35), rel=1e-4)
    with pytest.raises(ro.OptionError, match=r"in an output has no branch for 0\.5 < t < 0\.7"):
        solution.output({"q": either((x, t < 0.5), (2 * x, t > 0.7))})
    with pytest.raises(ro.EvaluationError, match=r"no branch where .*: met at t = "):
        solution.output({"q": ro.maximum(either((x, x < 0.5), (2 * x, x > 0.7)))})
