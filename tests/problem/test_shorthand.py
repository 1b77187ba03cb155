"""Constants and definitions: what they stand for, how they change, and what is refused."""

import itertools
import pickle

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.problem.expressions.notation import NamedConstant
from rankone.share.commands.common import load_problem
from rankone.support.errors import OptionError, ProblemError

t, k, c, m, F, P, g = sp.symbols("t k c m F P g")
x, v = sp.Function("x")(t), sp.Function("v")(t)
G = sp.Function("G")(t)
THIRD = sp.Rational(1, 3)
TIMES = np.linspace(0.0, 2.0, 7)


def oscillator(**changes):
    arguments = {
        "equations": [sp.Eq(x.diff(t), v), sp.Eq(m * v.diff(t), -F)],
        "time": (t, 0, 2),
        "parameters": {k: (1, 2)},
        "initial": {x: 1, v: P / m},
        "constants": {m: 3.0, c: THIRD},
        "definitions": {F: k * x + P * v / m, P: c * m},
    }
    return ro.Problem(**{**arguments, **changes})


def by_hand(mass=3, damping=THIRD, **changes):
    arguments = {
        "equations": [sp.Eq(x.diff(t), v), sp.Eq(mass * v.diff(t), -k * x - damping * v)],
        "time": (t, 0, 2),
        "parameters": {k: (1, 2)},
        "initial": {x: 1, v: damping},
    }
    return ro.Problem(**{**arguments, **changes})


def rates(problem):
    """Right-hand sides and initial values with numbers for constants."""
    system = ro.first_order(problem)
    expressions = sp.Tuple(*system.rhs, *system.initial)
    return expressions.xreplace({a: a.value for a in expressions.atoms(NamedConstant)})


def test_they_are_put_in():
    assert rates(oscillator()) == rates(by_hand())


def test_repr_shows_them_as_written():
    lines = repr(oscillator(units={F: "N", m: "kg"})).splitlines()
    assert lines[1:5] == ["  F = P*v/m + k*x", "  P = c*m", "  dx/dt = v", "  dv/dt*m = -F"]
    assert lines[-1] == "  m = 3 kg, c = 1/3"
    assert r"F &= \frac{P v}{m} + k x" in oscillator()._repr_latex_()


def test_a_definition_may_be_differentiated():
    problem = ro.Problem(
        [sp.Eq(x.diff(t), -G - G.diff(t) / 2)],
        (t, 0, 1),
        {k: (1, 2)},
        {x: 1},
        definitions={G: k * x},
    )
    exact = np.exp(-1.5 / (1 + 0.75) * 0.8)  # (1 + k/2) x' = -k x
    assert problem.trajectory(0.8, k=1.5)[x] == pytest.approx(exact, rel=1e-7)


def test_text_toml_and_sympy_agree(tmp_path):
    rhs, initial = {"x": "v", "v": "-F/m"}, {"x": 1, "v": "P/m"}
    shorthand = {"m": 3, "c": "1/3"}, {"F": "k*x + P*v/m", "P": "c*m"}
    text = ro.Problem.from_strings(
        rhs, initial, {"k": (1, 2)}, (0, 2), constants=shorthand[0], definitions=shorthand[1]
    )
    file = tmp_path / "model.toml"
    file.write_text(
        'time = [0, 2]\n[rhs]\nx = "v"\nv = "-F/m"\n[initial]\nx = 1\nv = "P/m"\n'
        '[parameters]\nk = [1, 2]\n[constants]\nm = 3\nc = "1/3"\n'
        '[definitions]\nF = "k*x + P*v/m"\nP = "c*m"\n'
    )
    for problem in (text, load_problem(file)):
        assert rates(problem) == rates(by_hand())
        assert problem.constants == {m: 3, c: THIRD}


