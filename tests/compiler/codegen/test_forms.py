"""Rate laws of one form as array code, against a line for each state."""

from __future__ import annotations

import os
import subprocess
import sys
from fractions import Fraction

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.compiler.codegen import module, rates
from rankone.compiler.passes.surfaces import MAX_SURFACES
from rankone.problem import text
from rankone.problem.algebra import term_sums
from rankone.support.arrays import MANY_STATES, Deferred
from rankone.trajectories.system.system import pattern_of

N = MANY_STATES
BOX = {"k": (0.5, 1.5), "c": (1.0, 2.0)}
NAMES = "xyzuvw"
LAWS = {
    "saturation": lambda i, n: f"c - k*x{i}/({1 + i % 7}.{i} + x{i})",
    "two substrates": lambda i, n: f"c - x{i}*x{i - 1}/((k + x{i})*(0.{i + 1} + x{i - 1}))",
    "haldane": lambda i, n: f"c - k*x{i}/(0.3{i} + x{i} + x{i}**2/2.{i})",
    "reversible": lambda i, n: f"(c*x{i} - k*x{i - 1})/(1 + x{i}/c + x{i - 1}/0.{i + 1})",
    "hill": lambda i, n: f"k*x{i - 1}**3/(0.4{i}**3 + x{i - 1}**3) - x{i}",
    "hill of any power": lambda i, n: f"x{i - 1}**c/(k**c + x{i - 1}**c) - x{i}",
    "hill of numbers": lambda i, n: (
        f"x{i - 1}**2.{1 + i % 8}/(0.4{i}**2.{1 + i % 8} + x{i - 1}**2.{1 + i % 8})"
        f" - sqrt(2)*x{i}/(sqrt(3) + x{i})"
    ),
    "repression": lambda i, n: f"1/(1 + (x{i - 1}/0.{i + 1})**2.{i + 1}) - x{i}",
    "arrhenius": lambda i, n: f"-exp(-k/(0.3{i}*x{i}))*x{i}",
    "network": lambda i, n: (
        f"tanh({' + '.join(f'0.{i + j}*x{(i + 7 * j) % n}' for j in range(1, 7))}) - k*x{i}"
    ),
    "two layers": lambda i, n: (
        f"tanh({' - '.join(f'tanh(0.{i + j}*x{(i + 5 * j) % n} + c)' for j in range(1, 3))}) - x{i}"
    ),
    "logistic": lambda i, n: f"k/(1 + exp((x{i - 1} - 0.{i + 1})/0.3)) - x{i}",
    "losses at small states": lambda i, n: f"k*x{i - 1}*(1 - exp(-x{i}))*cos(t)",
    "roots": lambda i, n: f"-k*sqrt(x{i - 1} + 0.{i + 1}) + log(1 + x{i}) + atan(x{i}/c)",
}
"""The rate of state i of n."""
WITHOUT_NEIGHBOUR = ("saturation", "haldane", "arrhenius", "network", "two layers")
FEW = 12
"""States where array code is compared with lines, which are slow to write for many."""


def problem_of(rhs, **further):
    initial = {name: f"0.{i + 2}" for i, name in enumerate(rhs)}
    return ro.Problem.from_strings(rhs, initial, BOX, (0, 1), **further)


def laws_of(kind, n=N):
    """The rates of n states; the first, without a neighbour, decays where laws need one."""
    rhs = {f"x{i}": LAWS[kind](i, n) for i in range(n)}
    return rhs if kind in WITHOUT_NEIGHBOUR else rhs | {"x0": "-c*x0"}


def by_lines(rhs, monkeypatch):
    """The same with a line for each state, from expressions."""
    with monkeypatch.context() as patch:
        patch.setattr(text, "FEWEST_TABULATED", 10**6)
        return ro.compile(problem_of(rhs))


def check_same(arrays, lines, rel=1e-12):
    n = len(arrays.separated.states)
    generator = np.random.default_rng(4)
    u, p = generator.uniform(0.1, 1.5, (n, 3, 2)), generator.uniform(1.0, 1.5, (2, 2))
    t = generator.random((3, 1))
    for ours, theirs in [
        (arrays.system.rhs(t, u, p), lines.system.rhs(t, u, p)),
        (arrays.system.jacobian(t, u, p), lines.system.jacobian(t, u, p)),
        (arrays.system.rhs(0.3, u[:, 0, 0], p[:, 0]), lines.system.rhs(0.3, u[:, 0, 0], p[:, 0])),
        (arrays.system.initial(p), lines.system.initial(p)),
    ]:
        assert ours == pytest.approx(theirs, rel=rel, abs=rel * np.abs(theirs).max())


