"""Which unknowns have to be within the tolerance."""

import warnings

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.support.errors import OptionError
from rankone.trajectories.system.timeline import BranchedTimeline
from tests.benchmarks.many_states import chain

t, k = sp.symbols("t k")
x, y = (sp.Function(name)(t) for name in "xy")


@pytest.fixture(scope="module")
def compiled():
    """An easy unknown beside one that a rank of two does not hold."""
    wave = sp.sin(40 * k * t)
    equations = [sp.Eq(x.diff(t), -k * x), sp.Eq(y.diff(t), wave - y)]
    return ro.compile(ro.Problem(equations, (t, 0, 1), {k: (1, 2)}, {x: 1, y: 0}))


@pytest.mark.slow
def test_others_do_not_count(compiled, tmp_path):
    limits = {"method": "cross", "max_nodes": 8, "max_attempts": 2, "markers": None}
    assert not compiled.solve(1e-4, **limits).success
    solution = compiled.solve(1e-4, unknowns=[x], **limits)
    assert solution.success
    assert solution.states == solution.unknowns == ("x",)
    assert solution.error == solution.errors["x"] <= 1e-4
    again = ro.load(solution.save(tmp_path / "u.npz"))
    assert (again.error, again.metadata.left_out) == (solution.error, ("y",))
    np.testing.assert_allclose(again(0.5, k=1.5), [np.exp(-0.75)], rtol=1e-4)


@pytest.mark.parametrize(
    "ask",
    [
        lambda solution: solution["y"],
        lambda solution: solution.errors[y],
        lambda solution: solution.modes["y"],
        lambda solution: solution.output({"q": "2*y"}),
        lambda solution: solution.output({"q": x * y}),
        lambda solution: solution.output("both"),
        lambda solution: solution.fit([0.5], [0.5], observe=["y"]),
        lambda solution: solution.plot({"k": 1.5}, unknowns=["y"]),
    ],
)
def test_others_are_said_to_be_left_out(ask):
    rhs, start = {"x": "-k*x", "y": "x - y"}, {"x": "1", "y": "0"}
    more = {"definitions": {"both": "x + y"}}
    solution = ro.solve(
        ro.Problem.from_strings(rhs, start, {"k": (1, 2)}, (0, 1), **more), 1e-3, unknowns="x"
    )
    with pytest.raises((ro.RankoneError, KeyError), match="which `unknowns=` left out"):
        ask(solution)


STATES = {"x": "1", "y": "0", "z": "0"}
RATES = {"x": "-k*x", "y": "k*x - c*y", "z": "c*y - z"}
BOX = {"k": (1, 2), "c": (0.5, 0.7)}


@pytest.mark.parametrize(
    ("more", "options"),
    [
        ({}, {}),
        ({}, {"method": "train"}),
        ({}, {"method": "greedy"}),
        ({"jumps": {1.0: {"x": "x + 1"}}}, {}),
        pytest.param(
            {"events": [{"when": "x - 0.5", "direction": "falling", "then": {"x": "1"}}]},
            {},
            marks=pytest.mark.slow,
        ),
        pytest.param(
            {"events": [{"when": "y - 0.35", "direction": "rising", "then": {"x": "x + 1"}}]},
            {},
            marks=pytest.mark.slow,
        ),
        pytest.param({}, {"markers": ["x - 0.5"]}, marks=pytest.mark.slow),
    ],
)
def test_every_method_gives_back_what_was_asked_for(more, options):
    """The values are those of the whole solution, by position and by name."""
    problem = ro.Problem.from_strings(RATES, STATES, BOX, (0, 2), **more)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ro.RankoneWarning)
        whole = ro.solve(problem, 1e-4, **options)
        some = ro.solve(problem, 1e-4, unknowns=["z", "x"], **options)
        t = np.linspace(0.05, 1.95, 20)
        points = {"k": [[1.1], [1.9]], "c": [[0.55], [0.68]]}
        exact, values = whole(t, points)[[0, 2]], some(t, points)
    assert some.success == whole.success
    assert some.states == ("x", "z")
    assert len(some.outcome.measured.interior) == 2
    np.testing.assert_allclose(values, exact, rtol=0, atol=2e-4 if whole.success else 2e-2)
    step = 1e-4
    up, down = (some(0.9, k=1.4 + h, c=0.6) for h in (step, -step))
    slope = some.gradient(0.9, k=1.4, c=0.6)[:, 0]
    np.testing.assert_allclose(slope, (up - down) / (2 * step), rtol=1e-4, atol=1e-4)
    assert some.mean([1.0]).shape == (2, 1)


