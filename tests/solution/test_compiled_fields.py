"""Problems with fields, compiled and solved as others are."""

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.sparse as ss
import sympy as sp

import rankone as ro

N = 70
T, K, Q = sp.symbols("t k q")
U = ro.field("u", N)
X = np.linspace(0, 1, N + 2)[1:-1]
LAPLACIAN = ss.diags_array([1.0, -2, 1], offsets=[-1, 0, 1], shape=(N, N)) * (N + 1) ** 2
HEAT = np.exp(-((X - 0.3) ** 2) * 50)


@pytest.fixture(scope="module")
def problem():
    rate = K * ro.apply(LAPLACIAN, U) - U**3 + ro.apply(HEAT, Q)
    return ro.Problem({U: rate}, (T, 0, 0.2), {K: (0.05, 0.2), Q: (1, 3)}, {U: 0})


@pytest.fixture(scope="module")
def winding():
    """Fields of which a few trajectories tell too little."""
    rate = K * ro.apply(LAPLACIAN, U) + 5 * sp.sin(6 * Q * U) * ro.apply(np.cos(9 * X), 1)
    box = {K: (0.002, 0.2), Q: (-3, 3)}
    return ro.Problem({U: rate}, (T, 0, 0.2), box, {U: ro.apply(HEAT, 1)})


@pytest.fixture(scope="module")
def solution(problem):
    return ro.solve(problem, rtol=1e-3)


def exact(times, k, q):
    solved = scipy.integrate.solve_ivp(
        lambda t, u: k * (LAPLACIAN @ u) - u**3 + q * HEAT,
        (0, 0.2),
        np.zeros(N),
        method="Radau",
        rtol=1e-9,
        atol=1e-11,
        t_eval=times,
    )
    return solved.y


def test_values_are_those_of_scipy(solution):
    assert solution.success
    assert solution.method == "reduced"
    times = np.linspace(0, 0.2, 9)
    for k, q in ((0.05, 1.0), (0.2, 3.0), (0.11, 1.7)):
        error = np.abs(solution[U](t=times, k=k, q=q) - exact(times, k, q)).max()
        assert error < 1e-3 * solution.modes.scales[0]


def test_the_message_says_which_error(solution):
    assert "largest value of u" in solution.message
    assert solution.errors["u"] == solution.error <= 1e-3
    assert solution.timings["solve"] > 0.0
    assert solution.work["full trajectories"] > 0.0


def test_another_domain_needs_no_new_compile(problem):
    compiled = ro.compile(problem)
    smaller = compiled.solve(1e-3, parameters={K: (0.1, 0.2)}, t_final=0.1)
    assert smaller.success
    assert smaller.box == ((0.1, 0.2), (1.0, 3.0))
    assert smaller.time == (0.0, 0.1)


@pytest.mark.slow
def test_other_methods_take_the_equations_entry_by_entry(problem, solution):
    entries = ro.solve(problem, rtol=1e-3, method="cross")
    assert entries.success
    at = {"t": 0.13, "k": 0.08, "q": 2.2}
    error = np.abs(entries(**at) - solution(**at)).max()
    assert error < 2e-3 * solution.modes.scales[0]


def test_fields_of_few_entries_are_fields_as_well():
    u = ro.field("u", 3)
    problem = ro.Problem({u: -K * u}, (T, 0, 1), {K: (1, 2)}, {u: np.array([1.0, 2, 3])})
    solution = ro.solve(problem, rtol=1e-6)
    assert solution.success
    assert np.allclose(solution[u](t=1.0, k=1.5), np.exp(-1.5) * np.array([1.0, 2, 3]), rtol=1e-5)


def test_pulses_inside_functions_are_not_stepped_over():
    n, q = 20, sp.Symbol("q")
    u = ro.field("u", n)
    shape = np.sin(np.pi * np.arange(1, n + 1) / (n + 1))
    pulse = ro.apply(shape, 1) * sp.exp(-u - ((T - 0.2371) / 0.001) ** 2)
    problem = ro.Problem({u: -K * u + q * pulse}, (T, 0, 0.5), {K: (1, 2), q: (200, 400)}, {u: 0})
    solution = ro.solve(problem, rtol=1e-3)
    exact = scipy.integrate.solve_ivp(
        lambda s, y: -1.3 * y + 300 * shape * np.exp(-y - ((s - 0.2371) / 0.001) ** 2),
        (0, 0.5),
        np.zeros(n),
        rtol=1e-8,
        atol=1e-10,
        max_step=1e-4,
    ).y[:, -1]
    assert solution.success
    assert np.abs(solution(t=0.5, k=1.3, q=300) - exact).max() < 1e-3 * exact.max()