@pytest.mark.slow
@pytest.mark.parametrize("kind", LAWS)
def test_arrays_are_the_lines_to_rounding(kind, monkeypatch):
    for owner in (module, rates):
        monkeypatch.setattr(owner, "MANY_STATES", FEW)
    monkeypatch.setattr(text, "FEWEST_TABULATED", FEW)
    rhs = laws_of(kind, FEW)
    arrays, lines = ro.compile(problem_of(rhs)), by_lines(rhs, monkeypatch)
    assert arrays.problem.table is not None
    assert f"out[{FEW - 1}] = " in lines.source
    assert "STEPS = (" in arrays.source
    check_same(arrays, lines)
    ours, theirs = pattern_of(arrays.system.jacobian), pattern_of(lines.system.jacobian)
    assert np.array_equal(ours.rows, theirs.rows)
    assert np.array_equal(ours.columns, theirs.columns)
    features = arrays.system.features, lines.system.features
    assert len({f.n_peaks + f.n_kinks + f.n_steps for f in features}) == 1


class Texts:
    """Random formulas of six unknowns."""

    def __init__(self, seed):
        self.draw = np.random.default_rng(seed)

    def choice(self, options):
        return options[int(self.draw.integers(len(options)))]

    def leaf(self):
        return self.choice([*NAMES, *NAMES, "k", "c", "t", "2", f"{self.draw.uniform(0.1, 3):.3f}"])

    def formula(self, depth):
        if depth == 0:
            return self.leaf()
        a, b, x = self.formula(depth - 1), self.formula(depth - 1), self.choice(NAMES)
        function = self.choice(["exp", "tanh", "sin", "cosh", "atan", "erf"])
        return self.choice(
            [
                f"({a} + {b})",
                f"({a} - {b})",
                f"{a}*{b}",
                f"{a}/(1.7 + {b}**2)",
                f"({a})**{self.choice([2, 3])}",
                f"(1.5 + {x}**2)**-1",
                f"{function}(-0.3*{a})",
                f"(1.5 + {x}**2)**{self.choice(['k', '0.5', '1.7', '-k'])}",
                f"{a}*{x}**2/({self.choice(['k', '1', '0.7'])} + {x}**2)",
                f"1/(1 + exp({a}))",
                f"(1 - exp(-{a}))*{b}",
                f"exp({x})/(2.5 + exp({x}))",
            ]
        )

    def rates(self):
        depths = (1 + k % 3 for k in range(len(NAMES)))
        return {x: f"0.1*{self.formula(d)} - 0.1*{self.leaf()}" for x, d in zip(NAMES, depths)}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:parameter .* appears nowhere")
def test_random_formulas_are_the_same_as_lines(monkeypatch):
    for owner in (module, rates):
        monkeypatch.setattr(owner, "MANY_STATES", 2)
    monkeypatch.setattr(text, "FEWEST_TABULATED", 2)
    monkeypatch.setattr(term_sums, "_MOST_FORMS", Fraction(100))
    compared = 0
    for seed in range(20):
        rhs = Texts(seed).rates()
        problem = problem_of(rhs)
        if problem.table is not None and problem.table.forms:
            check_same(ro.compile(problem), by_lines(rhs, monkeypatch), rel=1e-10)
            compared += 1
    assert compared > 12


def test_laws_of_one_form_are_printed_once():
    rhs = {f"x{i}": f"c*x{i - 1}/(1.{i + 1} + x{i - 1}) - k*x{i}/(x{i} + 2.5)" for i in range(1, N)}
    compiled = ro.compile(problem_of(rhs | {"x0": "-x0/(1.5 + x0)"}))
    (form,) = compiled.problem.table.forms
    assert compiled.source.count("\ndef form_") == 1
    assert len(form.symbols) == len(form.numbers) == 1
    assert str(form.expression).replace("_", "") == "x0/(c0 + x0)"


def test_powers_of_numbers_stand_in_slots():
    problem = problem_of(laws_of("hill of numbers"))
    assert len(problem.table.forms) == 2
    numbers = {value.numbers[0] for value in problem.table.values if len(value.numbers) == 1}
    assert [float(number) for number in numbers] == pytest.approx([3**0.5], rel=1e-15)


def test_nothing_is_written_out_until_it_is_read(monkeypatch):
    def never(self):
        raise AssertionError("an expression was written")

    monkeypatch.setattr(Deferred, "_items", property(never))
    compiled = ro.compile(problem_of(laws_of("saturation")))
    assert np.isfinite(compiled.system.rhs(0.5, np.ones((N, 1)), np.ones((2, 1)))).all()
    assert repr(compiled).startswith("CompiledProblem of x0, x1")
    assert f"{N} general terms" in repr(compiled)


def test_small_states_keep_their_digits():
    """``1 - exp(-x)`` of a state of 1e-20 is the state, not zero."""
    system = ro.compile(problem_of(laws_of("losses at small states"))).system
    u = np.full(N, 1e-20)
    assert system.rhs(0.0, u, [1.0, 1.5])[5] == pytest.approx(1e-40, rel=1e-14)


def test_slopes_of_saturated_laws_do_not_cancel():
    """The derivative of x/(K + x) far above K is K/x**2, which 1/x - 1/x is not."""
    system = ro.compile(problem_of(laws_of("saturation"))).system
    entries = pattern_of(system.jacobian).entries(0.0, np.full(N, 1e12), [1.0, 1.5])
    assert entries == pytest.approx([-float(f"{1 + i % 7}.{i}") / 1e24 for i in range(N)], rel=1e-9)


