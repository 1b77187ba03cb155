"""``atol``: the error of an unknown is relative to its largest value plus atol/rtol."""

import pickle
import subprocess
import sys

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.support.errors import ProblemError

t, k = sp.symbols("t k")
x, y = sp.Function("x")(t), sp.Function("y")(t)
RTOL = 1e-4
TIMES = np.linspace(0.0, 2.0, 21)


def problem(atol=None, **changes):
    """Beside x there is y, of the size 1e-9, with a rate that is hard to resolve."""
    rate = -k * y + sp.Rational(1, 10**9) * x * sp.sin(5 * x) * sp.cos(12 * t)
    arguments = {
        "equations": [sp.Eq(x.diff(t), -k * x), sp.Eq(y.diff(t), rate)],
        "time": (t, 0, 2),
        "parameters": {k: (1, 2)},
        "initial": {x: 1, y: 0},
        "atol": atol,
    }
    return ro.Problem(**{**arguments, **changes})


def errors_at(solution, of, points=(1.03, 1.37, 1.5, 1.81)):
    """Largest errors, and largest values, at some points."""
    exact = np.stack([of.trajectory(TIMES, k=at, rtol=1e-11).values for at in points])
    found = np.stack([solution(t=TIMES, k=at) for at in points])
    return np.nanmax(np.abs(found - exact), axis=(0, 2)), np.nanmax(np.abs(exact), axis=(0, 2))


@pytest.mark.parametrize("method", ["cross", "train"])
def test_errors_are_relative_to_the_size_plus_atol_over_rtol(method):
    of = problem({y: 1e-6})
    solution = ro.solve(of, rtol=RTOL, method=method)
    assert solution.success
    absolute, sizes = errors_at(solution, of)
    assert absolute[0] <= RTOL * sizes[0]
    assert absolute[1] <= 1e-6
    assert solution.errors["y"] <= 2e-9 / (
        1e-6 / RTOL
    )  # y itself over its unit: nothing to resolve
    plain = ro.solve(problem(), rtol=RTOL, method=method)
    assert errors_at(plain, of)[0][1] <= RTOL * sizes[1]
    assert plain.errors["y"] > 1e3 * solution.errors["y"]
    assert "absolute tolerances y 1e-06" in " ".join(str(solution).split())


def test_an_error_beyond_both_is_none_that_is_allowed():
    of = problem({y: 1e-12})
    solution = ro.solve(of, rtol=RTOL)
    absolute, sizes = errors_at(solution, of)
    assert solution.success
    assert absolute[1] <= RTOL * sizes[1] + 1e-12
    assert solution.errors["y"] * (sizes[1] + 1e-12 / RTOL) >= 0.3 * absolute[1]


def shared(n=30, atol=None, units="mg", **options):
    """A chain whose last compartments are as small as 1e-33."""
    rates = {f"x{i}": f"k*x{i - 1} - k*x{i}" if i else "-k*x0" for i in range(n)}
    start = dict.fromkeys(rates, 0) | {"x0": 1}
    units = units and dict.fromkeys(rates, units)
    given = rates, start, {"k": (1, 2)}, (0, 0.5)
    return ro.solve(ro.Problem.from_strings(*given, units=units, atol=atol), RTOL, **options)


@pytest.mark.parametrize("method", [pytest.param("cross", marks=pytest.mark.slow), "train"])
def test_unknowns_of_one_unit_count_relative_to_the_largest(method):
    solution, plain = shared(method=method), shared(units=None, method=method)
    assert solution.success
    assert plain.success
    points = {"t": np.linspace(0.05, 0.5, 10), "k": np.linspace(1, 2, 10)}
    difference = np.abs(solution(**points) - plain(**points))
    assert difference.max() <= 2.0 * RTOL
    assert (difference[15:] <= 1e-12).all()
    assert "do not count" not in plain.message
    assert "`x11` and 18 more below 1.0e-12 do not count" in " ".join(str(solution).split())
    assert solution.errors["x29"] < 1e-3 * plain.errors["x29"]


