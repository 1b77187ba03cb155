"""The domain of a solve: moved, checked, and the same as compiling for it."""

import math

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.solvers.request import Domain, SolveArguments, SolveRequest, check_factors
from rankone.solvers.selection import ENGINES, solve_with
from tests.problems import EXAMPLES, REFERENCE

DOMAIN = Domain((0.0, 6.0), ((8.0, 12.0), (4.0, 6.0)))
NAMES = ("x0", "y0")


def test_a_generated_module_brings_its_domain():
    assert Domain.of(ro.compile(REFERENCE["lotka_volterra"]()).system) == DOMAIN
    np.testing.assert_array_equal(DOMAIN.bounds, [[8, 12], [4, 6]])
    assert Domain((0.0, 1.0), ()).bounds.shape == (0, 2)


def test_intervals_are_moved_by_name_or_symbol():
    moved = DOMAIN.moved(NAMES, {"y0": (5, sp.Rational(11, 2)), sp.Symbol("x0"): [7, 8]}, 4)
    assert moved == Domain((0.0, 4.0), ((7.0, 8.0), (5.0, 5.5)))
    assert DOMAIN.moved(NAMES) == DOMAIN


@pytest.mark.parametrize(
    ("parameters", "t_final", "message"),
    [
        ({"x00": (1, 2)}, None, r"no parameter `x00` \(did you mean `x0`\?\); remedy: choose from"),
        ({sp.Symbol("z"): (1, 2)}, None, "no parameter `z`"),
        ({"x0": (2, 1)}, None, "the range of `x0` is .*ascending"),
        ({"x0": (1, 1)}, None, "`x0`"),
        ({"x0": (1, math.inf)}, None, "`x0`"),
        ({"x0": (math.nan, 1)}, None, "`x0`"),
        ({"x0": (1, 2, 3)}, None, "`x0`"),
        ({"x0": ("1", "2")}, None, "`x0`"),
        ({"x0": 3}, None, "`x0`"),
        ({"x0": (1, 2j)}, None, "`x0`"),
        ({"x0": (1, sp.Symbol("a"))}, None, "`x0`"),
        ({"x0": {1, 2}}, None, "the range of `x0`"),
        ({"x0": (False, 2)}, None, "the range of `x0`"),
        ({"x0": (1, 2), sp.Symbol("x0"): (1, 2)}, None, "the parameter `x0` is given twice"),
        (None, True, "the horizon"),
        (None, 0.0, "the horizon"),
        (None, -1, "the horizon"),
        (None, "late", "the horizon"),
    ],
)
def test_what_is_no_domain_is_refused(parameters, t_final, message):
    with pytest.raises(ro.OptionError, match=message):
        DOMAIN.moved(NAMES, parameters, t_final)


@pytest.mark.parametrize("method", ["train", "greedy"])
def test_a_moved_problem_equals_one_compiled_for_it(method):
    example = EXAMPLES["lotka_volterra"]
    solution = ro.compile(example.problem).solve(
        1e-3, method=method, parameters={example.x0: (7, 8), "y0": (4, 5)}, t_final=0.5
    )
    problem = ro.Problem(
        example.problem.equations,
        (example.t, 0, 0.5),
        {example.x0: (7, 8), example.y0: (4, 5)},
        {example.x: example.x0, example.y: example.y0},
    )
    wanted = ro.solve(problem, rtol=1e-3, method=method)
    assert solution.success
    assert solution.parameters == wanted.parameters == {"x0": (7.0, 8.0), "y0": (4.0, 5.0)}
    assert solution.time == wanted.time == (0.0, 0.5)
    where = {"t": [0.1, 0.5], "x0": [7.0, 7.7], "y0": [4.2, 5.0]}
    np.testing.assert_allclose(solution(**where), wanted(**where), rtol=1e-12)


def test_known_functions_that_are_not_finite_are_refused():
    compiled = ro.compile(
        ro.Problem.from_strings({"x": "-x/k + log(3 - t)"}, {"x": "1"}, {"k": (1, 2)}, time=(0, 1))
    )
    for moved, symbolic, numeric in (
        ({"parameters": {"k": (-1, 1)}}, "`1/k` is not finite at k = 0", "for `k` in"),
        ({"t_final": 4}, r"is not finite at t = 3", "for time in"),
    ):
        with pytest.raises(ro.OptionError, match=symbolic):
            compiled.solve(**moved)
        domain = Domain.of(compiled.system).moved(("k",), **moved)
        with pytest.raises(ro.OptionError, match=numeric):
            check_factors(compiled.system, domain)


@pytest.mark.parametrize("pole", ["k", "k - 0.3", "(k - 0.3)*(k + 0.7)", "k**2"])
@pytest.mark.parametrize("method", ["train", "greedy"])
def test_poles_between_the_samples_are_refused(pole, method):
    """Exported solvers know no expressions, only the factors as functions."""
    compiled = ro.compile(
        ro.Problem.from_strings({"x": f"-x/({pole})"}, {"x": "1"}, {"k": (1, 2)}, time=(0, 1))
    )
    engine = ENGINES[method]
    request = SolveRequest.of(
        compiled.system, [engine.options], {}, SolveArguments(1e-3, parameters={"k": (-1, 2)})
    )
    with pytest.raises(ro.OptionError, match="a coefficient is not finite for `k` in"):
        solve_with([engine], compiled.system, request, compiled.metadata())


def test_poles_of_initial_values_are_refused():
    problem = ro.Problem.from_strings({"x": "-x"}, {"x": "1/k"}, {"k": (1, 2)}, time=(0, 1))
    compiled = ro.compile(problem)
    engine = ENGINES["train"]
    request = SolveRequest.of(
        compiled.system, [engine.options], {}, SolveArguments(parameters={"k": (-1, 2)})
    )
    with pytest.raises(ro.OptionError, match="not finite for `k`"):
        solve_with([engine], compiled.system, request, compiled.metadata())
