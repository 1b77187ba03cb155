"""Lifted systems: few further unknowns, exact equations, the same solutions as sampling finds."""

import subprocess
import sys

import numpy as np
import pytest
import scipy.integrate
import sympy as sp

import rankone as ro
from rankone.compiler.passes.lifting import NotLiftable, lift
from rankone.solvers.request import Domain
from rankone.solvers.selection import ENGINES
from rankone.solvers.verification.measure import drift
from tests.reference.quadratization import PROBLEMS

AROUND = (0.7, 1.3)
SYSTEMS = {  # rates, initial values, box, end, further unknowns
    "pendulum": (
        {"th": "w", "w": "-g*sin(th) - c*w"},
        {"th": "th0", "w": "0"},
        {"g": (9, 10), "c": (0.1, 0.3), "th0": (0.5, 1.2)},
        3,
        2,
    ),
    "Michaelis-Menten": (
        {"s": "-V*s/(K + s)"},
        {"s": "s0"},
        {"V": AROUND, "K": AROUND, "s0": AROUND},
        3,
        1,
    ),
    "x/(c + x)": ({"x": "x/(c + x)"}, {"x": "x0"}, {"c": AROUND, "x0": AROUND}, 3, 1),
    "Hill, n = 4": (
        {"x": "x**4/(K**4 + x**4) - x"},
        {"x": "x0"},
        {"K": AROUND, "x0": AROUND},
        3,
        1,
    ),
    "Hill, n free": (
        {"x": "a*K**n/(K**n + x**n) - x"},
        {"x": "0.5"},
        {"K": AROUND, "n": (2, 4), "a": AROUND},
        3,
        2,
    ),
    "reactor": (
        {"c": "-c*k0*exp(-E/T)", "T": "H*c*k0*exp(-E/T) - 0.5*(T - 1)"},
        {"c": "1", "T": "1"},
        {"k0": (5, 8), "E": (2, 3), "H": (0.2, 0.4)},
        3,
        2,
    ),
    "x log x": (
        {"x": "-r*x*log(x/c)"},
        {"x": "x0"},
        {"r": (0.5, 1), "c": (1, 2), "x0": (0.2, 0.5)},
        3,
        2,
    ),
    "Kepler": (
        {"x": "u", "y": "v", "u": "-x/(x**2 + y**2)**(3/2)", "v": "-y/(x**2 + y**2)**(3/2)"},
        {"x": "1 - e", "y": "0", "u": "0", "v": "sqrt((1 + e)/(1 - e))"},
        {"e": (0, 0.3)},
        6,
        1,
    ),
    "cos(w*t)": ({"x": "v", "v": "-x + cos(w*t)"}, {"x": "1", "v": "0"}, {"w": (1.5, 2.5)}, 6, 2),
    "exp(-k*t)": ({"x": "-x + exp(-k*t)"}, {"x": "1"}, {"k": (1, 3)}, 3, 1),
    "sqrt": ({"x": "sqrt(1 + v**2)", "v": "-x"}, {"x": "1", "v": "a"}, {"a": (0, 1)}, 3, 1),
    "x**p": ({"x": "-x**p"}, {"x": "1"}, {"p": (1.2, 1.8)}, 3, 2),
    "logistic": ({"x": "1/(1 + exp(-(x - k)/0.2)) - x"}, {"x": "1"}, {"k": (0.5, 1)}, 3, 1),
    "tanh": ({"x": "-x + tanh(a*x + b)"}, {"x": "1"}, {"a": (0.5, 1), "b": (0, 1)}, 3, 1),
    "atan": ({"x": "-atan(a*x) + b"}, {"x": "1"}, {"a": (0.5, 2), "b": (0, 1)}, 3, 2),
    "erf": ({"x": "-erf(a*x)"}, {"x": "1"}, {"a": (0.5, 2)}, 3, 2),
    "coupled coefficient": (
        {"x": "-x/(k1 + k2)"},
        {"x": "sqrt(k1**2 + k2**2)"},
        {"k1": (0.5, 1), "k2": (0.5, 1)},
        3,
        1,
    ),
    "phase": ({"x": "-x + sin(w*t + phi)"}, {"x": "1"}, {"w": (0.5, 1), "phi": (0, 1)}, 3, 2),
    "nested": ({"x": "-exp(sin(a*x))*x"}, {"x": "1"}, {"a": (0.5, 1)}, 2, 3),
    "late start": ({"x": "-x + exp(-k*t)*cos(k*t)"}, {"x": "1"}, {"k": (1, 2)}, (1, 3), 3),
}
TIGHT = ("pendulum", "reactor", "Kepler", "cos(w*t)", "exp(-k*t)")


