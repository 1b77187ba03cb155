"""Problems that write themselves to TOML, equations in text, and when two problems are equal."""

import pickle

import numpy as np
import pytest
import sympy as sp
from scipy import stats

import rankone as ro
from rankone.share.commands.common import load_problem
from rankone.support.errors import ProblemError

t, k, c, m, w, F, lag = sp.symbols("t k c m w F lag")
x, y = sp.Function("x")(t), sp.Function("y")(t)
BOX = {k: (1, 2)}


def oscillator(**changes):
    push = sp.Piecewise((F, t < 1), (0, True))
    arguments = {
        "equations": [sp.Eq(m * x.diff(t, 2) + c * x.diff(t) + k * x, push)],
        "time": (t, 0, 4),
        "parameters": {**BOX, c: stats.norm(0.2, 0.02)},
        "initial": {x: 1, x.diff(t): k / 3},
        "constants": {m: 3, w: 0.1},
        "definitions": {F: sp.cos(w * t) * sp.sqrt(k)},
        "units": {x: "m", F: "N"},
        "atol": {x: 1e-6},
        "name": 'a "spring"',
        "tail": 1e-4,
    }
    return ro.Problem(**{**arguments, **changes})


def switched():
    events = [
        ro.Event(x - 0.5, "falling", then={x: x + 1}, name="up"),
        ro.Event(y - 3, terminal=True, delay=0.1, overlapping=False),
        ro.Event(x - 3, "rising", persistent=False, then={x: 0}, priority=2),
    ]
    equations = [sp.Eq(x.diff(t), -k * x + sp.Max(x, y) / 3), sp.Eq(y.diff(t), x * 0.1234567890123)]
    box = {k: (1e-3, 10, "log"), lag: (0.5, 0.6)}
    jumps = {(1, 2): {x: x + 1}, lag: {y: y * 2}}
    return ro.Problem(
        equations,
        (t, 0, 4),
        box,
        {x: 1, y: 0},
        jumps=jumps,
        events=events,
        correlation={(k, lag): 0.3},
    )


def algebraic():
    return ro.Problem([sp.Eq(x.diff(t), y), sp.Eq(0, x**2 + y - k)], (t, 0, 1), BOX, {x: 0.1})


def by_matrices():
    stiffness = np.array([[2.0, -1.0], [-1.0, 1.0]])
    return ro.Problem.from_matrices(
        sp.diag(m, 2),
        K={k: stiffness},
        time=(t, 0, 5),
        parameters=BOX,
        initial=[1, 0],
        constants={m: 2},
    )


@pytest.mark.parametrize("build", [oscillator, switched, algebraic, by_matrices])
def test_files_read_back_as_they_were(build, tmp_path):
    problem = build()
    file = problem.save(tmp_path / "model.toml")
    again = load_problem(file)
    assert again == problem
    assert hash(again) == hash(problem)
    assert again.save(tmp_path / "again.toml").read_text() == file.read_text()


def test_what_is_written(tmp_path):
    text = oscillator().save(tmp_path / "model.toml").read_text()
    assert '"c*x_t + k*x + m*x_tt = Piecewise((F, t < 1), (0, True))"' in text
    assert '[definitions]\nF = "sqrt(k)*cos(t*w)"\n' in text
    assert '[parameters]\nk = [1.0, 2.0]\nc = "norm(0.2, 0.02)"\n' in text
    heavier = oscillator().set(m=4).vary(w=(1, 2)).save(tmp_path / "other.toml")
    assert load_problem(heavier).constants == {m: 4}


def test_assumptions_are_lost(tmp_path):
    positive = sp.Symbol("k", positive=True)
    problem = ro.Problem([sp.Eq(x.diff(t), -positive * x)], (t, 0, 1), {positive: (1, 2)}, {x: 1})
    again = load_problem(problem.save(tmp_path / "model.toml"))
    assert again != problem
    assert again == ro.Problem([sp.Eq(x.diff(t), -k * x)], (t, 0, 1), BOX, {x: 1})


