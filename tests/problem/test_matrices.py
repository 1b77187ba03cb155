"""Equations between matrices, and problems from mass, damping and stiffness matrices."""

import numpy as np
import pytest
import scipy.sparse
import sympy as sp
from scipy.integrate import solve_ivp

import rankone as ro
from rankone.support.errors import ProblemError

t, k, c, m = sp.symbols("t k c m")
x, y = sp.Function("x")(t), sp.Function("y")(t)
Q = sp.Matrix([x, y])
MASS, STIFFNESS = sp.diag(2, m), sp.Matrix([[2 * k, -k], [-k, k]])
BOX, START = {k: (1, 2)}, {x: 1, y: 0, x.diff(t): 0, y.diff(t): 0}
PUSH = sp.Matrix([0, sp.cos(t)])
CHAIN = np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])
CONSISTENT = (4 * np.eye(3) + np.eye(3, k=1) + np.eye(3, k=-1)) / 6


def chain(**changes):
    arguments = {
        "M": np.diag([1.0, 2.0, 1.0]),
        "K": {k: CHAIN},
        "time": (t, 0, 2),
        "parameters": BOX,
        "initial": [0.0, 0.0, 1.0],
    }
    return ro.Problem.from_matrices(**{**arguments, **changes})


def by_scipy(mass, stiffness, force=0.0, size=3):
    """Positions and velocities at the end, integrated by SciPy."""
    inverse = np.linalg.inv(mass)
    start = np.zeros(2 * size)
    start[size - 1] = 1.0

    def rates(at, u):
        return np.concatenate([u[size:], inverse @ (force * np.cos(at) - stiffness @ u[:size])])

    return solve_ivp(rates, (0, 2), start, rtol=1e-10, atol=1e-12).y[:, -1]


def test_rows_of_equations_between_matrices():
    whole = sp.Eq(MASS * Q.diff(t, 2) + STIFFNESS * Q, PUSH)
    rows = [
        sp.Eq(2 * x.diff(t, 2) + 2 * k * x - k * y, 0),
        sp.Eq(m * y.diff(t, 2) + k * (y - x), sp.cos(t)),
    ]
    reference = ro.first_order(ro.Problem(rows, (t, 0, 2), BOX, START, constants={m: 3}))
    residual = MASS * Q.diff(t, 2) + STIFFNESS * Q - PUSH
    for equations in (whole, [whole], [residual], residual):
        problem = ro.Problem(equations, (t, 0, 2), BOX, START, constants={m: 3})
        pairs = zip(ro.first_order(problem).rhs, reference.rhs, strict=True)
        assert all(sp.expand(a - b) == 0 for a, b in pairs)


def test_constants_in_matrices_are_recognised():
    equation = sp.Eq(Q.diff(t), sp.Matrix([-k * x**c, m * y]))
    problem = ro.Problem([equation], (t, 0, 2), BOX, {x: 1, y: 1}, constants={m: 3, c: 2})
    assert problem.shorthand.decisive == {c}


@pytest.mark.parametrize("wrap", [np.array, sp.Matrix, scipy.sparse.csr_matrix, np.ndarray.tolist])
def test_kinds_of_matrices(wrap):
    problem = chain(M=wrap(CONSISTENT), K={k: wrap(CHAIN)}, force={sp.cos(t): [0, 0, 1]})
    expected = by_scipy(CONSISTENT, 1.5 * CHAIN, np.array([0.0, 0.0, 1.0]))
    end = problem.trajectory(2.0, k=1.5)
    assert end.values == pytest.approx(expected[:3], abs=1e-6)


def test_large_mass_matrices_of_numbers_are_inverted_by_numbers():
    size = 9
    mass = (4 * np.eye(size) + np.eye(size, k=1) + np.eye(size, k=-1)) / 6
    stiffness = 2 * np.eye(size) - np.eye(size, k=1) - np.eye(size, k=-1)
    start = np.eye(size)[-1]
    problem = chain(M={1: mass / 2, sp.Rational(1, 2): mass}, K={k: stiffness}, initial=start)
    assert problem.mass_form.places is not None
    expected = by_scipy(mass, 1.5 * stiffness, size=size)
    assert problem.trajectory(2.0, k=1.5).values == pytest.approx(expected[:size], abs=1e-6)