def test_set_and_vary_make_new_problems():
    problem = oscillator(units={m: "kg"})
    heavier = problem.set(m=4, c=0.5)
    assert rates(heavier) == rates(by_hand(4, sp.Rational(1, 2)))
    assert problem.constants[m] == 3
    assert heavier.units == {"m": "kg"}
    assert problem.set({k: 1.5}).constants == {m: 3, c: THIRD, k: sp.Rational(3, 2)}
    free = problem.set(k=2).vary({c: (0.1, 0.5)})
    assert free.parameters == {c: (0.1, 0.5)}
    assert free.constants == {m: 3, k: 2}
    assert problem.vary(k=(1, 3, "log")).distributions == {"k": "loguniform(1.0, 3.0)"}


def test_a_constant_in_text_is_no_formula_of_others():
    with pytest.raises(
        ProblemError, match=r"`k` in the constant `a`.*give a formula .*`definitions`"
    ):
        ro.Problem.from_strings(
            {"x": "-a*x"}, {"x": 1}, {"k": (1, 2)}, (0, 1), constants={"a": "2*k"}
        )


def test_pickles():
    problem = pickle.loads(pickle.dumps(oscillator(units={F: "N"})))
    assert repr(problem) == repr(oscillator(units={F: "N"}))
    assert repr(problem.set(m=2)) == repr(oscillator(units={F: "N"}).set(m=2))


def test_jumps_and_events_take_them():
    dose, lag = sp.symbols("dose lag")
    problem = ro.Problem(
        [sp.Eq(x.diff(t), -k * x)],
        (t, 0, 2),
        {k: (1, 2)},
        {x: 0},
        jumps={(lag, 2 * lag): {x: x + P}},
        events=[ro.Event(t - 3 * lag, then={x: x + dose}, name="third")],
        constants={dose: 2, lag: 0.5},
        definitions={P: dose / 2},
    )
    assert list(problem.jumps) == [0.5, 1.0]
    ages = np.array([1.25, 0.75, 0.25])
    exact = np.array([1.0, 1.0, 2.0]) @ np.exp(-1.5 * ages)
    assert problem.trajectory(1.75, k=1.5)[x] == pytest.approx(exact, rel=1e-6)
    moved = problem.vary(lag=(0.4, 0.6))
    assert [event.name for event in moved.events] == ["third", "jump_0", "jump_1"]


def test_outputs_by_name(tmp_path):
    problem = oscillator(units={F: "N"})
    solution = ro.solve(problem, rtol=1e-6)
    at = {"t": TIMES, "k": 1.4}
    position, speed = solution(**at)
    force = 1.4 * position + speed / 3
    output = solution.output("F")
    assert output[F](**at) == pytest.approx(force, abs=1e-5)
    assert dict(output.metadata.units)["F"] == "N"
    power = solution.output({"power": F * v / m, "same": "F*v/m"})
    assert power(**at) == pytest.approx(np.array([force * speed / 3] * 2), abs=1e-5)
    solution.save(tmp_path / "u.npz")
    held = ro.load(tmp_path / "u.npz").fix(k=1.4).output(["P", "F"])
    assert held(t=TIMES) == pytest.approx(np.stack([np.ones(7), force]), abs=1e-5)
    with pytest.raises(OptionError, match="unknown name `F`"):
        solution.diff(k).output("F")
    with pytest.raises(OptionError, match=r"unknown name `G` .*`F` and `P`"):
        solution.output("G")