def compiled(name):
    rates, initial, box, end, _ = SYSTEMS[name]
    horizon = end if isinstance(end, tuple) else (0, end)
    return ro.compile(ro.Problem.from_strings(rates, initial, box, horizon))


def points(problem, count):
    generator = np.random.default_rng(5)
    box = np.array(list(problem.parameters.values()))
    return box[:, :1] + np.diff(box) * generator.random((len(box), count))


@pytest.mark.parametrize("name", SYSTEMS)
def test_few_unknowns_and_exact_equations(name):
    """Along trajectories of the lifted system, further unknowns are what they stand for."""
    problem = compiled(name)
    lifting = problem.lifted.lifting
    assert lifting.count <= SYSTEMS[name][-1]
    system, n = problem.lifted.system, len(problem.first_order.states)
    t = problem.first_order.coordinates[0]
    names = list(problem.problem.parameters)
    states = problem.first_order.functions
    plain = [sp.Symbol(f"u{i}") for i in range(n)]
    meanings = sp.lambdify(
        [t.symbol, plain, names],
        [m.xreplace(dict(zip(states, plain, strict=True))) for m in lifting.meanings],
        ["numpy", "scipy"],
    )
    for p in points(problem.problem, 3).T:
        start = system.initial(p[:, None])[:, 0]
        assert start[:n] == pytest.approx(problem.system.initial(p), rel=1e-12, abs=1e-14)
        found = scipy.integrate.solve_ivp(
            lambda now, u, p=p: system.rhs(now, u, p),
            (t.lower, t.upper),
            start,
            rtol=1e-10,
            atol=1e-12,
        )
        for now, u in zip(found.t[::5], found.y.T[::5], strict=True):
            assert u[n:] == pytest.approx(np.array(meanings(now, u[:n], p)), rel=1e-6, abs=1e-8)


@pytest.mark.parametrize("name", SYSTEMS)
def test_train_agrees_with_cross(name):
    problem = compiled(name)
    rtol = 1e-6 if name in TIGHT else 1e-4
    lifted = problem.solve(rtol, method="train")
    sampled = problem.solve(rtol, method="cross")
    assert lifted.success, lifted.message
    assert lifted.states == sampled.states
    p = dict(zip(lifted.parameters, points(problem.problem, 60)[:, :, None], strict=True))
    times = np.linspace(*lifted.time, 9)
    one, two = lifted(t=times, **p), sampled(t=times, **p)
    size = np.abs(two).max(axis=(1, 2))
    assert np.all(np.abs(one - two).max(axis=(1, 2)) <= 1.2 * (lifted.error + sampled.error) * size)


@pytest.mark.parametrize(
    "name",
    [
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("pendulum", "Michaelis-Menten")),
        "cos(w*t)",
    ],
)
def test_greedy_solves_lifted_systems(name):
    problem = compiled(name)
    rtol = 1e-2 if name == "pendulum" else 1e-3
    solution = problem.solve(rtol, method="greedy")
    assert solution.success, solution.message
    exact = problem.solve(0.01 * rtol)
    p = dict(zip(solution.parameters, points(problem.problem, 60)[:, :, None], strict=True))
    times = np.linspace(*solution.time, 9)
    one, two = solution(t=times, **p), exact(t=times, **p)
    size = np.abs(two).max(axis=(1, 2))
    assert np.all(np.abs(one - two).max(axis=(1, 2)) <= rtol * size)