@pytest.mark.parametrize(
    "change",
    [
        {"time": (t, 0, 5)},
        {"parameters": {**BOX, c: (0.1, 0.3)}},
        {"initial": {x: 1, x.diff(t): k}},
        {"constants": {m: 3, w: 0.2}},
        {"units": {x: "cm"}},
        {"atol": None},
        {"name": None},
        {"jumps": {1: {x: 0}}},
        {"events": [ro.Event(x)]},
    ],
)
def test_problems_that_differ(change):
    assert oscillator() == oscillator() == pickle.loads(pickle.dumps(oscillator()))
    assert oscillator(**change) != oscillator()
    assert oscillator() != "oscillator"


def test_equations_in_text():
    problem = ro.Problem.from_strings(
        rhs={"z": "-z"},
        initial={"x": 1, "x_t": "k/3", "z": 0.5},
        parameters={"k": (1, 2)},
        time=(0, 4),
        equations=["m*x_tt + k*x = z", "0 = y + x^2 - k"],
        unknowns=["y"],
        constants={"m": 3},
        jumps={1: {"x_t": "x_t + 1"}},
    )
    assert [str(unknown) for unknown in problem.unknowns] == ["z(t)", "x(t)", "y(t)"]
    end = problem.trajectory(2.0, k=1.5)
    assert end[y] == pytest.approx(1.5 - end[x] ** 2, abs=1e-7)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"equations": "x_t = -k*x"}, "not a list of texts"),
        ({"equations": ["x_t = -k*xx"]}, "unknown name `xx`"),
        ({"equations": ["x_t = = 3"]}, "not a formula"),
        ({"equations": ["x_t == -k*x"]}, "not a formula"),
        ({"unknowns": [3]}, "unknowns are .*not a list of texts"),
    ],
)
def test_equations_that_are_refused(change, message):
    arguments = {"equations": ["x_t = -k*x"], **change}
    with pytest.raises(ProblemError, match=message):
        ro.Problem.from_strings({}, {"x": 1}, {"k": (1, 2)}, (0, 1), **arguments)


TABLE = ro.table([0, 1], [0, 1])
NAMED = sp.Symbol("\\alpha")
s = sp.Symbol("s")


@pytest.mark.parametrize(
    ("problem", "name", "message"),
    [
        (
            ro.Problem([sp.Eq(x.diff(t), -k * TABLE(t))], (t, 0, 1), BOX, {x: 1}),
            "a.toml",
            "as text",
        ),
        (
            ro.Problem([sp.Eq(x.diff(t), -NAMED * x)], (t, 0, 1), {NAMED: (1, 2)}, {x: 1}),
            "a.toml",
            "identifiers",
        ),
        (algebraic(), "a.txt", "no .toml file"),
        (
            ro.Problem([sp.Eq(x.subs(t, s).diff(s), -k)], (s, 0, 1), BOX, {x.subs(t, s): 1}),
            "a.toml",
            "the time is called `s`",
        ),
        (algebraic(), "there.toml", "exists"),
    ],
)
def test_what_cannot_be_saved(problem, name, message, tmp_path):
    (tmp_path / "there.toml").touch()
    with pytest.raises(ProblemError, match=message):
        problem.save(tmp_path / name)
    assert not (tmp_path / "a.toml").exists()


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("correlation = [['k', 0.5]]", "two names and a number"),
        ("equations = 3", "not a list of texts"),
        ("tail = 'a'", "not a probability"),
    ],
)
def test_files_that_are_refused(line, message, tmp_path):
    file = tmp_path / "model.toml"
    file.write_text(
        f"time = [0, 1]\n{line}\n[rhs]\nx = '-k*x'\n[initial]\nx = 1\n[parameters]\nk = [1, 2]\n"
    )
    with pytest.raises(ProblemError, match=message):
        load_problem(file)