def test_states_that_leave_the_domain_of_a_function_are_told():
    n, q = 100, sp.Symbol("q")
    u = ro.field("u", n)
    problem = ro.Problem(
        {u: -K * sp.sqrt(u) - ro.apply(np.ones(n), q)},
        (T, 0, 3),
        {K: (0.8, 1.2), q: (1, 3)},
        {u: 0.1},
    )
    solution = ro.solve(problem, rtol=1e-3)
    assert not solution.success
    assert "not finite, at t = 0.0" in solution.message


def test_failures_are_returned_or_raised(winding):
    compiled = ro.compile(winding)
    solution = compiled.solve(1e-4, max_trajectories=8, check=0)
    assert not solution.success
    assert "limit of trajectories" in solution.message
    with pytest.raises(ro.ConvergenceError, match="limit of trajectories") as failed:
        compiled.solve(1e-4, max_trajectories=8, check=0, on_failure="raise")
    assert not failed.value.solution.success


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rtol": 2.0}, "rtol"),
        ({"method": "reducd"}, "reduced"),
        ({"parameters": {"x": (0, 1)}}, "no parameter"),
        ({"check": -1}, "check"),
        ({"max_trajectories": 0}, "max_trajectories"),
        ({"on_failure": "ignore"}, "on_failure"),
        ({"effort": "huge"}, "effort"),
        ({"max_rnk": 3}, "max_rank"),
        ({"executor": 0}, "executor"),
    ],
)
def test_wrong_options_are_named(problem, options, message):
    with pytest.raises(ro.OptionError, match=message):
        ro.compile(problem).solve(**options)


@pytest.mark.parametrize(("d", "check", "fewest"), [(2, 12, 28), (1, 3, 17), (0, 12, 3), (2, 0, 8)])
def test_limits_below_what_a_solve_takes_are_refused_before_it(problem, d, check, fewest):
    parameters = dict([*problem.parameters.items()][:d])
    others = dict([*problem.parameters.items()][d:])
    values = {symbol: (0.1 if symbol == K else 2.0) for symbol in others}
    rates = {u: rate.subs(values) for u, rate in problem.rates.items()}
    compiled = ro.compile(ro.Problem(rates, (T, 0, 0.2), parameters, {U: 0}))
    with pytest.raises(ro.OptionError, match=f"takes at least {fewest} full trajectories"):
        compiled.solve(0.05, check=check, max_trajectories=fewest - 1)
    solution = compiled.solve(0.05, check=check, max_trajectories=fewest)
    assert solution.modes.trajectories == fewest
    assert solution.success == (check > 0)


def test_each_option_is_listed_once(problem):
    with pytest.raises(ro.OptionError) as raised:
        ro.compile(problem).solve(foo=1)
    for name in ("max_trajectories", "executor", "max_rank"):
        assert str(raised.value).count(name) == 1


def test_what_takes_no_fields_says_so(problem):
    with pytest.raises(ro.OptionError, match="fields"):
        ro.steady_state(problem)


def test_a_compiled_problem_shows_its_fields(problem):
    assert "u (70)" in repr(ro.compile(problem))
    assert "def coefficients" in ro.compile(problem).source


@pytest.mark.slow
@pytest.mark.parametrize(
    "narrow", [sp.exp(-(((T - 0.1) / 2e-4) ** 2)), sp.exp(-(((K - 0.1237) / 3e-4) ** 2))]
)
def test_narrow_coefficients_are_not_passed_over(narrow):
    rate = K * ro.apply(LAPLACIAN, U) + 100 * ro.apply(HEAT, narrow)
    problem = ro.Problem({U: rate}, (T, 0, 0.2), {K: (0.05, 0.2)}, {U: 0})
    solution = ro.solve(problem, rtol=1e-2, max_trajectories=45)
    if solution.success:
        assert np.abs(solution[U](t=0.15, k=0.1237)).max() > 1e-3


def test_a_field_that_stays_zero():
    problem = ro.Problem({U: K * ro.apply(LAPLACIAN, U)}, (T, 0, 0.2), {K: (1, 2)}, {U: 0})
    solution = ro.solve(problem, rtol=1e-3)
    assert solution.success
    assert (solution(t=0.1, k=1.5) == 0.0).all()


