"""Fields, matrices applied to them, and the checks of problems that have them."""

import copy
import pickle

import numpy as np
import pytest
import scipy.sparse as ss
import sympy as sp

import rankone as ro
from rankone.problem.fields import Apply, Vector, size_of

t, s, k, D = sp.symbols("t s k D")
N = 6


def second_difference(n=N):
    ones = np.ones(n)
    return ss.diags_array([ones[1:], -2 * ones, ones[1:]], offsets=(-1, 0, 1))


u, v = ro.field("u", N), ro.field("v", N)
L = second_difference()
x = sp.Function("x")(t)


def heat(equations=None, initial=None, **further):
    equations = {u: D * ro.apply(L, u)} if equations is None else equations
    box = further.pop("parameters", {D: (1, 2)})
    return ro.Problem(equations, (t, 0, 1), box, {u: 1} if initial is None else initial, **further)


class TestExpressions:
    def test_a_field_is_a_symbol_with_a_size(self):
        assert isinstance(u, sp.Symbol)
        assert (u.name, u.size, str(u)) == ("u", N, "u")
        assert u == ro.field("u", N)
        assert u != ro.field("u", N + 1)
        assert u != sp.Symbol("u", real=True)

    @pytest.mark.parametrize("time", [t, s, sp.Symbol("t", positive=True)])
    def test_derivatives_in_time(self, time):
        rate = u.diff(time)
        assert (rate.expr, rate.variables, rate.derivative_count) == (u, (time,), 1)
        assert u.diff(time, 2) == rate.diff(time) == u.diff(time, time) == u.diff((time, 2))
        assert str(rate) == f"du/d{time}"
        assert str(u.diff(time, 2)) == f"d²u/d{time}²"
        assert u.diff(time, 0) == u

    def test_derivatives_by_the_field_are_elementwise(self):
        assert sp.diff(u**2 * v, u) == 2 * u * v

    def test_equal_matrices_are_one(self):
        dense, sparse = L.toarray(), ss.coo_array(L)
        assert ro.apply(dense, u) == ro.apply(sparse, u) == ro.apply(L, u)
        assert hash(ro.apply(dense, u)) == hash(ro.apply(L, u))
        assert ro.apply(2 * L, u) != ro.apply(L, u)

    def test_a_matrix_is_copied_and_read_only(self):
        matrix = np.eye(N)
        applied = ro.apply(matrix, u)
        matrix[0, 0] = 7.0
        assert applied == ro.apply(np.eye(N), u)
        with pytest.raises(ValueError, match="read-only"):
            applied.operator.matrix.data[0] = 7.0

    def test_prints_in_one_line(self):
        assert str(ro.apply(L, u) * k) == f"k*apply(<{N} x {N}>, u)"

    def test_vectors_multiply_entry_by_entry(self):
        weights = ro.apply(np.arange(N), 1)
        assert isinstance(weights, Vector)
        assert ro.apply(np.arange(N), k * u) == k * u * weights
        assert ro.apply(list(range(N)), 1) == weights

    def test_a_matrix_before_a_field_is_applied(self):
        for matrix in (L.toarray(), L, ss.csr_matrix(L)):
            assert matrix @ u == ro.apply(L, u)
            assert matrix @ (L @ u) == ro.apply(L, ro.apply(L, u))
        assert np.ones(N) @ u == ro.apply(np.ones((1, N)), u)

    def test_arrays_are_combined_entry_by_entry(self):
        numbers = np.arange(1.0, N + 1)
        vector = ro.apply(numbers, 1)
        assert numbers * u == u * numbers == ro.apply(numbers, u)
        assert numbers + u == u + numbers == u + vector
        assert numbers - u == -(u - numbers) == vector - u
        assert numbers / u == vector / u
        assert u / numbers == u / vector
        assert np.float64(2.0) * u == 2.0 * u
        assert numbers * (L @ u) == ro.apply(numbers, ro.apply(L, u))

    def test_a_field_is_a_function_of_time_already(self):
        assert u(t) is u
        assert not isinstance(np.array([u, u])[0], list)
        with pytest.raises(TypeError, match="not iterable"):
            list(u)

    def test_sizes(self):
        assert size_of(u * k + sp.exp(v)) == N
        assert size_of(ro.apply(np.ones((1, N)), u)) == 1
        assert size_of(ro.apply(np.ones((N, 1)), x)) == N
        assert size_of(ro.apply(np.ones((3, N)), u) * k) == 3
        assert size_of(x * k) == 1
        assert ro.apply(L, 0) == 0

    @pytest.mark.parametrize("copied", [lambda e: pickle.loads(pickle.dumps(e)), copy.deepcopy])
    def test_pickles(self, copied):
        expression = u.diff(t) + ro.apply(L, u * v) * ro.apply(np.arange(N), 1)
        assert copied(expression) == expression
        assert copied(u).size == N

    def test_replacing_a_field_reaches_what_matrices_are_applied_to(self):
        assert ro.apply(L, u**2).xreplace({u: v}) == ro.apply(L, v**2)
        assert isinstance(ro.apply(L, u), Apply)

    @pytest.mark.parametrize(
        ("build", "message"),
        [
            (lambda: ro.field("", N), "the name of a field is ''"),
            (lambda: ro.field("a\nb", N), "not text in one line"),
            (lambda: ro.field(3, N), "the name of a field is 3"),
            (lambda: ro.field("u", 0), "the field `u` has 0 entries"),
            (lambda: ro.field("u", 2.5), "the field `u` has 2.5 entries"),
            (lambda: ro.field("u", True), "the field `u` has True entries"),
            (lambda: ro.apply(np.eye(4), u), "a matrix of 4 columns, `<4 x 4>`, is applied to `u`"),
            (lambda: ro.apply([1, 2], u), "a vector of 2 entries is applied to `u`, which has 6"),
            (lambda: ro.apply(np.eye(N) * 1j, u), "has complex entries"),
            (lambda: ro.apply(ss.eye_array(N) * 1j, u), "has complex entries"),
            (lambda: ro.apply(np.full((N, N), np.nan), u), "entries that are not finite"),
            (lambda: ro.apply(np.full(N, np.inf), u), "entries that are not finite"),
            (lambda: ro.apply(np.zeros((N, N, 1)), u), "the matrix of `apply` is"),
            (lambda: ro.apply([[1, 2], [3]], u), "the matrix of `apply` is"),
            (lambda: ro.apply("L", u), "the matrix of `apply` is 'L'"),
            (lambda: ro.apply(np.zeros((0, N)), u), "the matrix of `apply` is"),
            (lambda: ro.apply(L, "u"), "which is not an expression"),
            (lambda: L * u, "an array of 6 x 6 is combined entry by entry with `u`"),
            (lambda: np.ones(3) * u, "an array of 3 is combined entry by entry with `u`"),
            (lambda: np.eye(4) @ u, "a matrix of 4 columns"),
            (lambda: u[3], r"`u[3]`: expressions of fields are not divided"),
            (lambda: u(0), r"`u(0)` is no expression"),
            (lambda: ro.apply(L, u + ro.field("w", 3)), "`w` has 3 entries, and `u` beside it"),
        ],
    )
    def test_errors(self, build, message):
        with pytest.raises(ro.ProblemError, match="remedy") as raised:
            build()
        assert message in str(raised.value)


