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


@pytest.mark.slow
def test_events_take_them():
    of = problem({"y": 1e-6}, events=[ro.Event(x - 0.5, "falling", then={x: x + 0.25})])
    solution = ro.solve(of, rtol=RTOL)
    assert solution.success
    assert solution.errors["y"] <= 2e-9 / (1e-6 / RTOL)


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
    assert of.set(m=2).vary(k=(2, 3)).atol == {"x": 1e-3}
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
