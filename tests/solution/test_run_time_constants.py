"""Constants of compiled problems: run-time values where they enter smoothly, right everywhere."""

import pickle
import subprocess
import sys

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.compiler import stages as pipeline

t, k, c, d = sp.symbols("t k c d")
x, y = sp.Function("x")(t), sp.Function("y")(t)
dx = x.diff(t)
FIRST, SECOND = {c: 1.3, d: 0.7}, {c: 0.9, d: 1.1}
TIMES = np.linspace(0.0, 1.5, 7)
PULSES = ro.table([0, 0.5, 1, 2], [0, 1, 0.5, 2])


def problem(numbers, equations, initial, **further):
    return ro.Problem(equations, (t, 0, 1.5), {k: (1, 2)}, initial, constants=numbers, **further)


def written_out(equations, initial):
    """The same with the second numbers written into the equations by SymPy."""
    return ro.Problem(
        [equation.subs(SECOND) for equation in equations],
        (t, 0, 1.5),
        {k: (1, 2)},
        {state: sp.sympify(start).subs(SECOND) for state, start in initial.items()},
    )


SMOOTH = {
    "saturation": ([sp.Eq(dx, -c * x / (d + x) * k)], {x: 1}),
    "decaying input": ([sp.Eq(dx, -k * x + c * sp.exp(-d * t))], {x: 1}),
    "Torricelli": ([sp.Eq(dx, -k * sp.sqrt(2 * c * x) + d)], {x: 2}),
    "Boltzmann": ([sp.Eq(dx, -k * x + 1 / (1 + sp.exp(-(x - c) / d)))], {x: 1}),
    "initial value": ([sp.Eq(dx, -d * x * 2**c)], {x: sp.sqrt(c * k)}),
    "second order": (
        [sp.Eq(c * x.diff(t, 2) + d * dx + k * x, sp.cos(c * t + d))],
        {x: 1, dx: c / d},
    ),
}
WRITTEN_IN = {
    "exponent": ([sp.Eq(dx, -k * x**c + d)], {x: 1.5}, "c"),
    "switch": ([sp.Eq(dx, -k * x + d * sp.Heaviside(t - c))], {x: 1}, "c"),
    "largest": ([sp.Eq(dx, -k * sp.Max(c, x) + d)], {x: 1}, "c"),
    "comparison": ([sp.Eq(dx, sp.Piecewise((-k * x, c > d), (-k * d * x, True)))], {x: 1}, "cd"),
    "difference": ([sp.Eq(dx, -k * x * sp.sqrt((c - d) ** 2))], {x: 2}, "cd"),
    "ratio in a step": ([sp.Eq(dx, -k * x + 1 / (1 + c * sp.exp(-x / d)))], {x: 1}, "cd"),
    "peak": ([sp.Eq(dx, -k * x + sp.exp(-(((t - c) / d) ** 2)))], {x: 1.5}, "cd"),
    "table": ([sp.Eq(dx, -k * x + d * PULSES(c * t))], {x: 1.5}, "c"),
    "impulse": ([sp.Eq(dx, -k * x + d * sp.DiracDelta(t - c))], {x: 1}, "c"),
    "mass matrix": (
        [sp.Eq(c * dx + y.diff(t), -k * x), sp.Eq(dx + (c + 3 * d) * y.diff(t), -y)],
        {x: 1, y: d},
        "cd",
    ),
}


def assert_right(changed, equations, initial):
    """The generated functions are those of the numbers written out."""
    compiled, reference = ro.compile(changed), ro.compile(written_out(equations, initial))
    rng = np.random.default_rng(7)
    p, u = rng.uniform(1, 2, (1, 9)), rng.uniform(0.5, 2, (compiled.system.n_differential, 9))
    for at in (0.2, 1.0, 1.4):
        expected = reference.system.rhs(at, u, p)
        assert compiled.system.rhs(at, u, p) == pytest.approx(expected, rel=1e-12, abs=1e-12)
    assert compiled.system.initial(p) == pytest.approx(reference.system.initial(p), rel=1e-12)
    ends = [p.trajectory(1.5, k=1.7).values for p in (changed, reference.problem)]
    assert ends[0] == pytest.approx(ends[1], abs=1e-6)
    return compiled