@pytest.mark.parametrize(
    ("rate", "part"),
    [
        ("-k*x*abs(x)", "Abs(x(t))"),
        ("-k*Max(x, 1)", "Max(1, x(t))"),
        ("-k*sin(abs(x))", "Abs(x(t))"),
        ("-k*floor(x)", "floor(x(t))"),
        ("-gamma(x + k)", "gamma(k + x(t))"),
    ],
)
def test_what_cannot_be_lifted_is_named(rate, part):
    problem = ro.compile(ro.Problem.from_strings({"x": rate}, {"x": "2"}, {"k": (1, 2)}, (0, 1)))
    assert problem.lifted is None
    with pytest.raises(NotLiftable) as caught:
        lift(problem.first_order)
    assert str(caught.value) == part
    with pytest.raises(ro.SeparationError, match="has no lifted form; remedy: method='cross'"):
        problem.solve(method="train")


def test_names_do_not_collide():
    rates = {"x": "-s*sin(x) - c*cos(x)", "s2": "-s2*exp(x)"}
    problem = ro.Problem.from_strings(
        rates, {"x": "1", "s2": "1"}, {"s": (1, 2), "c": (1, 2)}, (0, 1)
    )
    lifted = ro.compile(problem).lifted
    names = [state.name for state in lifted.lifting.system.states]
    assert len(set(names) | {"s", "c"}) == len(names) + 2


def test_the_map_is_printed():
    text = str(compiled("Michaelis-Menten").lifted)
    assert text == (
        "Lifted: 1 further unknown\n  r = 1/(K + s): dr/dt = -K*V*r**3 + V*r**2, from 1/(K + s0)"
    )


def test_an_invariant_is_listed():
    lifting = compiled("pendulum").lifted.lifting
    assert [str(i) for i in lifting.invariants] == ["c2(t)**2 + s(t)**2 - 1"]


@pytest.mark.slow
def test_the_exported_solver_has_the_lifted_form(tmp_path):
    path = compiled("Michaelis-Menten").export(tmp_path / "solver.py", method="train")
    done = subprocess.run(
        [sys.executable, "-I", str(path), "--rtol", "1e-4"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "within the tolerance" in done.stdout


def test_lifted_states_are_followed_along_the_solve(tmp_path):
    """Sine and cosine stay those of the angle, and a solution says how well."""
    solution = compiled("pendulum").solve(1e-6, method="train")
    assert 0.0 < solution.outcome.measured.drift < 1e-5
    assert "lifted states drift by" in " ".join(repr(solution).split())
    assert ro.load(solution.save(tmp_path / "u.npz")).outcome.measured == solution.outcome.measured
    assert compiled("pendulum").solve(1e-4).outcome.measured.drift is None


def test_a_drift_is_seen():
    """Lifted states that are not what they stand for."""
    pendulum = compiled("pendulum")
    system, domain = pendulum.lifted.system, Domain.of(pendulum.lifted.system)
    slabs = ENGINES["train"].run(system, 1e-4).slabs
    assert drift(system, domain, slabs) < 1e-3
    first = slabs[0].cores[0].copy()
    first[-1] *= 1.01
    worse = [slabs[0].with_first(first), *slabs[1:]]
    assert 5e-3 < drift(system, domain, worse) < 2e-2


@pytest.mark.parametrize("name", PROBLEMS)
def test_few_unknowns_beside_an_optimal_quadratisation(name):
    rates, others = PROBLEMS[name]
    problem = ro.compile(ro.Problem.from_strings(rates, dict.fromkeys(rates, 1), {}, (0, 1)))
    quadratic = problem.quadratic or problem.lifted.quadratic
    lifted = problem.lifted.lifting.count if problem.lifted else 0
    beyond = 3 if name == "combustion A1, T a state" else 2
    assert lifted + len(quadratic.products) <= others + beyond
