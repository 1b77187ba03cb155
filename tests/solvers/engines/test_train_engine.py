"""The engine: exactness, equation classes, limits and failures. Nothing is silently wrong."""

import itertools
from functools import partial

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp
from threadpoolctl import threadpool_info, threadpool_limits

import rankone as ro
from rankone.solvers.engines.train_engine import ENGINE
from rankone.support.budget import OutOfMemoryError
from tests.problems import REFERENCE

solve = partial(ro.solve, method="train")

t, k, m, a, b, c = sp.symbols("t k m a b c")
x, y, z = (sp.Function(name)(t) for name in "xyz")


def problem(rhs, horizon, box, start, unknown=x):
    return ro.Problem([sp.Eq(unknown.diff(t), rhs)], (t, 0, horizon), box, {unknown: start})


def test_exact_solution_of_the_linear_problem_for_any_tolerance():
    for rtol in (1e-3, 1e-8):
        solution = solve(REFERENCE["linear"](), rtol=rtol)
        assert solution.success
        assert solution.rank <= 2
        rates = np.linspace(1.0, 10.0, 37)
        np.testing.assert_allclose(
            solution["u"](t=5.0, k=rates), (10 / rates - 1) * 5, rtol=0, atol=45 * 1e-12
        )


def test_error_falls_with_the_tolerance():
    errors = []
    for rtol in (1e-3, 1e-5, 1e-7):
        solution = solve(REFERENCE["free_fall"](), rtol=rtol)
        assert solution.success
        assert solution.error <= rtol
        errors.append(solution.error)
    assert errors[0] > errors[1] > errors[2]


CLASSES = {
    "no parameters": (problem(-(x**2) + sp.sin(t), 5, {}, 1), 1e-8),
    "quintic": (problem(-a * x**5 + b, 3, {a: (0.5, 2), b: (0, 1)}, 1), 1e-6),
    "explicit time": (problem(-k * x + sp.exp(-t) * sp.cos(3 * t), 3, {k: (1, 3)}, 0), 1e-7),
    "any function of one parameter": (
        problem(-sp.exp(-k) * x + sp.sqrt(m) / (1 + m), 2, {k: (0, 2), m: (1, 4)}, sp.cos(k)),
        1e-7,
    ),
    "kink in a parameter": (problem(1 - sp.Abs(k) * x, 2, {k: (-1, 1)}, 1), 1e-5),
    "growth": (problem(k * x, 10, {k: (1, 2)}, 1), 1e-6),
    "start later": (
        ro.Problem([sp.Eq(x.diff(t), -k * x)], (t, 2, 4), {k: (1, 3)}, {x: 1}),
        1e-7,
    ),
    "van der Pol": (
        ro.Problem(
            [sp.Eq(x.diff(t, 2), m * (1 - x**2) * x.diff(t) - x)],
            (t, 0, 6),
            {m: (0.5, 2)},
            {x: 2, x.diff(t): 0},
        ),
        1e-5,
    ),
    "Lorenz": (
        ro.Problem(
            [
                sp.Eq(x.diff(t), 10 * (y - x)),
                sp.Eq(y.diff(t), x * (a - z) - y),
                sp.Eq(z.diff(t), x * y - sp.Rational(8, 3) * z),
            ],
            (t, 0, 1),
            {a: (26, 30), b: (0.9, 1.1)},
            {x: b, y: 1, z: 20},
        ),
        1e-5,
    ),
    "a state that vanishes": (
        ro.Problem(
            [sp.Eq(x.diff(t), -k * x), sp.Eq(y.diff(t), -y + x)],
            (t, 0, 2),
            {k: (1, 3)},
            {x: 0, y: 1},
        ),
        1e-7,
    ),
}


def independent_error(problem, solution, points=20, seed=5):
    """Largest error against SciPy, relative to each state's size; lambdified right-hand side."""
    start, end = solution.time
    symbols = list(problem.parameters)
    names, system = list(problem.initial), ro.first_order(problem)
    plain = sp.symbols(f"s0:{len(names)}")
    rhs = [f.subs(dict(zip(system.functions, plain))) for f in system.rhs]
    f = sp.lambdify([t, plain, symbols], rhs)
    initial = sp.lambdify([symbols], [sp.sympify(problem.initial[name]) for name in names])
    rng = np.random.default_rng(seed)
    box = np.array([problem.parameters[s] for s in symbols], dtype=float).reshape(-1, 2)
    times = np.linspace(start, end, 21)
    worst, size = 0.0, 0.0
    for point in box[:, 0] + (box[:, 1] - box[:, 0]) * rng.random((points, len(symbols))):
        exact = solve_ivp(
            lambda s, u, point=point: f(s, u, point),
            (start, end),
            np.array(initial(point), dtype=float),
            method="DOP853",
            rtol=1e-11,
            atol=1e-13,
            t_eval=times,
        ).y
        values = np.stack([solution[name](times, dict(zip(symbols, point))) for name in names])
        worst = np.maximum(worst, np.abs(values - exact).max(axis=1))
        size = np.maximum(size, np.abs(exact).max(axis=1))
    return np.max(worst / np.where(size > 0, size, 1.0))


