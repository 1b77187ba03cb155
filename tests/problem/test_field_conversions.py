"""Fields from matrices, and fields entry by entry."""

import numpy as np
import pytest
import scipy.sparse as ss
import sympy as sp
from scipy.integrate import solve_ivp

import rankone as ro
from rankone.compiler.field_lowering import field_system
from tests.compiler.test_field_lowering import CASES

t, k, c = sp.symbols("t k c")
N = 5
ones = np.ones(N)
L = ss.csr_array(ss.diags_array([ones[1:], -2 * ones, ones[1:]], offsets=(-1, 0, 1)))
M = ss.csr_array(ss.diags_array([ones[1:], 4 * ones, ones[1:]], offsets=(-1, 0, 1)))


def trajectory_of(system, p, time):
    def rates(at, y):
        force = system.at(p).force(at, y)
        return force if system.mass is None else ss.linalg.spsolve(system.mass.tocsc(), force)

    return solve_ivp(
        rates, system.horizon, system.initial(p), "LSODA", [time], rtol=1e-10, atol=1e-10
    ).y[:, 0]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_entries_have_the_trajectories_of_the_fields(case):
    problem = case()[0]
    system = field_system(problem)
    p = np.array([0.7 * low + 0.3 * high for low, high in system.box])
    values = dict(zip(system.parameters, p, strict=True))
    scalar = problem.scalar()
    assert type(scalar) is ro.Problem
    assert scalar.parameters == problem.parameters
    exact = scalar.trajectory([0.9], values).values[:, 0]
    assert np.abs(trajectory_of(system, p, 0.9) - exact).max() <= 1e-6 * np.abs(exact).max()


def test_mass_matrices_entry_by_entry():
    u = ro.field("u", N)
    problem = ro.Problem(
        {u: k * ro.apply(L, u) - u**3}, (t, 0, 1), {k: (1, 2)}, {u: np.arange(N)}, mass={u: M}
    )
    system = field_system(problem)
    exact = problem.trajectory([0.5], k=1.5).values[:, 0]
    assert np.abs(trajectory_of(system, np.array([1.5]), 0.5) - exact).max() <= 1e-6


def test_solving_entry_by_entry():
    u = ro.field("u", 2)
    coupling = np.array([[-1.0, 1.0], [1.0, -1.0]])
    problem = ro.Problem({u: k * ro.apply(coupling, u)}, (t, 0, 1), {k: (1, 2)}, {u: [0, 1]})
    solution = ro.solve(problem.scalar(), rtol=1e-4)
    expected = 0.5 * (1.0 - np.exp(-2.0 * 1.5))
    assert abs(float(solution["u0"](t=1.0, k=1.5)) - expected) <= 1e-4


def test_names_units_and_tolerances_are_those_of_the_field():
    u = ro.field("u", N)
    problem = ro.Problem(
        {u: k * ro.apply(L, u)},
        (t, 0, 1),
        {k: (1, 2, "log")},
        {u: 1},
        units={u: "K", t: "s"},
        atol={u: 1e-3},
        name="rod",
    ).scalar()
    assert problem.name == "rod"
    assert problem.units["u3"] == "K"
    assert problem.atol["u4"] == 1e-3
    assert problem.coordinates[1].scale != problem.coordinates[0].scale


def test_large_fields_are_not_written_out():
    u = ro.field("u", 2001)
    problem = ro.Problem({u: -u}, (t, 0, 1), {}, {u: 1})
    with pytest.raises(ro.ProblemError, match="the fields have 2001 entries together"):
        problem.scalar()


def test_large_mass_matrices_are_not_inverted():
    n = 201
    u = ro.field("u", n)
    coupled = ss.diags_array([np.ones(n), np.full(n, 0.1)], offsets=(0, 1), shape=(n, n))
    with pytest.raises(ro.ProblemError, match="a mass matrix couples 201 entries"):
        ro.Problem({u: -u}, (t, 0, 1), {}, {u: 1}, mass={u: coupled}).scalar()
    lumped = ro.Problem({u: -u}, (t, 0, 1), {}, {u: 1}, mass={u: 2 * ss.eye_array(n)})
    assert len(lumped.scalar().unknowns) == n


def test_saving_is_refused(tmp_path):
    u = ro.field("u", 3)
    with pytest.raises(ro.ProblemError, match="has matrices, which a TOML file does not hold"):
        ro.Problem({u: -u}, (t, 0, 1), {}, {u: 1}).save(tmp_path / "field.toml")