@pytest.mark.slow
def test_an_atol_of_zero_asks_for_the_size_of_the_unknown_itself():
    solution, plain = shared(atol={"x29": 0}), shared(units=None)
    exact = plain(t=0.5, k=1.5)[29]
    assert solution(t=0.5, k=1.5)[29] == pytest.approx(exact, rel=3 * RTOL)
    assert "17 more" in solution.message
    assert shared(12, units=None, atol={"x3": 0}).success


@pytest.mark.slow
def test_a_limit_names_the_unknowns_that_cost_most():
    refused = shared(100, units=None, effort=0.006)
    assert not refused.success
    assert "`x99`, `x98`" in refused.message
    assert 'give `atol={"x99": 1e-12, …}`' in refused.message
    assert shared(100, effort=0.006).success


@pytest.mark.slow
@pytest.mark.parametrize("given", [{"atol": {"y": 1e-6}}, {"units": {"x": "mg", "y": "mg"}}])
def test_branches_of_events_take_them(given):
    """The check of branches, too, whose orders differ over the box."""
    tiny = "1e-9" if "atol" in given else "1e-20"
    problem = ro.Problem.from_strings(
        {"x": "-k*x", "y": f"-k*y + {tiny}*x"},
        {"x": 1, "y": 0},
        {"k": (1, 2)},
        (0, 1),
        events=[
            {"when": "x - 1/2", "direction": "falling", "then": {"x": "x/2"}, "name": "half"},
            {"when": "t - 9/20", "then": {"x": "x + 1/20"}, "name": "dose"},
        ],
        **given,
    )
    solution = ro.solve(problem, RTOL)
    assert solution.success
    assert len(solution.timeline.branches) > 1
    assert solution.errors["y"] < 1e-3 * RTOL
    assert ("`y` below 1" in solution.message) == ("units" in given)


@pytest.mark.slow
def test_events_take_them():
    of = problem({"y": 1e-6}, events=[ro.Event(x - 0.5, "falling", then={x: x + 0.25})])
    solution = ro.solve(of, rtol=RTOL)
    assert solution.success
    assert solution.errors["y"] <= 2e-9 / (1e-6 / RTOL)


@pytest.mark.slow
def test_files_pickles_and_exports_keep_them(tmp_path):
    compiled = ro.compile(pickle.loads(pickle.dumps(problem({y: 1e-6}))))
    solution = compiled.solve(rtol=RTOL)
    solution.save(tmp_path / "u.npz")
    assert ro.load(tmp_path / "u.npz").metadata.atol == (("y", 1e-6),)
    compiled.export(tmp_path / "solver.py")
    code = f"import solver; s = solver.solve(rtol={RTOL}); print(s.success, s.errors['y'])"
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert run.stdout.split() == ["True", repr(solution.errors["y"])]


def test_outputs_state_the_error_that_atol_lets_in():
    of = problem({y: 1e-6})
    solution = ro.solve(of, rtol=RTOL)
    output = solution.output({"q": y})
    absolute, sizes = errors_at(solution, of)
    assert output.error >= 0.3 * absolute[1] / sizes[1]
    assert solution.diff(k).metadata.atol == ()


def test_they_are_kept_by_problems_that_follow():
    m = sp.Symbol("m")
    equations = [sp.Eq(m * x.diff(t), -k * x), sp.Eq(y.diff(t), -k * y)]
    of = problem({x: 1e-3, y: 0}, equations=equations, constants={m: 1})
    assert of.set(m=2).vary(k=(2, 3)).atol == {"x": 1e-3, "y": 0.0}
    assert "absolute tolerances: x to 0.001" in repr(of)


@pytest.mark.parametrize(
    ("atol", "message"),
    [
        ({k: 1e-6}, "atol has `k`, which is no unknown"),
        ({"yy": 1e-6}, "`yy`, which is no unknown.*did you mean `y`"),
        ({x.diff(t): 1e-6}, "`x_t`, which is no unknown"),
        ({y: -1}, "`y` is -1, which is negative"),
        ({y: "1e-6"}, "not a real number"),
        ({y: np.inf}, "not finite"),
        ({y: 1, "y": 2}, "`y` is given twice"),
        (1e-6, "not a mapping"),
        ({1: 1}, "atol: "),
    ],
)
def test_what_is_refused(atol, message):
    with pytest.raises(ProblemError, match=message):
        problem(atol)