@pytest.mark.parametrize("name", CLASSES)
def test_equation_classes_meet_the_tolerance(name):
    problem, rtol = CLASSES[name]
    solution = solve(problem, rtol=rtol)
    assert solution.success, solution.message
    assert independent_error(problem, solution) <= 5 * rtol


def test_bases_agree_within_their_errors():
    chebyshev = solve(REFERENCE["coupled"](), rtol=1e-5, basis="chebyshev")
    legendre = solve(REFERENCE["coupled"](), rtol=1e-5, basis="legendre")
    where = {"t": 0.4} | dict(zip(chebyshev.parameters, (0.7, 1.1, 1.3)))
    size = np.abs(chebyshev(**where)).max()
    bound = (chebyshev.error + legendre.error) * size
    assert np.abs(chebyshev(**where) - legendre(**where)).max() <= max(bound, 1e-5 * size)


def test_solving_twice_gives_the_same_numbers():
    one, two = (solve(REFERENCE["coupled"](), rtol=1e-4) for _ in range(2))
    names = dict(zip(one.parameters, (0.7, 1.1, 1.3)))
    np.testing.assert_array_equal(one(t=0.4, **names), two(t=0.4, **names))


def test_history_tells_every_slab():
    solution = solve(REFERENCE["lotka_volterra"](), rtol=1e-4)
    last = max(record.attempt for record in solution.history)
    accepted = [r for r in solution.history if r.accepted and r.attempt == last]
    assert accepted[0].start == 0.0
    assert accepted[-1].end == pytest.approx(6.0)
    for one, two in itertools.pairwise(accepted):
        assert one.end == two.start
    assert all(record.residuals for record in accepted)
    assert {"compile", "reference", "march", "check", "solve"} <= set(solution.timings)


# -- limits: success is False with the error reached, or an exception on request -----------------


def refused(count):
    raise OutOfMemoryError(count, 1e3)


@pytest.mark.parametrize(
    ("options", "status"),
    [
        pytest.param({"max_rank": 2}, ro.Status.RANK_LIMIT, marks=pytest.mark.slow),
        pytest.param({"max_nodes": 6}, ro.Status.NODE_LIMIT, marks=pytest.mark.slow),
        ({"max_slabs": 3}, ro.Status.SLAB_LIMIT),
        ({}, ro.Status.MEMORY_LIMIT),
    ],
)
def test_limits_are_reported_never_hidden(options, status, monkeypatch):
    if not options:
        monkeypatch.setattr("rankone.solvers.engines.train_engine.reserve", refused)
    with pytest.raises(ro.ConvergenceError, match=status.value) as caught:
        solve(REFERENCE["lotka_volterra"](), rtol=1e-6, on_failure="raise", **options)
    solution = caught.value.solution
    assert not solution.success
    assert solution.status is status
    assert status.value in solution.message
    assert ("it needs about" in solution.message) == (status is ro.Status.MEMORY_LIMIT)
    if solution.outcome.slabs:
        assert solution.error > 1e-6 or solution.time[1] < 6.0


def test_a_partial_solution_ends_where_it_was_solved():
    solution = solve(REFERENCE["lotka_volterra"](), rtol=1e-6, max_slabs=5)
    start, end = solution.time
    assert start == 0.0
    assert 0.0 < end < 6.0
    with pytest.raises(ro.EvaluationError, match="outside its horizon"):
        solution(t=6.0, x0=9, y0=5)
    assert np.isfinite(solution(t=end, x0=9, y0=5)).all()


def test_unchecked_is_no_success():
    solution = solve(REFERENCE["decay"](), check=0)
    assert not solution.success
    assert np.isnan(solution.error)
    assert solution.status is ro.Status.UNCHECKED
    assert solution["u"](t=1.0, k=2.0) == pytest.approx(np.exp(-2.0), rel=1e-5)