def test_the_horizon_and_the_box_still_move():
    compiled = ro.compile(oscillator())
    solution = compiled.solve(rtol=1e-6, parameters={"k": (3, 4)}, t_final=1.0)
    reference = by_hand(parameters={k: (3, 4)}).trajectory(1.0, k=3.5)
    assert solution(t=1.0, k=3.5) == pytest.approx(reference.values, abs=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"constants": {m: (1, 2)}}, r"constant `m` is \(1, 2\), not a real number"),
        ({"constants": {m: 2 * c}}, "constant `m` is `2\\*c`, not a number.*`definitions`"),
        ({"constants": {"m": 2}}, "constant 'm' is not a SymPy symbol"),
        ({"constants": {m: np.nan}}, "constant `m` is nan, not finite"),
        ({"constants": {m: 3, c: 1, t: 1}}, "both the time and a constant"),
        ({"constants": {m: 3, c: 1, k: 1}}, "`k` is both a parameter and a constant"),
        ({"constants": {m: 3, c: 1, F: 1}}, "`F`"),
        ({"constants": [m]}, "not a mapping"),
        ({"constants": {c: 1}}, "unknown symbol `m`.*`constants`"),
        ({"constants": {sp.Symbol("m", positive=True): 3, c: 1}}, "has other assumptions"),
        (
            {"constants": {sp.Symbol("m", positive=True): -3, c: 1}},
            "-3 of constant `m` contradicts",
        ),
        ({"definitions": {F: k * x, P: F, g: P, c: 1}}, "`c`"),
        (
            {"definitions": {F: P + x, P: 2 * g, g: F / 2}},
            "go in a circle: `F` needs `P`, `P` needs",
        ),
        ({"definitions": {F: F + 1, P: 1}}, "go in a circle: `F` needs `F`"),
        ({"definitions": {F: "k*x", P: 1}}, "'k\\*x', not an expression.*from_strings"),
        ({"definitions": {"F": k * x}}, "'F' cannot be defined"),
        ({"definitions": {x.diff(t): k}}, "cannot be defined"),
        ({"definitions": {F: k * x, P: 1, v: x}}, "both a definition and an initial value"),
        ({"definitions": {F: sp.Symbol("kk") * x, P: 1}}, "unknown symbol `kk`"),
        ({"initial": {x: 1, v: F}}, "names the unknown"),
        ({"units": {"Q": "N"}}, "neither time nor a parameter nor an unknown"),
        ({"definitions": {F: k * x / c, P: 1}, "constants": {m: 3, c: 0}}, "2: .* is not finite"),
        ({"initial": {x: 1, v: 1 / (m - 3)}}, "is not a finite real number"),
    ],
)
def test_what_is_refused(changes, message):
    with pytest.raises(ProblemError, match=message):
        oscillator(**changes)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: p.set(mm=2), "no constant or parameter `mm` \\(did you mean `m`"),
        (lambda p: p.set(F=2), "`F` is a definition"),
        (lambda p: ro.compile(p.set(m=1e-310)), "is not a finite real number; remedy: rescale"),
        (lambda p: p.set({x: 2}), "`x` is a state, neither"),
        (lambda p: p.set({m: 2}, m=3), "`m` is given twice"),
        (lambda p: p.set(3), "not a mapping"),
        (lambda p: p.set({3: 3}), "not a name"),
        (lambda p: p.set(m="a"), "not a real number"),
        (lambda p: p.vary(m=2), "not a pair"),
        (lambda p: p.vary(c=(0, 1), correlation=(0, 1)), "no constant or parameter `correlation`"),
        (lambda p: p.vary(c=(0, 1)).vary(m=(1, 2)).set(k=1, q=2), "no constant or parameter `q`"),
    ],
)
def test_changes_that_are_refused(change, message):
    with pytest.raises(ProblemError, match=message):
        change(oscillator())


def test_a_correlated_parameter_is_not_fixed():
    problem = oscillator(
        parameters={k: (1, 2), c: (0.1, 0.2)}, constants={m: 3}, correlation={(k, c): 0.5}
    )
    with pytest.raises(ProblemError, match="`k` is correlated"):
        problem.set(k=1)
    assert problem.set(m=2).correlation == {("k", "c"): 0.5}


def test_long_chains_of_definitions_are_refused():
    symbols = sp.symbols("d0:40")
    chain = {b: a * (a + 1) for a, b in itertools.pairwise(symbols)}
    with pytest.raises(ProblemError, match="operations when the others are put in"):
        ro.Problem(
            [sp.Eq(x.diff(t), symbols[-1])],
            (t, 0, 1),
            {k: (1, 2)},
            {x: k},
            definitions={symbols[0]: x, **chain},
        )