class TestMatrices:
    def arguments(self, **changed):
        return {
            "M": M,
            "C": {k: ss.eye_array(N)},
            "K": {1: -L, c: np.eye(N)},
            "force": {sp.cos(t): ones},
            "time": (t, 0, 1),
            "parameters": {k: (1, 2), c: (1, 2)},
            "initial": (np.arange(N), 0 * ones),
            **changed,
        }

    @pytest.mark.parametrize(
        "changed",
        [
            {},
            {"M": 2 * np.eye(N)},
            {"M": np.eye(N)},
            {"M": None, "C": M, "initial": np.arange(N)},
            {"M": {2: M}, "initial": {"q": np.arange(N)}},
            {"M": None, "C": sp.diag(1, 2, 3, 4, 5), "force": None, "initial": np.arange(N)},
        ],
    )
    @pytest.mark.filterwarnings("ignore:parameter")
    def test_one_field_has_the_trajectories_of_many_unknowns(self, changed):
        field = ro.Problem.from_matrices(**self.arguments(**changed), fields=True)
        initial = {f"q{i}": float(i) for i in range(N)}
        many = ro.Problem.from_matrices(**{**self.arguments(**changed), "initial": initial})
        assert [u.name for u in field.unknowns] == ["q"]
        system = field_system(field)
        values = {"k": 1.3, "c": 1.6}
        exact = many.trajectory([0.8], values).values[:N, 0]
        p = np.array([values[name] for name in system.parameters])
        assert np.abs(trajectory_of(system, p, 0.8)[:N] - exact).max() <= 1e-6

    def test_diagonal_masses_are_divided_by(self):
        field = ro.Problem.from_matrices(**self.arguments(M=2 * np.eye(N)), fields=True)
        assert not field.masses

    @pytest.mark.parametrize(
        ("changed", "message"),
        [
            ({"names": ["a"] * N}, "with fields=True give one name"),
            ({"M": None, "C": None}, "neither M nor C is given"),
            ({"C": np.eye(3)}, "the matrix C is 3 x 3"),
            ({"M": {k: M}}, "the matrix M of the highest derivatives has the coefficient `k`"),
            ({"K": sp.eye(N) * k}, "K has entries that are not numbers"),
            ({"force": np.ones(3)}, "the force has the shape (3,)"),
            ({"initial": (ones, ones, ones)}, "initial has 3 arrays for a system of order 2"),
            ({"initial": {"u": 1}}, "the key 'u' of `initial` is no state"),
            ({"M": np.zeros((N, N))}, "the mass matrix of `q` is singular"),
        ],
    )
    def test_errors(self, changed, message):
        with pytest.raises(ro.ProblemError) as raised:
            ro.Problem.from_matrices(**self.arguments(**changed), fields=True)
        assert message in str(raised.value)


class TestText:
    def arguments(self, **changed):
        return {
            "rhs": {"u": "D*apply(L, u) + A - (B + 1)*u + u**2*v", "v": "D*apply(L, v) + b*x*u"},
            "equations": ["x_t = -x + apply(w, u)"],
            "initial": {"u": "A*b", "v": ones, "x": 1},
            "parameters": {"A": (1, 2), "B": (1, 2)},
            "time": (0, 1),
            "constants": {"D": 0.1},
            "fields": {"u": N, "v": N},
            "matrices": {"L": L, "b": np.arange(N), "w": np.ones((1, N))},
            **changed,
        }

    def test_reads_as_expressions_do(self):
        u, v, x = ro.field("u", N), ro.field("v", N), sp.Function("x")(t)
        A, B, D = sp.symbols("A B D")
        b = ro.apply(np.arange(N), 1)
        by_hand = ro.Problem(
            {
                u: D * ro.apply(L, u) + A - (B + 1) * u + u**2 * v,
                v: D * ro.apply(L, v) + b * x * u,
                x: -x + ro.apply(np.ones((1, N)), u),
            },
            (t, 0, 1),
            {A: (1, 2), B: (1, 2)},
            {u: A * b, v: ones, x: 1},
            constants={D: 0.1},
        )
        assert ro.Problem.from_strings(**self.arguments()) == by_hand

    def test_shows_matrices_by_their_names(self):
        problem = ro.Problem.from_strings(
            {"u": "apply(named, u)"},
            {"u": 1},
            {},
            (0, 1),
            fields={"u": 3},
            matrices={"named": 7 * np.eye(3)},
        )
        assert "du/dt = apply(named, u)" in repr(problem)

    def test_second_order(self):
        problem = ro.Problem.from_strings(
            rhs={},
            equations=["u_tt + k*u_t = apply(L, u)"],
            initial={"u": ones, "u_t": 0},
            parameters={"k": (1, 2)},
            time=(0, 1),
            fields={"u": N},
            matrices={"L": L},
            mass={"u": M},
        )
        assert [state.name for state in problem.rates] == ["u", "u_t"]
        assert [state.name for state in problem.masses] == ["u_t"]

    @pytest.mark.parametrize(
        ("changed", "message"),
        [
            ({"fields": {"u": N, "w": N}}, "the field `w` has no equation"),
            ({"fields": {"u": 0, "v": N}}, "the field `u` has 0 entries"),
            ({"matrices": {"L": L, "b": np.arange(N), "w": "1"}}, "the matrix `w` is '1'"),
            ({"matrices": {"u": L}}, "belongs both to unknown `u` and to matrix `u`"),
            ({"rhs": {"u": "L*u", "v": "u"}}, "write apply(L, ...)"),
            ({"rhs": {"u": "apply(u, u)", "v": "u"}}, "has no matrix as its first argument"),
            ({"rhs": {"u": "apply(L)", "v": "u"}}, "is not understood"),
            ({"initial": {"u": ones, "v": 1, "x": ones}}, "neither text nor a number"),
        ],
    )
    def test_errors(self, changed, message):
        with pytest.raises(ro.ProblemError) as raised:
            ro.Problem.from_strings(**self.arguments(**changed))
        assert message in str(raised.value)