@pytest.mark.slow
def test_blow_up_names_time_and_parameters_and_keeps_the_solved_part():
    original = REFERENCE["coupled"]()
    longer = ro.Problem(
        original.equations,
        (original.time[0], 0, 1),
        dict(original.parameters),
        dict(original.initial),
    )
    with pytest.raises(
        ro.BlowUpError, match=r"blows up inside the horizon: near t = 0\.89"
    ) as caught:
        solve(longer, rtol=1e-4)
    error = caught.value
    assert error.time == pytest.approx(0.8946, abs=1e-3)
    assert set(error.parameters) == {s.name for s in original.parameters}
    part = error.solution
    assert 0.7 < part.time[1] < error.time
    assert part.error <= 1e-4
    assert not part.success


def test_blow_up_long_before_the_horizon_is_found_quickly():
    with pytest.raises(ro.BlowUpError) as caught:
        solve(problem(k * x**2, 1000, {k: (0.5, 1)}, 1), rtol=1e-4)
    assert caught.value.time == pytest.approx(1.0, rel=1e-3)
    assert caught.value.parameters == {"k": 1.0}


@pytest.mark.parametrize("rtol", [0, -1, 1, 1e-14, float("nan"), "small", None, True])
def test_rtol_out_of_range(rtol):
    with pytest.raises(ro.OptionError, match="rtol"):
        solve(REFERENCE["decay"](), rtol=rtol)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "magic"}, "method='magic'"),
        ({"on_failure": "ignore"}, "on_failure='ignore'"),
        ({"check": -3}, "check=-3"),
        ({"check": 2.5}, "check=2.5"),
        ({"max_rank": 0}, "max_rank=0"),
        ({"max_ranks": 5}, r"'max_ranks' \(did you mean `max_rank`\?\); remedy: choose from basis"),
        (
            {"rtoll": 1e-3},
            r"'rtoll' \(did you mean `rtol`\?\); .*; solve itself takes rtol, parameters",
        ),
        ({"method": "trian"}, r"method='trian' is unknown \(did you mean `train`\?\)"),
        ({"method": ["train"]}, "is unknown"),
        ({"basis": "fourier"}, "basis='fourier'"),
        ({"basis": ["legendre"]}, "basis="),
        ({"time_nodes": 1}, "time_nodes=1"),
        ({"time_nodes": 33}, "time_nodes=33 .* from 2 to 32"),
        ({"max_rank": 10.0}, "max_rank=10.0"),
        ({"max_nodes": "many"}, "max_nodes='many'"),
        ({"max_sweeps": True}, "max_sweeps=True"),
        ({"cls": 1}, "unknown option 'cls'"),
        ({"checkpoint": "run"}, "solve does not take checkpoint=; remedy: .*solve_many"),
        ({"progress": 3}, "progress"),
    ],
)
def test_bad_options_are_named(options, message):
    with pytest.raises(ro.OptionError, match=message):
        solve(REFERENCE["decay"](), **options)


def test_numbers_of_other_kinds():
    options = {"max_degree": sp.Integer(12), "max_rank": np.int64(30), "max_memory": 10**10}
    solution = solve(REFERENCE["decay"](), rtol=sp.Float(1e-3), check=np.int32(5), **options)
    assert solution.success
    del options["max_memory"]
    assert type(ro.TrainOptions(**options).max_degree) is int


@pytest.mark.slow
def test_the_number_of_threads_changes_nothing_but_rounding():
    """Frames hold no directions that come from rounding errors."""
    system = ro.compile(REFERENCE["kirchhoff"]()).system
    points = np.random.default_rng(0).uniform(0.5, 1.0, (6, 500))
    values = []
    for threads in (1, 2):
        with threadpool_limits(threads, "blas"):
            assert {i["num_threads"] for i in threadpool_info() if i["user_api"] == "blas"} == {
                threads
            }
            slab = ENGINE.run(system, 1e-4).slabs[-1]
            values.append(slab(np.linspace(slab.start, slab.end, 500), points))
    assert np.abs(values[1] - values[0]).max() <= 1e-10


def test_an_interrupt_passes_through():
    def stop(event):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        solve(REFERENCE["lotka_volterra"](), progress=stop)


def test_progress_events_reach_the_end_of_the_horizon():
    events = []
    solve(REFERENCE["lotka_volterra"](), rtol=1e-3, progress=events.append)
    fractions = [event.fraction for event in events if event.attempt == events[-1].attempt]
    assert fractions == sorted(fractions)
    assert fractions[-1] == pytest.approx(1.0)


def test_a_dependence_the_initial_values_do_not_have_is_found():
    """From constant initial values every pair of cores sees one parameter function only."""
    solution = solve(REFERENCE["robertson"](), rtol=1e-4, max_attempts=1)
    assert solution.success, solution.message
