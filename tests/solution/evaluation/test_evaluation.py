"""Evaluation: values, shapes, names, and errors."""

from __future__ import annotations

from dataclasses import replace
from decimal import Decimal
from typing import Any

import numpy as np
import pytest
import sympy as sp
from hypothesis import given
from hypothesis import strategies as st

from rankone.solution.solution import Solution
from rankone.support.errors import EvaluationError
from rankone.tensors.coordinates import Coordinates
from rankone.tensors.train import Train
from tests.solution.evaluation.functions import Known, decay, oscillator, two_unknowns

t, s, x0, y0, k = sp.symbols("t s x0 y0 k")
x, y = sp.Function("x"), sp.Function("y")

KNOWN = {elements: two_unknowns(elements) for elements in (1, 3)}
SOLUTION = KNOWN[1].solution


@pytest.mark.parametrize("known", KNOWN.values(), ids=["one element", "three elements"])
@given(time=st.floats(0, 3), p=st.floats(-1, 1), q=st.floats(2, 3))
def test_one_point(known: Known, time: float, p: float, q: float) -> None:
    value = known.solution(t=time, x0=p, y0=q)
    assert value.shape == (2,)
    np.testing.assert_allclose(value, known(time, p, q), rtol=1e-11, atol=1e-10)
    # one point, many points and grids are different code
    np.testing.assert_allclose(known.solution([time], x0=p, y0=q)[:, 0], value, atol=1e-12)
    np.testing.assert_allclose(known.solution.grid(time, x0=p, y0=q)[:, 0, 0, 0], value, atol=1e-12)


@pytest.mark.parametrize("known", KNOWN.values(), ids=["one element", "three elements"])
def test_many_points_in_random_order(known: Known) -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform([[0], [-1], [2]], [[3], [1], [3]], (3, 5000))
    np.testing.assert_allclose(
        known.solution(*points[:1], {"x0": points[1], "y0": points[2]}), known(*points), atol=1e-10
    )


def test_evaluation_agrees_with_the_slabs_themselves() -> None:
    slab = KNOWN[3].solution.outcome.slabs[1]
    rng = np.random.default_rng(2)
    points = rng.uniform([[1.0], [-1], [2]], [[1.499], [1], [3]], (3, 100))
    values = KNOWN[3].solution(points[0], x0=points[1], y0=points[2])
    np.testing.assert_allclose(values, slab(points[0], points[1:]), atol=1e-13)