class TestProblems:
    def test_a_mapping_is_short_for_equations(self):
        assert isinstance(heat(), ro.FieldProblem)
        assert heat() == heat([sp.Eq(u.diff(t), D * ro.apply(L, u))])
        assert hash(heat()) == hash(heat([sp.Eq(u.diff(t), D * ro.apply(L, u))]))
        assert heat() != heat(initial={u: 2})

    def test_scalar_problems_stay_what_they_are(self):
        problem = ro.Problem([sp.Eq(x.diff(t), -k * x)], (t, 0, 1), {k: (1, 2)}, {x: 1})
        assert type(problem) is ro.Problem

    def test_repr(self):
        problem = heat(
            {u: D * ro.apply(L, u) - k * u}, constants={k: 2}, units={t: "s"}, name="rod"
        )
        assert repr(problem).splitlines() == [
            "Problem 'rod': 1 field of 6 entries, 1 parameter",
            "  du/dt = -u*k + D*apply(<6 x 6>, u)",
            "  u(0) = 1",
            "  t in [0, 1] s, D in [1, 2]",
            "  k = 2",
        ]

    def test_a_field_of_one_entry(self):
        w = ro.field("w", 1)
        problem = ro.Problem({w: -D * w}, (t, 0, 1), {D: (1, 2)}, {w: 1})
        assert repr(problem).startswith("Problem: 1 field of 1 entry, 1 parameter")

    def test_second_order(self):
        problem = heat(
            [sp.Eq(u.diff(t, 2) + k * u.diff(t), ro.apply(L, u))],
            {u: 0, u.diff(t): np.arange(N)},
            parameters={k: (1, 2)},
        )
        velocity = ro.field("u_t", N)
        assert problem.unknowns == (u,)
        assert dict(problem.rates) == {u: velocity, velocity: ro.apply(L, u) - k * velocity}
        assert [*problem.initial] == [u, velocity]
        assert problem.size == 2 * N

    def test_a_scalar_beside_a_field(self):
        mean = ro.apply(np.ones((1, N)) / N, u)
        problem = heat({u: D * ro.apply(L, u) + x, x: mean - x}, {u: 1, x: 0})
        assert problem.unknowns == (u, x)
        assert problem.fields == (u,)

    def test_factors_of_derivatives(self):
        capacity = ro.apply(np.arange(1, N + 1), 1)
        problem = heat([sp.Eq(2 * capacity * u.diff(t), ro.apply(L, u))], parameters={})
        assert problem.rates[u] == ro.apply(L, u) / (2 * capacity)

    def test_constants_and_definitions_are_put_in(self):
        flux = sp.Symbol("flux")
        problem = heat({u: flux}, constants={k: 2}, definitions={flux: D * k * ro.apply(L, u)})
        assert problem.rates[u] == 2 * D * ro.apply(L, u)
        assert problem.set(k=3).rates[u] == 3 * D * ro.apply(L, u)
        assert problem.vary(k=(1, 2)).rates[u] == k * D * ro.apply(L, u)

    def test_immutable_and_pickled(self):
        problem = heat(mass={u: ss.eye_array(N) * 2})
        assert pickle.loads(pickle.dumps(problem)) == problem
        with pytest.raises(AttributeError):
            problem.rates = {}

    def test_mass_of_a_velocity(self):
        problem = heat([sp.Eq(u.diff(t, 2), ro.apply(L, u) * D)], {u: 0, "u_t": 0}, mass={"u": L})
        assert [state.name for state in problem.masses] == ["u_t"]

    @pytest.mark.parametrize(
        ("equations", "initial", "further", "message"),
        [
            (None, ro.SteadyState({}, start={u: 1}), {}, "fields do not start at steady states"),
            ([sp.Eq(u.diff(t), u), sp.Eq(v, u)], {u: 1, v: 1}, {}, "it has 0 highest derivatives"),
            ([sp.Eq(u.diff(t), v.diff(t))], {u: 1, v: 1}, {}, "it has 2 highest derivatives"),
            ([sp.Eq(u.diff(t), u)] * 2, None, {}, "`u` is given a rate twice"),
            ([sp.Eq(u.diff(s), u)], None, {}, "`du/ds` is not a derivative in the time `t`"),
            ([sp.Eq(u.diff(t, 3), u)], None, {}, "`u` has a derivative of order 3"),
            (
                [sp.Eq(u.diff(t), u), sp.Eq(x.diff(t, 2), 1)],
                {u: 1, x: 0},
                {},
                "`x(t)` has a derivative of order 2",
            ),
            ([sp.Eq(u * u.diff(t), 1)], None, {}, "the factor `u` of `du/dt` has unknowns"),
            (
                [sp.Eq(ro.apply(L, u.diff(t)), u)],
                None,
                {},
                "`du/dt` is inside of a function or a matrix",
            ),
            ({u: u * v}, None, {}, "`v` has no equation"),
            ({u: u * ro.field("u", N + 1)}, None, {}, "has 6 entries, and `u` beside it has 7"),
            ({u: ro.apply(np.ones((3, N)), u)}, None, {}, "which has 6 entries, has 3"),
            ({x: u, u: u}, {u: 1, x: 1}, {}, "the rate of `x(t)`, which has 1 entry, has 6"),
            ({u: k * u}, None, {}, "unknown symbol `k`"),
            ({u: sp.Symbol("u") * u}, None, {}, "symbol `u` is not the unknown of that name"),
            ({"u": u}, None, {}, "'u' is given a rate, but is neither a field nor"),
            ({u: "u"}, None, {}, "the rate of `u` is 'u', not an expression"),
            ({u: sp.Heaviside(u - 1)}, None, {}, "`Heaviside(u - 1)` is not smooth"),
            ({u: u * sp.sign(t - 1)}, None, {}, "is not smooth"),
            ({u: sp.Abs(u - v), v: u}, {u: 1, v: 1}, {}, "is not smooth"),
            ({u: sp.Max(u, 0)}, None, {}, "is not smooth"),
            ({u: sp.Piecewise((1, t < 0.5), (u, True))}, None, {}, "is not smooth"),
            ({u: ro.table([0, 1], [1, 2])(t) * u}, None, {}, "is a table or a function"),
            (None, {v: 1}, {}, "the key v of `initial` is no unknown"),
            (None, {"w": 1, u: 1}, {}, "the key 'w' of `initial` is no unknown"),
            (None, {u.diff(t): 1, u: 1}, {}, "the initial value of `du/dt` is not needed"),
            ({u: v, v: u}, {u: 1}, {}, "no initial value for `v`"),
            (None, {u: np.ones(N + 1)}, {}, "the initial value of `u` has 7 entries"),
            (None, {u: np.ones((N, 1))}, {}, "the initial value of `u` has the shape (6, 1)"),
            (
                None,
                {u: np.full(N, np.nan)},
                {},
                "the initial value of `u` has entries that are not",
            ),
            (None, {u: "1"}, {}, "the initial value of `u` is '1'"),
            (None, {u: k}, {}, "unknown symbol `k`"),
            (None, {u: t}, {}, "the initial value of `u` names the time `t`"),
            ({u: v, v: u}, {u: v, v: 1}, {}, "the initial value of `u` names `v`"),
            (None, {u: sp.oo}, {}, "is not a finite real number"),
            (None, {u: 1}, {"mass": {v: L}}, "mass has v, which is no field"),
            (None, {u: 1}, {"mass": L}, "not a mapping"),
            (None, {u: 1}, {"mass": {u: np.eye(3)}}, "the mass matrix of `u` is 3 x 3"),
            (
                None,
                {u: 1},
                {"mass": {u: np.diag([0.0] + [1.0] * 5)}},
                "the mass matrix of `u` is si",
            ),
            (None, {u: 1}, {"name": 3}, "the name is 3"),
            (None, {u: 1}, {"parameters": {sp.Symbol("u"): (1, 2)}}, "belongs both to"),
            (None, {u: 1}, {"atol": {v: 1e-3}}, "atol has `v`"),
        ],
    )
    def test_errors(self, equations, initial, further, message):
        with pytest.raises(ro.ProblemError) as raised:
            heat(equations, initial, **further)
        assert message in str(raised.value)

    def test_a_mass_needs_fields(self):
        with pytest.raises(ro.ProblemError, match="the problem has no fields"):
            ro.Problem([sp.Eq(x.diff(t), -x)], (t, 0, 1), {}, {x: 1}, mass={x: np.eye(1)})

    def test_unused_parameters_are_named(self):
        with pytest.warns(ro.RankoneWarning, match="parameter `k` appears nowhere"):
            heat(parameters={D: (1, 2), k: (1, 2)})