def test_no_parameters_at_all():
    problem = ro.Problem(
        {U: 0.1 * ro.apply(LAPLACIAN, U) + ro.apply(HEAT, 1)}, (T, 0, 0.2), {}, {U: 0}
    )
    solution = ro.solve(problem, rtol=1e-3)
    assert solution.success
    start = np.linalg.solve(0.1 * LAPLACIAN.toarray(), HEAT)
    exact = scipy.linalg.expm(0.02 * LAPLACIAN.toarray()) @ start - start
    assert np.abs(solution(t=0.2) - exact).max() < 1e-3 * solution.modes.scales[0]


def test_nothing_is_saved_where_nothing_was_solved(winding, tmp_path):
    empty = ro.solve(winding, rtol=1e-4, max_trajectories=8, check=0)
    with pytest.raises(ro.StorageError, match="nothing to save: the limit of trajectories"):
        empty.save(tmp_path / "empty.npz")
    with pytest.raises(ro.EvaluationError, match="at most 8 were to be integrated"):
        empty(t=0.1, k=0.1, q=1.0)


def test_a_field_that_is_zero_at_the_centre_of_the_box_is_no_zero():
    a, b = sp.symbols("a b")
    u = ro.field("u", N)
    start = ro.apply(1e-6 * HEAT, a - b)
    rate = K * ro.apply(LAPLACIAN, u)
    box = {K: (0.05, 0.2), a: (0, 1), b: (0, 1)}
    solution = ro.solve(ro.Problem({u: rate}, (T, 0, 0.2), box, {u: start}), rtol=1e-3)
    assert solution.success
    exact = scipy.linalg.expm(0.1 * 0.2 * LAPLACIAN.toarray()) @ (0.7e-6 * HEAT)
    ours = solution(t=0.2, k=0.1, a=0.9, b=0.2)
    assert np.abs(ours - exact).max() < 1e-3 * 1e-6 * HEAT.max()


def test_sources_that_move_are_functions_without_fields():
    u = ro.field("u", N)
    source = sp.exp(-(((ro.apply(X, 1) - T) / 0.2) ** 2))
    problem = ro.Problem({u: -K * u + source}, (T, 0, 1), {K: (1, 2)}, {u: 0})
    solution = ro.solve(problem, rtol=1e-3)
    exact = scipy.integrate.solve_ivp(
        lambda t, y: -1.3 * y + np.exp(-(((X - t) / 0.2) ** 2)),
        (0, 1),
        np.zeros(N),
        rtol=1e-8,
        atol=1e-9,
    ).y[:, -1]
    assert solution.success
    assert np.abs(solution(t=1.0, k=1.3) - exact).max() < 1e-3 * exact.max()


def test_a_pole_in_one_corner_of_many_parameters_is_no_success():
    u, parameters = ro.field("u", 20), sp.symbols("p0:6")
    source = ro.apply(np.sin(np.arange(1.0, 21.0)), 1 + 0.005 / (6.005 - sum(parameters)))
    problem = ro.Problem({u: -u + source}, (T, 0, 1), dict.fromkeys(parameters, (0, 1)), {u: 0})
    solution = ro.solve(problem, rtol=1e-3)
    exact = 2 * (1 - np.exp(-1.0)) * np.sin(np.arange(1.0, 21.0))
    error = np.abs(solution(1.0, dict.fromkeys(solution.parameters, 1.0)) - exact).max()
    assert error > 1e-2 * exact.max()
    assert not solution.success
    assert solution.error > 1e-2


def test_fields_that_grow_a_thousand_times_more_at_a_corner():
    u, parameters = ro.field("u", N), sp.symbols("p0:6")
    rate = 0.05 * ro.apply(LAPLACIAN, u) + sum(parameters) * u
    problem = ro.Problem({u: rate}, (T, 0, 1), dict.fromkeys(parameters, (0, 1.15)), {u: HEAT})
    solution = ro.solve(problem, rtol=1e-3)
    assert solution.success
    spread = scipy.linalg.expm(0.05 * LAPLACIAN.toarray()) @ HEAT
    largest = np.exp(6 * 1.15) * spread
    for value in (0.3, 0.8, 1.15):
        ours = solution(1.0, dict.fromkeys(solution.parameters, value))
        assert np.abs(ours - np.exp(6 * value) * spread).max() < 1e-3 * largest.max()