@pytest.mark.parametrize(
    ("shapes", "shape"),
    [
        (((), (), ()), ()),
        (((4,), (), ()), (4,)),
        (((4, 1), (3,), ()), (4, 3)),
        (((), (), (1,)), (1,)),
        (((2, 1, 1), (3, 1), (4,)), (2, 3, 4)),
        (((0,), (), ()), (0,)),
        (((1,), (0,), (3, 1)), (3, 0)),
    ],
)
def test_arrays_broadcast(shapes: tuple[tuple[int, ...], ...], shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(3)
    times, p, q = (rng.uniform(2, 3, size) for size in shapes)
    p = p - 2
    values = SOLUTION(times, x0=p, y0=q)
    assert values.shape == (2, *shape)
    np.testing.assert_allclose(values, KNOWN[1](times, p, q), atol=1e-10)
    assert np.shape(SOLUTION["y"](times, x0=p, y0=q)) == shape


def sharing(solution: Solution) -> Solution:
    """The same, but all slabs share the cores of their parameters, as after ``cross``."""
    first, *others = solution.outcome.slabs
    cores, bases = first.cores[1:], first.bases
    slabs = [replace(slab, train=Train((slab.cores[0], *cores)), bases=bases) for slab in others]
    return Solution(replace(solution.outcome, slabs=(first, *slabs)), solution.metadata)


@pytest.mark.parametrize("solution", [SOLUTION, KNOWN[3].solution, sharing(KNOWN[3].solution)])
@pytest.mark.parametrize(
    "shapes",
    [
        ((30,), (), ()),  # a curve
        ((), (30,), ()),  # points at one time
        ((), (4, 1), (5,)),
        ((6, 1), (5,), ()),  # curves at the same times
        ((6,), (5, 1), (5, 1)),
        ((3, 1, 1, 2), (4, 1, 1), (5, 1)),
        ((1, 6, 1), (2, 1, 3), (3,)),
        ((5, 6), (5, 1), ()),  # each at times of its own
        ((6, 5), (5,), (5,)),
        ((2, 3, 4), (2, 1, 1), (3, 1)),
        ((2, 3, 4), (2, 1, 4), ()),
        ((2, 1), (2, 3), ()),  # several points at the same time
        ((7,), (7,), (7,)),
        ((1,), (1, 1), ()),
        ((0, 1), (3,), ()),
        ((0, 3), (3,), ()),
        ((3, 0), (3, 1), ()),
        ((4, 1), (0,), ()),
        ((0,), (0,), ()),
        ((2, 1, 3), (0, 3), ()),
    ],
)
def test_times_apart_from_parameters(
    solution: Solution, shapes: tuple[tuple[int, ...], ...]
) -> None:
    rng = np.random.default_rng(4)
    breaks = [slab.start for slab in solution.outcome.slabs]
    edges = ([*breaks, 3.0], *(basis.edges for basis in solution.outcome.slabs[0].bases))
    given = [
        rng.choice([*ends, *rng.uniform(ends[0], ends[-1], len(ends))], shape)
        for ends, shape in zip(edges, shapes)
    ]
    at = dict(zip(("t", "x0", "y0"), given))
    flat = dict(zip(at, (array.ravel() for array in np.broadcast_arrays(*given))))
    shape = np.broadcast_shapes(*shapes)
    for call in (solution, solution.gradient, solution["y"]):
        values, wanted = call(at), call(flat)
        assert values.shape == (*wanted.shape[:-1], *shape)
        assert values.flags.c_contiguous
        scale = np.abs(wanted).max(initial=0.0)
        np.testing.assert_allclose(values.reshape(wanted.shape), wanted, rtol=0, atol=1e-13 * scale)
    singles = [
        solution({name: float(v) for name, v in zip(flat, point)}) for point in zip(*flat.values())
    ]
    np.testing.assert_allclose(
        solution(at).reshape(2, -1).T, np.reshape(singles, (-1, 2)), rtol=1e-12, atol=1e-12
    )


@pytest.mark.parametrize(
    "values",
    [
        SOLUTION(1.0, x0=0.5, y0=2.5),
        SOLUTION(1.0, {x0: 0.5, y0: 2.5}),
        SOLUTION(1.0, {"x0": 0.5}, y0=2.5),
        SOLUTION(1.0, {x0: 0.5, "y0": 2.5}),
        SOLUTION({t: 1.0, x0: 0.5, y0: 2.5}),
        SOLUTION({x0: 0.5, y0: 2.5}, t=1),
        SOLUTION(t=sp.Integer(1), x0=sp.Rational(1, 2), y0=np.float32(2.5)),
        SOLUTION(t=np.array(1), x0=Decimal("0.5"), y0=sp.Float(2.5)),
    ],
)
def test_ways_to_name_coordinates(values: Any) -> None:
    np.testing.assert_array_equal(values, SOLUTION(t=1.0, x0=0.5, y0=2.5))


def test_one_unknown() -> None:
    values = SOLUTION(t=1.0, x0=0.5, y0=2.5)
    for key in (y(t), "y", y, sp.Symbol("y")):
        assert SOLUTION[key](t=1.0, x0=0.5, y0=2.5) == pytest.approx(values[1], rel=1e-14)
    assert SOLUTION["y"].error == SOLUTION.errors["y"]
    assert repr(SOLUTION["y"]) == "y(t, x0, y0) of a Solution, measured error 2e-07"


def test_derivatives_and_another_name_of_time() -> None:
    solution = oscillator().solution
    times = np.linspace(0, 3, 7)
    assert solution(times, k=1.5).shape == (1, 7)
    np.testing.assert_allclose(solution[x(s)](s=times, k=1.5), np.sin(times), atol=1e-11)
    np.testing.assert_allclose(solution[x(s).diff(s)](times, {k: 1.5}), np.cos(times), atol=1e-11)
    with pytest.raises(EvaluationError, match=r"no unknown `x_tt` \(did you mean `x_t`\?\)"):
        solution[x(s).diff(s, 2)]
    with pytest.raises(EvaluationError, match="unknown name `t`"):
        solution(t=1.0, k=1.5)


def test_no_parameters() -> None:
    solution = decay().solution
    np.testing.assert_allclose(solution(2.0), [np.exp(-2.0)], rtol=1e-11)
    assert solution["u"]([[1.0, 2.0]]).shape == (1, 2)
    assert solution.grid([0.0, 1.0, 3.0]).shape == (1, 3)
    assert solution.rank == 1


def test_grid() -> None:
    times, p = np.array([2.9, 0.1, 1.2]), np.array([0.5, -0.5])
    values = SOLUTION.grid(times, x0=p, y0=2.5)
    assert values.shape == (2, 3, 2, 1)
    np.testing.assert_allclose(values[..., 0], KNOWN[1](times[:, None], p, 2.5), atol=1e-10)
    np.testing.assert_allclose(SOLUTION["y"].grid(times, x0=p, y0=2.5), values[1], atol=1e-14)
    with pytest.raises(EvaluationError, match="an axis of a grid has one dimension"):
        SOLUTION.grid(times, x0=[[0.0]], y0=2.5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"t": 1, "x0": 0}, r"no value for `y0`; the coordinates are `t`, `x0` and `y0`"),
        ({}, "no value for `t`, `x0` and `y0`"),
        ({"t": 1, "x0": 0, "y0": 2, "z": 0}, "unknown name `z`"),
        ({"t": 1, "x0": 0, "Y0": 2}, r"unknown name `Y0` \(did you mean `y0`\?\)"),
        ({"t": 1, "x0": None, "y0": 2}, "`x0` is None, not a real number"),
        ({"t": 3.1, "x0": 0, "y0": 2}, r"`t` = 3.1 is outside its horizon \[0, 3\]"),
        ({"t": -1e-9, "x0": 0, "y0": 2}, "`t` = -1e-09 is outside"),
        ({"t": 1, "x0": 2, "y0": 2}, r"`x0` = 2 is outside its range \[-1, 1\]"),
        ({"t": 1, "x0": [0, -2, 5], "y0": 2}, r"`x0` = 5 is outside .* farthest of 2"),
        ({"t": 1, "x0": np.inf, "y0": 2}, "`x0` = inf is outside"),
        ({"t": 1, "x0": np.nan, "y0": 2}, "`x0` is NaN"),
        ({"t": 1, "x0": [0, np.nan], "y0": 2}, "`x0` has NaN"),
        ({"t": "one", "x0": 0, "y0": 2}, "`t` is 'one', not a real number"),
        ({"t": 1, "x0": 0, "y0": 2j}, "`y0` is 2j, not a real number"),
        ({"t": 1, "x0": x0, "y0": 2}, "`x0` is x0, not a real number"),
        ({"t": 1, "x0": np.array(["1"], dtype=object), "y0": 2}, "not a real number"),
        (
            {"t": 1, "x0": np.ma.array([0, 9], mask=[0, 1]), "y0": 2},
            "`x0` has values that are mask",
        ),
        ({"t": [1, 2], "x0": [0, 0, 0], "y0": 2}, r"do not broadcast .* `t` \(2,\), `x0` \(3,\)"),
    ],
)
def test_bad_values(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(EvaluationError, match=message):
        SOLUTION(**arguments)
    with pytest.raises(EvaluationError, match=message):
        SOLUTION["x"](**arguments)


def test_bad_calls() -> None:
    with pytest.raises(EvaluationError, match="`x0` is given twice"):
        SOLUTION(1, {x0: 0}, x0=0, y0=2)
    with pytest.raises(EvaluationError, match="`t` is given twice"):
        SOLUTION(1, {x0: 0, y0: 2}, t=1)
    with pytest.raises(EvaluationError, match=r"the second argument is 0\.5"):
        SOLUTION(1, 0.5)
    with pytest.raises(EvaluationError, match="`3` is not a name"):
        SOLUTION(1, {3: 0})


@pytest.mark.parametrize("callee", [SOLUTION, SOLUTION["x"], SOLUTION.modes["x"]])
def test_too_many_positions(callee: Any) -> None:
    remedy = r"remedy: give parameters by name: solution\(t=1\.5, x0=0, y0=2\.5\)"
    for call in (callee, getattr(callee, "grid", callee)):
        with pytest.raises(EvaluationError, match=f"4 arguments were given by position.*{remedy}"):
            call(1, 1, 0.2, 4)


def test_the_example_of_a_call_can_be_copied() -> None:
    function = Coordinates(["t", "x_{0}"], [(0, 2), (1, 3)])
    with pytest.raises(EvaluationError, match=r"solution\(\{'t': 1, 'x_\{0\}': 2\}\)"):
        function.gather((1, 2), {})


@pytest.mark.parametrize("key", ["z", 0, x(0), x(s), sp.Symbol("x") + 1, None, x(t).diff(t)])
def test_bad_unknowns(key: Any) -> None:
    with pytest.raises(EvaluationError):
        SOLUTION[key]


def test_a_solution_is_no_sequence() -> None:
    with pytest.raises(TypeError, match="not iterable"):
        list(SOLUTION)


def test_round_off_at_the_ends_is_forgiven() -> None:
    end = SOLUTION(3.0, x0=1.0, y0=2.0)
    np.testing.assert_array_equal(SOLUTION(3.0 + 1e-13, x0=1 + 1e-13, y0=2 - 1e-13), end)
    with pytest.raises(EvaluationError):
        SOLUTION(3.0, x0=1 + 1e-11, y0=2.0)