def test_first_order_and_nonlinear():
    problem = chain(
        M=None, C=np.eye(3), force=sp.Matrix([0, 0, -(sp.Function("h2")(t) ** 2)]), names="h"
    )
    rates = ro.first_order(problem).rhs
    h = [sp.Function(f"h{i}")(t) for i in range(3)]
    assert sp.expand(rates[2] - (k * h[1] - k * h[2] - h[2] ** 2)) == 0


def test_initial_values():
    q = [sp.Function(f"q{i}")(t) for i in range(3)]
    pair = chain(initial=([1, 2, k], np.array([0.5, 0, 0])))
    assert [*pair.initial.values()] == [1, 2, k, sp.Rational(1, 2), 0, 0]
    for written in ({"q2": k, "q0_t": 0.5}, {q[2]: k, q[0].diff(t): 0.5}):
        assert [*chain(initial=written).initial.values()] == [0, 0, k, sp.Rational(1, 2), 0, 0]
    assert [*chain(initial=np.zeros(3), names=["a", "b", "c"]).initial][2] == sp.Function("c")(t)


def test_constants_are_run_time_values():
    problem = chain(M={m: np.eye(3)}, constants={m: 2.0})
    assert {*problem.shorthand.named} == {m}
    assert problem.set(m=3.0).trajectory(2.0, k=1.5).values == pytest.approx(
        by_scipy(3 * np.eye(3), 1.5 * CHAIN)[:3], abs=1e-6
    )


WHOLE = sp.MatrixSymbol("A", 2, 2)


@pytest.mark.parametrize(
    ("equations", "message"),
    [
        (
            [sp.Eq(Q.diff(t), WHOLE * Q)],
            "(?s)equation 1: the matrix .* has entries that are not written out",
        ),
        ([sp.Eq(Q.diff(t), sp.zeros(3, 1))], "different shapes"),
        ([sp.Eq(Q.diff(t), 0)], "a matrix and a number"),
        ([[sp.Eq(x.diff(t), k * x), sp.Eq(y.diff(t), x)]], "write all equations in one list"),
        (sp.Eq(x.diff(t), k * x), "not a list of SymPy equations"),
    ],
)
def test_equations_that_are_refused(equations, message):
    with pytest.raises(ProblemError, match=message):
        ro.Problem(equations, (t, 0, 1), BOX, {x: 1, y: 1})


def test_without_a_mass_a_system_is_of_first_order():
    shared = {"time": (t, 0, 1), "parameters": {k: (1, 2)}, "initial": [1, 1, 1]}
    damped = {"C": np.eye(3), "K": {k: CHAIN}}
    assert ro.Problem.from_matrices(**damped, **shared) == ro.Problem.from_matrices(
        None, **damped, **shared
    )
    with pytest.raises(ProblemError, match="neither M nor C"):
        ro.Problem.from_matrices(K=CHAIN, **shared)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"K": CHAIN[:2]}, "matrix K is 2 x 3; remedy: give 3 x 3 entries, as M has"),
        ({"M": None}, "neither M nor C"),
        ({"M": np.zeros((3, 3))}, "the matrix M is zero"),
        ({"M": np.ones((9, 9)), "K": None, "initial": np.zeros(9)}, "condition number"),
        ({"M": {m: np.ones((9, 9))}, "K": None, "initial": np.zeros(9)}, "is not diagonal, and"),
        ({"M": [[1, np.nan], [0, 1]]}, "not finite"),
        ({"K": "k"}, "the matrix K is 'k'"),
        ({"K": {}}, "the matrix K has no terms"),
        ({"K": {"k": CHAIN}}, "the coefficient 'k' of the matrix K"),
        ({"force": [1, 2]}, r"force has the shape \(2,\); remedy: give 3 entries"),
        ({"initial": [1, 2]}, "give 3 values, or a pair"),
        ({"initial": ([0, 0, 1], [0, 0, 0], [0, 0, 0])}, "3 arrays for a system of order 2"),
        ({"initial": {"q7": 1}}, "'q7' of `initial`"),
        ({"names": ["a", "b"]}, "a list of 3 names"),
        ({"names": 3}, "names are 3"),
        ({"time": (0, 1)}, "time is"),
    ],
)
def test_matrices_that_are_refused(changes, message):
    with pytest.raises(ProblemError, match=message):
        chain(**changes)
