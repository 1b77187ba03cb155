"""Problems of many states as tables of terms: the same as their equations written out."""

import pickle

import numpy as np
import pytest
import scipy.sparse
import sympy as sp

import rankone as ro
from rankone.compiler.agreement import DisagreementError, check_table
from rankone.problem.algebra import matrices
from rankone.problem.algebra.term_table import FEWEST_TABULATED
from rankone.support.arrays import Deferred

N = 8
T, K, M, C, F = sp.symbols("t k m c f")


@pytest.fixture(autouse=True)
def of_few_states(monkeypatch):
    """Tables of few states as well."""
    monkeypatch.setattr(matrices, "FEWEST_TABULATED", N)


def chain(n=N, *, sparse=True, **changed):
    """A row of masses on springs, damped and driven, or what is changed of it."""
    spring = scipy.sparse.diags([-np.ones(n - 1), np.full(n, 2.0), -np.ones(n - 1)], [-1, 0, 1])
    damping = np.linspace(0.1, 1.0, n)
    damping = scipy.sparse.diags(damping) if sparse else np.diag(damping)
    arguments = {
        "M": np.diag(np.linspace(1, 2, n)),
        "C": {C: damping},
        "K": {K * sp.exp(-T / 3): spring if sparse else spring.toarray(), 2: 0.1 * np.eye(n)},
        "force": {F * sp.sin(T): np.ones(n)},
        "time": (T, 0, 2),
        "parameters": {K: (1, 2), C: (0.1, 0.2), F: (0.5, 1)},
        "initial": (np.linspace(0, 0.3, n), [F / 7] * n),
    }
    return ro.Problem.from_matrices(**(arguments | changed))


def written_out(problem, **changed):
    """The same problem from its equations as expressions."""
    box = dict(problem.parameters)
    return ro.Problem(list(problem.equations), problem.time, box, dict(problem.initial), **changed)


def test_nothing_is_written_out_until_it_is_read(monkeypatch):
    def never(self):
        raise AssertionError("an expression was written")

    monkeypatch.setattr(Deferred, "_items", property(never))
    n = FEWEST_TABULATED
    system = ro.compile(chain(n)).system
    assert system.n_differential == 2 * n
    assert np.isfinite(system.rhs(0.5, np.ones((2 * n, 1)), np.ones((3, 1)))).all()


@pytest.mark.parametrize("sparse", [True, False])
def test_tables_compile_to_the_same_source_as_equations(sparse):
    problem = chain(sparse=sparse)
    table, expressions = ro.compile(problem), ro.compile(written_out(problem))
    assert problem.table is not None
    assert expressions.problem.table is None
    assert table.source == expressions.source
    assert table.problem == expressions.problem
    assert table.first_order.rhs == expressions.first_order.rhs
    assert table.weak_form.residuals == expressions.weak_form.residuals


def test_a_full_mass_matrix_is_inverted():
    n = N
    mass = np.eye(n) + 0.1 * (np.eye(n, k=1) + np.eye(n, k=-1))
    problem = chain(M=mass)
    system = ro.compile(problem).system
    u, p = np.random.default_rng(0).random((2 * n, 1)), np.array([[1.5], [0.15], [0.7]])
    q, v = np.split(u[:, 0], 2)
    spring = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    pull = 1.5 * np.exp(-0.4 / 3) * spring @ q + 0.2 * q + 0.15 * np.linspace(0.1, 1, n) * v
    expected = np.linalg.solve(mass, 0.7 * np.sin(0.4) - pull)
    np.testing.assert_allclose(system.rhs(0.4, u, p)[n:, 0], expected, rtol=1e-12)


def test_what_uses_the_equations_still_does(tmp_path):
    problem = chain()
    path = problem.save(tmp_path / "chain.toml")
    assert written_out(problem) == problem
    assert pickle.loads(pickle.dumps(problem)) == problem
    assert repr(problem).startswith(f"Problem: {N} unknowns, 3 parameters\n  ")
    narrow = problem.vary(k=(1.2, 1.3))
    assert narrow.table is not None
    assert narrow.parameters[K] == (1.2, 1.3)
    at = {"k": 1.2, "c": 0.1, "f": 0.5}
    trajectory = problem.trajectory([2.0], **at)
    assert trajectory.values.shape == (N, 1)
    assert path.read_text().count("q1_tt") > 0


def test_what_is_wrong_is_said_as_for_few_states():
    with pytest.raises(ro.ProblemError, match=r"unknown symbol `z`"):
        chain(K={sp.Symbol("z"): np.eye(N)})
    with pytest.raises(ro.ProblemError, match=r"initial value of .*q3.* has a problem"):
        chain(initial={"q3": sp.Symbol("z")})
    with pytest.raises(ro.ProblemError, match="initial is"):
        chain(initial=np.zeros(3))
    with pytest.raises(ro.ProblemError, match="belongs both to"):
        chain(names=["k", *(f"q{i}" for i in range(1, N))])
    with pytest.raises(ro.ProblemError, match="not finite"):
        chain(force=np.full(N, np.nan))
    with pytest.raises(ro.ProblemError, match="not finite"):
        ro.compile(chain(K={1 / (K - sp.Rational(3, 2)): np.eye(N)}))
    with pytest.raises(ro.ProblemError, match="is not needed"):
        chain(M=np.diag([0.0, *np.ones(N - 1)]))
    with pytest.warns(ro.RankoneWarning, match="`m` appears nowhere"):
        chain(parameters={K: (1, 2), C: (0.1, 0.2), F: (0.5, 1), M: (1, 2)})


