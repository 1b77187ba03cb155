"""Best parameters, against closed forms."""

import functools

import numpy as np
import pytest

import rankone as ro
from rankone.support.errors import EvaluationError, OptionError
from tests.inference.estimation.multimodal import CASES, LEAST
from tests.inference.estimation.systems import decay


def absorbed():
    """Two compartments in a row: the second has its largest value (closed form) inside the box."""
    problem = ro.Problem.from_strings(
        {"x": "-k*x", "y": "k*x - y"}, {"x": "1", "y": "0"}, {"k": (0.1, 6)}, (0, 4)
    )
    return ro.solve(problem, 1e-8)


def test_of_an_unknown():
    solution, t = absorbed(), 1.5
    k = np.linspace(0.11, 5.99, 200001)
    y = k / (k - 1.0) * (np.exp(-t) - np.exp(-k * t))
    best = solution.minimize("y", t, sense="max")
    assert best.success, best.message
    assert best.x["k"] == pytest.approx(k[np.nanargmax(y)], rel=1e-3)
    assert best.fun == pytest.approx(np.nanmax(y), rel=1e-6)
    assert best.values == {"y": best.fun}
    low = solution.minimize("y", t)
    assert low.x == {"k": 0.1}
    assert low.is_global
    assert "`k` at its lower bound" in low.message


def test_of_a_function():
    """A design that meets two values: a exp(-k t) through (0.5, 1.2) and (1.5, 0.6)."""
    goal = np.array([1.2, 0.6])
    best = decay().minimize(lambda u, p: np.sum((u["u"] - goal) ** 2), [0.5, 1.5])
    k = np.log(2.0)
    assert best.x == {"k": pytest.approx(k, rel=1e-4), "a": pytest.approx(1.2 * 2**0.5, rel=1e-4)}
    dear = decay().minimize(lambda u, p: p["a"] ** 2 - u["u"], 1.0, fixed={"k": 1})
    assert dear.x["a"] == pytest.approx(0.5)
    inner = decay().minimize(lambda u, p: (p["a"] - 1) ** 2 - u["u"], 1.0, fixed={"k": 1})
    assert inner.x["a"] == pytest.approx(1 + 0.5 * np.exp(-1), rel=1e-5)
    assert inner.parameters["k"] == 1.0


@pytest.mark.slow
def test_constraints():
    """The largest amount after 2, with no more than 1.5 at 0.5: a exp(-k/2) = 1.5, least k."""
    best = decay().minimize("u", 2.0, sense="max", constraints={"u": (None, 1.5, [0.5])})
    assert best.success, best.message
    assert best.x["k"] == pytest.approx(0.2, abs=1e-6)
    assert best.x["a"] == pytest.approx(1.5 * np.exp(0.1), rel=1e-6)
    none = decay().minimize("u", 2.0, constraints={"u": (10, None)})
    assert not none.success
    assert "`u` misses its limits by 7.9" in none.message


def found_least(name):
    case = CASES[name]
    best = case.solution.minimize(case.objective, case.at, sense=case.sense)
    assert case.is_least(case.value(list(best.x.values())), LEAST[name]), best.message
    return best


@pytest.mark.parametrize(
    "name",
    [
        "rastrigin 4",
        "schwefel 4",
        "shekel",
        pytest.param("two frequencies, two amplitudes", marks=pytest.mark.slow),
    ],
)
def test_the_minimum_over_the_box(name):
    """Each has many minima, and one search from the best of a sample ends in another one."""
    best = found_least(name)
    assert best.is_global
    assert best.agreeing > 1
    assert f"{best.agreeing} of {best.searches} searches ended at this minimum" in best.message


@pytest.mark.slow
def test_the_minima_of_six_of_thirty_problems():
    """Differential evolution tells the truth (``python -m
    tests.inference.estimation.multimodal``)."""
    assert len(CASES) == 30
    for name in [*CASES][::5]:
        found_least(name)


def test_a_minimum_that_may_be_local():
    case = CASES["rastrigin 4"]
    start = dict.fromkeys(case.box, -2.6)
    best = case.solution.minimize(case.objective, case.at, start=start, starts=0)
    assert best.success
    assert not best.is_global
    assert "may be a local one; remedy: raise effort, or narrow the bounds" in best.message
    assert best.fun > LEAST["rastrigin 4"] + 1
    low = case.solution.minimize(case.objective, case.at, effort="low")
    assert low.searches <= 4 + 2
    again = case.solution.minimize(case.objective, case.at, start=start, starts=0)
    assert again == best


@functools.cache
def failed():
    """A solution that missed its tolerance, and an output of one."""
    rates, box = {"x": "cos(a*b*t + a*x)"}, {"a": (0.5, 2), "b": (0.5, 2)}
    return ro.solve(
        ro.Problem.from_strings(rates, {"x": "0"}, box, (0, 3)), 1e-8, max_rank=3, effort=0.1
    )


@pytest.mark.parametrize(
    "output",
    [
        pytest.param(None, marks=pytest.mark.slow),
        pytest.param({"y": "x**2"}, marks=pytest.mark.slow),
    ],
)
def test_of_a_solution_that_is_no_success(output):
    solution = failed() if output is None else failed().output(output)
    assert not solution.success
    best = solution.minimize(next(iter(solution.states)), 1.5, effort="low")
    assert not best.success
    assert best.message.startswith("the solution itself is not a success: ")


@pytest.mark.parametrize(
    ("arguments", "given", "message"),
    [
        (("v", 1.0), {}, "there is no unknown `v`"),
        ((3, 1.0), {}, "neither an unknown nor a function"),
        (("u", [1.0, 2.0]), {}, "is given at several times"),
        (("u",), {}, "no times are given"),
        (("u", 1.0), {"sense": "up"}, "sense='up'"),
        (("u", 1.0), {"effort": "huge"}, "effort='huge' is unknown"),
        (("u", 1.0), {"fixed": {"k": 1, "a": 1}}, "all parameters are fixed"),
        (("u", 1.0), {"constraints": {"w": (0, 1)}}, "no unknown `w`"),
        (("u", 1.0), {"constraints": {"u": 1}}, "the limits of `u` are 1"),
        (("u", 1.0), {"constraints": {"u": (2, 1)}}, "leave nothing"),
        (("u", 1.0), {"constraints": {"u": ("a", 1)}}, "a limit of `u`"),
        (("u", 1.0), {"constraints": [1]}, "not a mapping"),
        ((lambda u, p: "x", 1.0), {}, "not a number"),
        ((lambda u, p: np.nan, 1.0), {}, "not finite anywhere"),
    ],
)
def test_bad_input(arguments, given, message):
    with pytest.raises(OptionError, match=message):
        decay().minimize(*arguments, **given)
    with pytest.raises(EvaluationError, match="outside its horizon"):
        decay().minimize("u", 3.0)
