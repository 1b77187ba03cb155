"""Systems of fields against right-hand sides that are written by hand in NumPy."""

import pickle

import numpy as np
import pytest
import scipy.sparse as ss
import sympy as sp

import rankone as ro
from rankone.compiler.agreement import DisagreementError
from rankone.compiler.field_agreement import check_field_agreement
from rankone.compiler.field_lowering import field_system
from rankone.problem.fields import constant_of

t, q, D, D2, A, B, nu, E, K = sp.symbols("t q D D2 A B nu E K")
N = 12
ones = np.ones(N)
L = ss.csr_array(ss.diags_array([ones[1:], -2 * ones, ones[1:]], offsets=(-1, 0, 1)))
G = ss.csr_array(ss.diags_array([-ones[1:], ones[1:]], offsets=(-1, 1)) * 0.5)
u, v = ro.field("u", N), ro.field("v", N)
x = sp.Function("x")(t)
place = np.linspace(0.1, 1.0, N)


def heat():
    """Two conductivities and a source."""
    left = ss.csr_array(L.multiply(np.arange(N)[:, None] < N // 2))
    right = ss.csr_array(L - left)
    hot = np.exp(-((place - 0.5) ** 2))
    problem = ro.Problem(
        {u: D * ro.apply(left, u) + D2 * ro.apply(right, u) + q * sp.cos(t) * ro.apply(hot, 1)},
        (t, 0, 1),
        {D: (1, 2), D2: (1, 2), q: (0.5, 1)},
        {u: 0},
    )

    def rates(t, y, p):
        return p[0] * left @ y + p[1] * right @ y + p[2] * np.cos(t) * hot

    return problem, rates, (2, 1, 0)


def brusselator():
    problem = ro.Problem(
        {
            u: D * ro.apply(L, u) + A - (B + 1) * u + u**2 * v,
            v: 8 * D * ro.apply(L, v) + B * u - u**2 * v,
        },
        (t, 0, 1),
        {A: (1, 2), B: (2, 3)},
        {u: A * ro.apply(place, 1) + 1, v: place},
        constants={D: 0.1},
    )

    def rates(t, y, p):
        u, v = y[:N], y[N:]
        cubic = u**2 * v
        return np.concatenate(
            [
                0.1 * L @ u + p[0] - (p[1] + 1) * u + cubic,
                0.8 * L @ v + p[1] * u - cubic,
            ]
        )

    return problem, rates, (3, 1, 1)


def burgers():
    problem = ro.Problem(
        {u: -u * ro.apply(G, u) + nu * ro.apply(L, u)},
        (t, 0, 1),
        {nu: (0.01, 0.1)},
        {u: np.sin(place)},
    )
    return problem, lambda t, y, p: -y * (G @ y) + p[0] * (L @ y), (1, 0, 1)


def nerve():
    """FitzHugh and Nagumo, with a current at one end."""
    entry = np.zeros((N, 1))
    entry[0] = 2.0
    problem = ro.Problem(
        {
            u: (E**2 * ro.apply(L, u) + u * (u - 0.1) * (1 - u) - v) / E + ro.apply(entry, q * t),
            v: A * u - B * v + 0.05,
        },
        (t, 0, 1),
        {E: (0.01, 0.02), A: (0.4, 0.6), B: (1.8, 2.2), q: (1, 2)},
        {u: 0, v: 0},
    )

    def rates(t, y, p):
        u, v = y[:N], y[N:]
        current = np.zeros(N)
        current[0] = 2.0 * p[3] * t
        first = (p[0] ** 2 * (L @ u) + u * (u - 0.1) * (1 - u) - v) / p[0] + current
        return np.concatenate([first, p[1] * u - p[2] * v + 0.05])

    return problem, rates, (4, 2, 1)


def reactor():
    """Non-uniform coefficients, conservative and saturating terms, matrices inside of matrices."""
    problem = ro.Problem(
        {
            u: ro.apply(G, (1 + D * u) * ro.apply(G, u))
            - ro.apply(place, u**2)
            - A * sp.exp(-E / (u + 2)) * u / (K + u)
            + ro.apply(L, D * ro.apply(place, ro.apply(L, u) - 3))
            + sp.exp(-E * ro.apply(place, 1))
        },
        (t, 0, 1),
        {D: (1, 2), A: (1, 2), E: (1, 2), K: (1, 2)},
        {u: place},
    )

    def rates(t, y, p):
        return (
            G @ ((1 + p[0] * y) * (G @ y))
            - place * y**2
            - p[1] * np.exp(-p[2] / (y + 2)) * y / (p[3] + y)
            + L @ (p[0] * place * (L @ y - 3))
            + np.exp(-p[2] * place)
        )

    return problem, rates, (2, 1, 4)


def controlled():
    """A heater that follows the mean temperature, and heats and cools what it is beside."""
    mean = ro.apply(np.full((1, N), 1 / N), u)
    problem = ro.Problem(
        {u: ro.apply(L, u) + q * x + x * u - mean * u**2, x: 1 - mean + sp.sin(x)},
        (t, 0, 1),
        {q: (1, 2)},
        {u: place, x: 0.5},
    )

    def rates(t, y, p):
        u, x = y[:N], y[N]
        return np.append(L @ u + p[0] * x + x * u - u.mean() * u**2, 1 - u.mean() + np.sin(x))

    return problem, rates, (2, 1, 2)


def wave():
    problem = ro.Problem(
        [sp.Eq(2 * u.diff(t, 2) + q * u.diff(t), ro.apply(L, u) - u**3)],
        (t, 0, 1),
        {q: (1, 2)},
        {u: place, u.diff(t): 0},
    )

    def rates(t, y, p):
        u, w = y[:N], y[N:]
        return np.concatenate([w, (L @ u - u**3 - p[0] * w) / 2])

    return problem, rates, (2, 0, 1)


CASES = [heat, brusselator, burgers, nerve, reactor, controlled, wave]


def state_of(system, seed=0):
    rng = np.random.default_rng(seed)
    lower, upper = np.array(system.box).T
    p = lower + rng.random(lower.size) * (upper - lower)
    return rng.random(), 0.5 + rng.random(system.size), p


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_rates_and_jacobians(case):
    problem, rates, counts = case()
    system = field_system(problem)
    assert (len(system.linear), len(system.sources), len(system.pointwise)) == counts
    time, u, p = state_of(system)
    expected = rates(time, u, p)
    size = np.abs(expected).max()
    assert np.abs(system.at(p).force(time, u) - expected).max() <= 1e-13 * size
    direction = np.random.default_rng(1).standard_normal(system.size)
    step = 1e-6
    change = (rates(time, u + step * direction, p) - rates(time, u - step * direction, p)) / step
    slopes = system.at(p).jacobian(time, u) @ direction
    assert np.abs(slopes - change / 2).max() <= 1e-7 * np.abs(slopes).max()


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_functions_broadcast(case):
    system = field_system(case()[0])
    states = [state_of(system, seed) for seed in range(3)]
    times, values, points = (np.array(column) for column in zip(*states, strict=True))
    together = system.coefficients(times, points.T)
    for i, (time, u, p) in enumerate(states):
        alone = system.coefficients(time, p)
        assert alone[0] == 1.0
        assert np.array_equal(together[:, i], alone)
        assert np.array_equal(system.coefficients(times, p)[:, i], alone) or case is not heat
        for term in system.pointwise:
            arguments = [matrix @ u for matrix in term.arguments]
            stacked = [matrix @ values.T for matrix in term.arguments]
            for name in (term.function, f"{term.function}_slopes"):
                function = system.elementwise(name)
                one = function(time, [*arguments, *term.vectors], p)
                all_three = function(times, [*stacked, *term.vectors[:, :, None]], points.T)
                assert np.allclose(all_three[..., i], one, rtol=1e-14)
                assert one.shape[-1] == term.after.shape[1]


def test_initial_values():
    system = field_system(brusselator()[0])
    start = system.initial(np.array([1.5, 2.5]))
    assert np.allclose(start, [*(1.5 * place + 1), *place], rtol=1e-15)


def test_initial_shapes_that_move():
    n = 200
    w, grid = ro.field("w", n), np.linspace(0.0, 1.0, n)
    width = sp.Symbol("width")
    shape = q * sp.exp(-(((ro.apply(grid, 1) - A) / width) ** 2)) + A
    problem = ro.Problem(
        {w: -w},
        (t, 0, 1),
        {q: (1, 2), A: (0.3, 0.7), width: (0.1, 0.2, "log")},
        {w: shape},
    )
    system = field_system(problem)
    assert system.initial_vectors.shape[1] <= 40
    for p in np.random.default_rng(0).random((20, 3)):
        q_, centre, size = 1 + p[0], 0.3 + 0.4 * p[1], 0.1 + 0.1 * p[2]
        expected = q_ * np.exp(-(((grid - centre) / size) ** 2)) + centre
        start = system.initial(np.array([q_, centre, size]))
        assert np.abs(start - expected).max() <= 1e-8 * expected.max()


def test_mass_matrices_are_stacked():
    mass = ss.diags_array([ones[1:], 4 * ones, ones[1:]], offsets=(-1, 0, 1)) / 6
    problem = ro.Problem({u: -ro.apply(L, u), v: u}, (t, 0, 1), {}, {u: 1, v: 0}, mass={u: mass})
    system = field_system(problem)
    expected = ss.block_diag([mass, ss.eye_array(N)])
    assert abs(system.mass - expected).max() == 0.0
    assert field_system(heat()[0]).mass is None


def test_what_is_multiplied_out():
    """Parameters stay outside of functions wherever they factor."""
    problem = ro.Problem(
        {u: A * u * (1 - u / B) + D * u**2 * v - D * u**2, v: -D * u**2 * v},
        (t, 0, 1),
        {A: (1, 2), B: (1, 2), D: (1, 2)},
        {u: 1, v: 1},
    )
    system = field_system(problem)
    assert len(system.linear) == 1
    assert "p" not in "".join(
        line for line in system.source.splitlines() if "return a" in line
    ).replace("np.", "")
    assert sorted(term.after.nnz for term in system.pointwise) == [N, N, N]


def test_functions_with_one_coefficient_are_one():
    problem = ro.Problem(
        {u: sp.sin(u) - 2 * u**3 + u * v, v: 0.5 * v**2}, (t, 0, 1), {}, {u: 1, v: 1}
    )
    assert len(field_system(problem).pointwise) == 2


def test_stress_of_a_deformed_body_is_one_function_for_each_component():
    """St. Venant and Kirchhoff in the plane: the displacement is two fields."""
    rng = np.random.default_rng(0)
    quadrature = 20
    gradients = [constant_of(rng.random((quadrature, N))) for _ in range(2)]
    assembly = [constant_of(rng.random((N, quadrature))) for _ in range(2)]
    F = sp.Matrix(2, 2, lambda i, j: int(i == j) + ro.apply(gradients[j], (u, v)[i]))
    strain = (F.T * F - sp.eye(2)) / 2
    stress = F * (A * strain.trace() * sp.eye(2) + 2 * B * strain)
    problem = ro.Problem(
        {
            unknown: -sum(ro.apply(assembly[j], stress[i, j]) for j in range(2)) + q
            for i, unknown in enumerate((u, v))
        },
        (t, 0, 1),
        {A: (1, 2), B: (1, 2), q: (0, 1)},
        {u: 0, v: 0},
    )
    system = field_system(problem)
    assert (len(system.linear), len(system.sources), len(system.pointwise)) == (2, 1, 8)


def test_sums_of_matrices_times_functions_are_multiplied_out():
    problem = ro.Problem(
        {u: A * (ro.apply(L, u**2) + u**2) + A * u * (u + 1)}, (t, 0, 1), {A: (1, 2)}, {u: 1}
    )
    system = field_system(problem)
    assert (len(system.linear), len(system.pointwise)) == (1, 1)


def test_numbers_are_no_coefficients():
    problem = ro.Problem({u: sp.pi * u + sp.sqrt(2) * u**3 + u}, (t, 0, 1), {}, {u: 1})
    system = field_system(problem)
    assert [term.coefficient for term in (*system.linear, *system.pointwise)] == [0, 0]


def test_large_fields_take_no_more_text():
    lengths = []
    for n in (10, 1000):
        w = ro.field("w", n)
        problem = ro.Problem(
            {w: D * ro.apply(ss.eye_array(n), w) - w**3}, (t, 0, 1), {D: (1, 2)}, {w: 1}
        )
        lengths.append(len(field_system(problem).source))
    assert lengths[0] == lengths[1]


def test_pickles():
    system = pickle.loads(pickle.dumps(field_system(brusselator()[0])))
    assert system.source == field_system(brusselator()[0]).source


@pytest.mark.parametrize(
    ("rate", "start", "message"),
    [
        (u * ro.apply(L, u**2), 1, "is inside of a function or a product of fields"),
        (sp.exp(ro.apply(L, sp.sin(u))), 1, "is inside of a function or a product of fields"),
    ],
)
def test_errors(rate, start, message):
    problem = ro.Problem({u: rate + q}, (t, 0, 1), {q: (1, 2)}, {u: start})
    with pytest.raises(ro.SeparationError, match=message):
        field_system(problem)


def test_initial_shapes_that_are_too_sharp_are_refused():
    n = 1000
    w, grid = ro.field("w", n), np.linspace(0.0, 1.0, n)
    start = sp.exp(-(((ro.apply(grid, 1) - q) / 2e-3) ** 2))
    with pytest.raises(ro.SeparationError, match="no sum of arrays times functions of parameters"):
        field_system(ro.Problem({w: -w}, (t, 0, 1), {q: (0, 1)}, {w: start}))


def test_dense_sums_are_refused():
    n = 30_000
    w = ro.field("w", n)
    mean = ro.apply(np.ones((1, n)), w)
    with pytest.raises(ro.SeparationError, match="a sum over 30000 entries enters"):
        field_system(ro.Problem({w: mean - w}, (t, 0, 1), {}, {w: 1}))


class TestAgreement:
    """What is wrong in a system is seen by comparing it with the tree."""

    def places(self, system):
        states = {unknown.name: unknown.rows for unknown in system.unknowns}
        return {u: states["u"], v: states["v"]}

    def changed(self, **parts):
        problem = brusselator()[0]
        system = field_system(problem)
        wrong = type(system)(
            **{name: parts.get(name, getattr(system, name)) for name in system.__dataclass_fields__}
        )
        return problem, wrong

    @pytest.mark.parametrize(
        ("text", "wrong", "message"),
        [
            ("return a0**2 * a1", "return a0**2 * a1 * 1.001", "does not compute the rate"),
            ("rows[0] = 2 * a0 * a1", "rows[0] = a0 * a1", "the derivative of the rate"),
            ("rows[1] = a0**2\n", "rows[1] = a0**3\n", "the derivative of the rate"),
            ("rows[1] = p0\n    return rows", "rows[1] = p1\n    return rows", "initial value"),
        ],
    )
    def test_text(self, text, wrong, message):
        source = field_system(brusselator()[0]).source
        assert text in source
        head, _, tail = source.rpartition(text)
        problem, system = self.changed(source=head + wrong + tail)
        with pytest.raises(DisagreementError, match=message):
            check_field_agreement(problem, system, self.places(system))

    @pytest.mark.parametrize("start", [0, 1e-9 * place, place**4])
    def test_small_states_are_no_disagreement(self, start):
        rate = u**6 - A * u**3 + u * ro.apply(L, u)
        field_system(ro.Problem({u: rate}, (t, 0, 1), {A: (1, 2)}, {u: start}))

    @pytest.mark.parametrize(
        ("rate", "start"),
        [
            (sp.sqrt(u) - u, 0),
            (sp.exp(700 / u) * A, 300.0),
            (-sp.exp(-9000 / u) * A + ro.apply(L, u), 300.0 * place),
            (A * u**2 - u**3 / 1e-9, 1e-9 * place),
            (sp.log(u) * A, 1e-3),
            (sp.erf(u) + sp.asin(u / 3) + sp.besselj(0, u) * A, place),
        ],
    )
    def test_states_of_any_size(self, rate, start):
        field_system(ro.Problem({u: rate + A}, (t, 0, 1), {A: (1, 2)}, {u: start}))

    def test_matrices(self):
        linear = field_system(brusselator()[0]).linear
        problem, system = self.changed(linear=linear[1:])
        with pytest.raises(DisagreementError, match="does not compute the rate"):
            check_field_agreement(problem, system, self.places(system))