def test_states_that_are_named_like_slots(monkeypatch):
    """Parameters may be called like what stands in the text of a form."""
    rhs = {f"s{i}": f"-c*s{i}/(x0 + c0*s{i} + p + 0.{i + 1})" for i in range(N)}
    box = dict.fromkeys(("x0", "c0", "c", "p"), (1.0, 2.0))
    problem = ro.Problem.from_strings(rhs, dict.fromkeys(rhs, 1), box, (0, 1))
    u, (x0, c0, c, p) = np.linspace(0.5, 1.5, N), (1.1, 1.3, 1.7, 1.9)
    numbers = np.array([float(f"0.{i + 1}") for i in range(N)])
    expected = -c * u / (x0 + c0 * u + p + numbers)
    assert problem.table is not None
    assert ro.compile(problem).system.rhs(0.0, u, [x0, c0, c, p]) == pytest.approx(expected, 1e-14)


def test_many_forms_keep_their_lines():
    rhs = {f"x{i}": f"-x{i}/(1 + {'x0*' * (i % 8 + 1)}x{i}**{i % 7 + 1})" for i in range(N)}
    assert problem_of(rhs).table is None


def test_what_is_not_finite_is_said_as_for_few_states():
    rhs = {f"x{i}": f"-x{i}/(1 + x{i}/(k - 1))" for i in range(N)}
    with pytest.raises(ro.ProblemError, match=r"not finite at k = 1"):
        ro.compile(problem_of(rhs))


def test_general_terms_are_those_of_expressions():
    compiled = ro.compile(problem_of(laws_of("arrhenius")))
    term = compiled.separated.general[3]
    t = sp.Symbol("t")
    assert term.expression.has(sp.Function("x3")(t))
    assert "is not polynomial in `x3(t)`" in term.reason
    with pytest.raises(ro.SeparationError):
        compiled.separated.require_separated()


def printed():
    """Source with array code of two kinds of laws."""
    return "".join(ro.compile(problem_of(laws_of(k))).source for k in ("network", "reversible"))


@pytest.mark.slow
def test_the_same_bytes_under_another_hash_seed():
    seed = "1" if os.environ.get("PYTHONHASHSEED") != "1" else "4711"
    there = subprocess.run(
        [
            sys.executable,
            "-c",
            "from tests.compiler.codegen.test_forms import *; print(printed(), end='')",
        ],
        env={"PYTHONHASHSEED": seed, "PYTHONPATH": "src:."},
        capture_output=True,
        text=True,
        check=True,
    )
    assert "def slopes_of_form_0" in there.stdout
    assert there.stdout == printed()


def vanishing(surfaces, function, value):
    """Those of functions that vanish where another one has a value."""
    return [s for s in surfaces if s.has(function) and s.subs(function, value) == 0]


@pytest.mark.parametrize(
    "narrow",
    [
        "exp(-((x0 - 0.7)/1e-6)**2 - 0.1*x2 - 0.1*x3 - 0.1*x4)",
        "1/(1e-9 + (x0 - 0.7)**2 + x2*x3 + x4*x5 + x6*x7)",
        "1/(1 + exp(1e6*((x0 - 0.7)*(1 + x2*x3 + x4 + x5 + x6))))",
    ],
)
def test_narrow_laws_with_long_sums_have_surfaces(narrow):
    problem = problem_of(laws_of("saturation") | {"x1": narrow})
    assert problem.table.forms
    features = ro.compile(problem).features
    x0 = problem.unknowns[0]
    assert len(vanishing([*features.peaks, *features.steps], x0, sp.Rational(7, 10))) == 1


@pytest.mark.slow
@pytest.mark.parametrize("place", [10, N + 10])
def test_of_many_surfaces_the_sharpest_are_kept(place, monkeypatch):
    widths = ["1e-6" if i == place else f"1.{i}" for i in range(N + 20)]
    rhs = {f"x{i}": f"exp(-((y - 0.{i + 101})/{w})**2) - x{i}" for i, w in enumerate(widths)}
    problem = problem_of(rhs | {"y": "k"})
    assert problem.table.forms
    y, value = problem.unknowns[-1], sp.Rational(f"0.{place + 101}")
    for compiled in (ro.compile(problem), by_lines(rhs | {"y": "k"}, monkeypatch)):
        assert len(compiled.features.peaks) == MAX_SURFACES
        assert vanishing(compiled.features.peaks, y, value)


@pytest.mark.parametrize("law", ["tanh(0*x1)", "exp(x3 - x3)", "tanh(0*x1 + 0*x2 + 0*x3 + 0*x4)"])
def test_laws_without_unknowns_are_numbers(law):
    compiled = ro.compile(problem_of(laws_of("saturation") | {"x5": f"k*{law} - x5"}))
    u, p = np.full(N, 0.5), np.array([0.7, 1.2])
    constant = 0.7 if "exp" in law else 0.0
    assert compiled.system.rhs(0.0, u, p)[5] == pytest.approx(constant - 0.5, abs=1e-15)
    assert compiled.system.jacobian(0.0, u, p)[5, 5] == pytest.approx(-1.0)
