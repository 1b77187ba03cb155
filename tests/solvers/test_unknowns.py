"""Which unknowns have to be within the tolerance."""

import pytest
import sympy as sp

import rankone as ro
from rankone.support.errors import OptionError

t, k = sp.symbols("t k")
x, y = (sp.Function(name)(t) for name in "xy")


@pytest.fixture(scope="module")
def compiled():
    """An easy unknown beside one that a rank of two does not hold."""
    wave = sp.sin(40 * k * t)
    equations = [sp.Eq(x.diff(t), -k * x), sp.Eq(y.diff(t), wave - y)]
    return ro.compile(ro.Problem(equations, (t, 0, 1), {k: (1, 2)}, {x: 1, y: 0}))


def test_others_do_not_count(compiled, tmp_path):
    limits = {"method": "cross", "max_nodes": 8, "max_attempts": 2, "markers": None}
    assert not compiled.solve(1e-4, **limits).success
    solution = compiled.solve(1e-4, unknowns=[x], **limits)
    assert solution.success
    assert solution.error == solution.errors["x"] <= 1e-4
    assert solution.errors["y"] > 1e-2
    assert "error     of `x`" in repr(solution)
    assert ro.load(solution.save(tmp_path / "u.npz")).error == solution.error


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
        ([], "no unknown is to count"),
        ([3], "unknowns=.* is not a list of unknowns"),
        (3, "unknowns=3 is not a list of unknowns"),
    ],
)
def test_what_is_no_unknown(compiled, unknowns, message):
    with pytest.raises(OptionError, match=message):
        compiled.solve(unknowns=unknowns)