@pytest.mark.parametrize("name", SMOOTH)
def test_smooth_ones_need_no_second_compilation(name, monkeypatch):
    equations, initial = SMOOTH[name]
    first = problem(FIRST, equations, initial)
    ro.compile(first)
    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "symbolic_forms", None)
        patch.setattr(pipeline, "generated_module", None)
        changed = ro.compile(first.set(SECOND)).problem
    assert "separation" not in assert_right(changed, equations, initial).timings


@pytest.mark.parametrize("name", WRITTEN_IN)
def test_others_are_written_in(name):
    equations, initial, names = WRITTEN_IN[name]
    first = problem(FIRST, equations, initial)
    assert {symbol.name for symbol in first.shorthand.decisive} == {*names}
    ro.compile(first)
    assert "separation" in assert_right(first.set(SECOND), equations, initial).timings


@pytest.mark.slow
def test_the_train_and_exports_take_them(tmp_path):
    equations, initial = SMOOTH["second order"]
    first = problem(FIRST, equations, initial)
    ro.compile(first)
    compiled = ro.compile(first.set(SECOND))
    assert compiled.timings.keys() == {"constants", "agreement"}
    reference = written_out(equations, initial).trajectory(1.5, k=1.7).values
    at = {"t": 1.5, "k": 1.7}
    train = compiled.solve(rtol=1e-6, method="train")
    assert train.success
    assert train(**at) == pytest.approx(reference, abs=2e-6)
    assert train.metadata.equations[-2:] == ("c = 0.9", "d = 1.1")
    again = pickle.loads(pickle.dumps(compiled)).solve(rtol=1e-6, method="train")
    assert np.array_equal(again(**at), train(**at))
    compiled.export(tmp_path / "solver.py", method="train")
    code = "import solver; print(*solver.solve(rtol=1e-6)(t=1.5, k=1.7))"
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert [*map(float, run.stdout.split())] == pytest.approx(reference, abs=2e-6)


def test_jumps_and_events_take_them():
    further = {
        "jumps": {0.5: {x: c * x + d}},
        "events": [ro.Event(x - d / 2, "falling", then={x: c + 1}, name="low")],
    }
    first = problem(FIRST, [sp.Eq(dx, -k * x)], {x: 2}, **further)
    ro.compile(first)
    compiled = ro.compile(first.set(SECOND))
    assert "constants" in compiled.timings
    solution = compiled.solve(rtol=1e-6)
    before = 2 * np.exp(-1.7 * 0.5) * 0.9 + 1.1
    low = 0.5 + np.log(before / 0.55) / 1.7
    assert solution.event_times("low", k=1.7)[0] == pytest.approx(low, rel=1e-5)
    assert solution[x](t=1.5, k=1.7) == pytest.approx(1.9 * np.exp(-1.7 * (1.5 - low)), rel=1e-5)


@pytest.mark.parametrize("number", [-1.3, 0.0])
def test_another_sign_is_another_compilation(number):
    equation = sp.Eq(dx, -k * (1 + sp.sqrt(c**2)) * x + c)
    first = problem({c: 1.3}, [equation], {x: 1})
    ro.compile(first)
    changed = ro.compile(first.set(c=number))
    assert "constants" not in changed.timings
    solution = changed.solve(rtol=1e-6)
    rate = 1.7 * (1 + abs(number))
    exact = number / rate + (1 - number / rate) * np.exp(-rate)
    assert solution[x](t=1.0, k=1.7) == pytest.approx(exact, abs=1e-5)


def test_a_pole_that_moves_into_the_box_is_refused_as_when_compiled():
    first = problem({c: 5.0}, [sp.Eq(dx, -x / (c - k))], {x: 1})
    assert first.shorthand.named
    ro.compile(first)
    with pytest.raises(ro.RankoneError, match=r"1\.5"):
        ro.compile(first.set(c=1.5))


def test_names_that_generated_code_uses():
    names = sp.symbols("CONSTANTS p u np shape")
    table, p, u, np_, shape = names
    unknown = sp.Function("TERMS")(t)
    equation = sp.Eq(unknown.diff(t), -table * k * unknown * p / (u + shape) + np_)
    numbers = dict(zip(names, (2.0, 0.5, 0.75, 0.5, 0.25), strict=True))
    solution = ro.solve(
        ro.Problem([equation], (t, 0, 1), {k: (1, 2)}, {unknown: 1}, constants=numbers)
    )
    assert solution(t=1.0, k=1.5)[0] == pytest.approx(1 / 3 + 2 / 3 * np.exp(-1.5), rel=1e-5)