@pytest.mark.slow
def test_orders_that_change_are_kept_apart():
    """Branches: which one holds is told by rows behind the states."""
    events = [
        {"when": "x - 0.5", "direction": "falling", "then": {"z": "z + 1"}},
        {"when": "y - 0.5", "direction": "falling", "then": {"z": "2*z + 0.1"}},
    ]
    rates, start = {"x": "-k*x", "y": "-c*y", "z": "-z"}, {"x": "1", "y": "1", "z": "1"}
    box = {"k": (0.8, 1.6), "c": (0.8, 1.6)}
    problem = ro.Problem.from_strings(rates, start, box, (0, 2), events=events)
    some = ro.solve(problem, 1e-4, unknowns=["z"])
    assert isinstance(some.outcome.timeline, BranchedTimeline)
    assert some.success
    points = {"k": [0.9, 1.2, 1.5], "c": [1.5, 1.1, 0.85]}
    first = np.log(2) / np.maximum(*points.values())
    second = np.log(2) / np.minimum(*points.values())
    doubled = np.array([False, True, True]), np.array([True, False, False])
    exact = np.exp(-first)
    exact = np.where(doubled[1], 2 * exact + 0.1, exact + 1) * np.exp(first - second)
    exact = np.where(doubled[0], 2 * exact + 0.1, exact + 1) * np.exp(second - 1.9)
    np.testing.assert_allclose(some(1.9, points)[0], exact, rtol=2e-4)


def test_pieces_of_the_same_unknowns_are_joined(tmp_path):
    problem = ro.Problem.from_strings(RATES, STATES, BOX, (0, 2), atol={"y": 1e-3, "z": 1e-3})
    pieces = ro.solve_many(problem, problem.split(k=2), 1e-4, unknowns=["z"])
    joined = pieces.join()
    assert joined.success
    assert joined.metadata.atol == (("z", 1e-3),)
    again = ro.load(joined.save(tmp_path / "joined.npz"))
    np.testing.assert_array_equal(again(1.0, k=1.7, c=0.6), joined(1.0, k=1.7, c=0.6))
    other = ro.solve(problem, 1e-4, parameters={"k": (1, 1.5)}, unknowns=["y"])
    with pytest.raises(OptionError, match="differ in their unknowns"):
        ro.Solution.join([other, pieces[1]])


@pytest.mark.slow
def test_many_states_are_not_stored(tmp_path):
    problem = chain(80)
    whole, one = ro.solve(problem, 1e-3), ro.solve(problem, 1e-3, unknowns=["x5"])
    assert one.success
    assert whole.nbytes > 40 * one.nbytes
    values = (each["x5"](4.0, k1=1.2, k2=0.8, k3=1.0) for each in (one, whole))
    np.testing.assert_allclose(*values, rtol=2e-3)
    assert one.export(tmp_path / "model.py").exists()
    assert one.export(tmp_path / "page.html").exists()


@pytest.mark.parametrize("unknowns", [["x"], [x], "x"])
def test_unknowns_are_named_by_text_or_symbol(unknowns):
    equations = [sp.Eq(x.diff(t), -k * x), sp.Eq(y.diff(t), x - y)]
    problem = ro.Problem(equations, (t, 0, 1), {k: (1, 2)}, {x: 1, y: 0})
    solution = ro.solve(problem, 1e-3, unknowns=unknowns)
    assert solution.error == solution.errors["x"]


def test_lifted_systems_count_the_same():
    equation = sp.Eq(x.diff(t, 2), -k * sp.sin(x))
    problem = ro.Problem([equation], (t, 0, 3), {k: (1, 2)}, {x: 1, x.diff(t): 0})
    solution = ro.solve(problem, 1e-5, method="train", unknowns=[x.diff(t)])
    assert solution.success
    assert solution.error == solution.errors["x_t"]


@pytest.mark.parametrize(
    ("unknowns", "message"),
    [
        (["z"], "there is no unknown `z`"),
        ([], "unknowns is empty"),
        ([3], "unknowns=.* is not a list of unknowns"),
        (3, "unknowns=3 is not a list of unknowns"),
    ],
)
def test_what_is_no_unknown(compiled, unknowns, message):
    with pytest.raises(OptionError, match=message):
        compiled.solve(unknowns=unknowns)