@pytest.mark.parametrize(
    "changed",
    [
        {"jumps": {1.0: {sp.Function("q0")(T): 1}}},
        {"constants": {sp.Symbol("g"): 1.0}},
        {"K": {sp.Abs(K - 1.5): scipy.sparse.eye(N)}},
        {"K": sp.eye(N)},
        {"M": {K: np.eye(N)}},
    ],
)
def test_what_no_table_holds_is_compiled_from_equations(changed):
    problem = chain(**changed)
    assert problem.table is None
    assert np.isfinite(ro.compile(problem).system.initial(np.ones((3, 1)))).all()


@pytest.mark.slow
def test_numbers_for_parameters_keep_the_table():
    n = FEWEST_TABULATED
    problem = chain(n)
    changed = problem.set({C: 0.15}).set({C: 0.12, F: 0.7})
    assert changed.table is not None
    assert changed.constants == {C: sp.Rational(3, 25), F: sp.Rational(7, 10)}
    other = ro.Problem(
        list(problem.equations),
        problem.time,
        {K: (1, 2)},
        dict(problem.initial),
        constants={C: 0.12, F: 0.7},
    )
    assert other.table is None
    ours, theirs, k = ro.compile(changed).system, ro.compile(other).system, np.array([[1.3]])
    u = np.random.default_rng(1).random((2 * n, 1))
    np.testing.assert_allclose(ours.rhs(0.4, u, k), theirs.rhs(0.4, u, k), rtol=1e-13)
    np.testing.assert_allclose(ours.initial(k), theirs.initial(k), rtol=1e-13)
    freed = changed.vary({C: (0.1, 0.2), F: (0.5, 1)})
    assert freed.table is not None
    assert ro.compile(freed).source.count("\n") == ro.compile(problem).source.count("\n")
    assert problem.set({C: 0.0}).table is None  # terms vanish


@pytest.mark.parametrize(
    "law",
    [
        pytest.param("k*x{0}/(h + x{0})", marks=pytest.mark.slow),
        "k*x{0}*x{1}",
        pytest.param("tanh(k*x{0} - h)", marks=pytest.mark.slow),
    ],
)
def test_numbers_in_texts_keep_the_table(law, tmp_path):
    n = FEWEST_TABULATED
    rates = {f"x{i}": f"{law.format((i + 1) % n, i)} - x{i}" for i in range(n)}
    start = dict.fromkeys(rates, "h/2")
    problem = ro.Problem.from_strings(rates, start, {"k": (1, 2), "h": (1, 2)}, (0, 1))
    changed = problem.set(h=1.5)
    assert changed.table is not None
    ours, theirs, u = ro.compile(changed).system, ro.compile(problem).system, np.full((n, 1), 0.4)
    few, all_of_them = np.array([[1.2]]), np.array([[1.2], [1.5]])
    np.testing.assert_allclose(ours.rhs(0, u, few), theirs.rhs(0, u, all_of_them), rtol=1e-13)
    np.testing.assert_allclose(ours.initial(few), theirs.initial(all_of_them))
    again = pickle.loads(pickle.dumps(changed))
    assert again.table is not None
    assert again == changed != problem.set(h=1.6)
    written = ro.Problem.from_strings(rates, start, {"k": (1, 2)}, (0, 1), constants={"h": 1.5})
    assert (changed, hash(changed)) == (written, hash(written))
    assert changed.save(tmp_path / "few.toml").exists()


def test_tables_are_compared_with_the_generated_code():
    problem, other = chain(), chain(K={K: 1.001 * np.eye(N)})
    with pytest.raises(DisagreementError, match="generated rate"):
        check_table(problem, problem.table, ro.compile(other).system)


@pytest.mark.parametrize("law", ["k*x{0}/(1.{1} + x{0})", "k*x{0}*x{1}"])
def test_pickles_keep_tables_and_write_nothing(law, monkeypatch):
    n = FEWEST_TABULATED
    rates = {f"x{i}": f"{law.format((i + 1) % n, i)} - x{i}" for i in range(n)}
    initial = dict.fromkeys(rates, "0.5")
    problem = ro.Problem.from_strings(rates, initial, {"k": (0.5, 1)}, (0, 1))
    compiled = ro.compile(problem)

    def never(self):
        raise AssertionError("what was deferred is read")

    with monkeypatch.context() as patch:
        patch.setattr(Deferred, "_items", property(never))
        again = pickle.loads(pickle.dumps(compiled))
        assert again.problem.table.terms == problem.table.terms
    assert again.problem == problem
    assert again.source == compiled.source
    assert str(again.first_order) == str(compiled.first_order)
    at = 0.2, np.linspace(0.1, 1.0, n), np.array([0.7])
    np.testing.assert_array_equal(again.system.rhs(*at), compiled.system.rhs(*at))
