"""Starts at steady states of other conditions, against long integration by SciPy."""

import pickle

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp

import rankone as ro
from rankone.share.commands.common import load_problem

t, k, a, dose, off = sp.symbols("t k a dose off")
x, y, L, R, C, D = (sp.Function(name)(t) for name in "xyLRCD")


def problem(rates, box, initial, end=5, **options):
    equations = [sp.Eq(u.diff(t), rate) for u, rate in rates.items()]
    return ro.Problem(equations, (t, 0, end), box, initial, **options)


def receptor(**options):
    """Receptors are made and taken away; before the start there is no ligand."""
    rates = {R: 2 - k * R - dose * R + off * C, C: dose * R - off * C - C / 2}
    box = {k: (1, 2), off: (0.2, 0.5)}
    start = ro.SteadyState(conditions={dose: k / 10}, start={R: 1})
    return problem(rates, box, start, constants={dose: 3}, **options)


def network():
    """A ligand binds a receptor that also has a second form; both totals are conserved."""
    binds, turns = k * L * R - off * C, a * R - D
    rates = {L: -binds, R: -binds - turns, C: binds, D: turns}
    start = ro.SteadyState(conditions={off: 3}, start={L: 1, R: 2})
    return problem(rates, {k: (1, 2), a: (0.5, 2)}, start, constants={off: 0.4})


def gene(start, largest=0.04):
    """It activates itself: two stable states."""
    rest = ro.SteadyState(conditions={k: 1.02 * k}, start={x: start})
    return problem({x: a + x**2 / (1 + x**2) - k * x}, {a: (0.02, largest), k: (0.42, 0.44)}, rest)


def rested(model, conditions, start, point):
    """The states at the end of a long integration under the conditions at a point."""
    symbols = {**model.constants, **point}
    symbols |= {symbol: sp.sympify(e).subs(symbols) for symbol, e in conditions.items()}
    unknowns = model.unknowns
    rates = [sp.solve(e, u.diff(t))[0] for e, u in zip(model.equations, unknowns, strict=True)]
    function = sp.lambdify([t, unknowns], [rate.subs(symbols) for rate in rates])
    ends = solve_ivp(function, (0, 3000), start, method="LSODA", rtol=1e-11, atol=1e-14)
    return ends.y[:, -1]


@pytest.mark.parametrize(
    ("model", "conditions", "start"),
    [
        pytest.param(receptor(), {dose: k / 10}, [1, 0], marks=pytest.mark.slow),
        pytest.param(network(), {off: 3}, [1, 2, 0, 0], marks=pytest.mark.slow),
        pytest.param(gene(0), {k: 1.02 * k}, [0], marks=pytest.mark.slow),
        (gene(3), {k: 1.02 * k}, [3]),
    ],
    ids=["receptor", "conserved totals", "lower branch", "upper branch"],
)
def test_starts_are_where_long_integrations_end(model, conditions, start):
    solution = ro.solve(model, rtol=1e-6)
    assert solution.success, solution.message
    box = np.array(list(model.parameters.values()))
    points = np.random.default_rng(3).uniform(box[:, 0], box[:, 1], (5, len(box)))
    for point in points:
        at = dict(zip(model.parameters, point, strict=True))
        names = {symbol.name: value for symbol, value in at.items()}
        expected = rested(model, conditions, start, at)
        np.testing.assert_allclose(solution(t=0, **names), expected, rtol=3e-6, atol=1e-9)
        trajectory = model.trajectory([0, 5], **names).values
        np.testing.assert_allclose(trajectory[:, 0], expected, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(solution(t=[0, 5], **names), trajectory, rtol=5e-6, atol=1e-8)


def test_parameters_of_conditions_alone(recwarn):
    base = sp.Symbol("base")
    rest = ro.SteadyState(conditions={dose: base})
    model = problem({x: dose - k * x}, {k: (1, 2), base: (1, 3)}, rest, constants={dose: 0.5})
    solution = ro.solve(model, rtol=1e-6)
    assert not recwarn
    expected = 0.5 / 1.3 + (2 / 1.3 - 0.5 / 1.3) * np.exp(-1.3)
    np.testing.assert_allclose(solution(t=1, k=1.3, base=2), [expected], rtol=2e-6)


def test_totals_are_exact():
    p = np.random.default_rng(1).uniform([[1], [0.5]], [[2], [2]], (2, 50))
    start = ro.compile(network()).system.initial(p)
    np.testing.assert_allclose(start[0] + start[2], 1.0, rtol=1e-15)
    np.testing.assert_allclose(start[1] + start[2] + start[3], 2.0, rtol=1e-15)


def test_what_is_added_at_the_start():
    model = receptor(jumps={0: {C: C + k}, 2: {R: R + 1}})
    solution = ro.solve(model, rtol=1e-6, method="train")
    at = {"k": 1.3, "off": 0.3}
    assert solution.success
    plain = receptor().trajectory(0, **at).values
    np.testing.assert_allclose(solution(t=0, **at), [plain[0], plain[1] + 1.3], rtol=1e-6)
    times = [0, 1.9, 2, 5]
    np.testing.assert_allclose(solution(times, at), model.trajectory(times, at).values, rtol=5e-6)


@pytest.mark.slow
def test_files_pickles_other_boxes_and_constants(tmp_path):
    model = receptor()
    assert pickle.loads(pickle.dumps(model)) == model
    assert "at the start: the steady state with dose = 0.1*k, from R = 1, C = 0" in repr(model)
    read = load_problem(model.save(tmp_path / "receptor.toml"))
    assert repr(read) == repr(model)
    assert read.rest.content(plain=True) == model.rest.content(plain=True)
    compiled = pickle.loads(pickle.dumps(ro.compile(model)))
    moved = compiled.solve(1e-5, parameters={k: (2, 3)})
    expected = model.vary(k=(2, 3)).trajectory([0, 5], k=2.5, off=0.3).values
    np.testing.assert_allclose(moved([0, 5], k=2.5, off=0.3), expected, rtol=5e-5)
    other = model.set(dose=4)
    assert "code generation" not in ro.compile(other).timings  # nothing is compiled again
    expected = other.trajectory([0, 5], k=1.5, off=0.3).values
    np.testing.assert_allclose(ro.solve(other)([0, 5], k=1.5, off=0.3), expected, rtol=5e-6)


@pytest.mark.slow
def test_exported_solvers_start_there_too(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    ro.compile(receptor()).export(tmp_path / "resting_solver.py")
    import resting_solver

    solution = resting_solver.solve(rtol=1e-6)
    expected = receptor().trajectory([0, 5], k=1.3, off=0.3).values
    assert solution.success
    np.testing.assert_allclose(solution([0, 5], k=1.3, off=0.3), expected, rtol=5e-6)


@pytest.mark.slow
def test_functions_of_unknowns_mechanics_events_and_no_parameters():
    rest = ro.SteadyState({dose: 1}, start={x: 1})
    lifted = problem({x: dose - k * sp.log(x) - x}, {k: (1, 2)}, rest,
                     constants={dose: 3})  # fmt: skip
    spring = ro.Problem.from_matrices(
        np.eye(2), np.eye(2), {k: np.array([[2.0, -1.0], [-1.0, 1.0]])}, {dose: np.ones(2)},
        time=(t, 0, 5), parameters={k: (1, 2)}, initial=ro.SteadyState({dose: 1}),
        constants={dose: 2},
    )  # fmt: skip
    crossing = problem({x: dose - k * x}, {k: (1, 2)}, ro.SteadyState({dose: 1}), end=3,
                       constants={dose: 6},
                       events=[ro.Event(x - 2.5, "rising", then={x: 1})])  # fmt: skip
    alone = problem({x: dose - 2 * x}, {}, ro.SteadyState({dose: 1}), constants={dose: 6})
    for model, method in ((lifted, "train"), (spring, "auto"), (crossing, "auto"), (alone, "auto")):
        solution = ro.solve(model, rtol=1e-5, method=method)
        assert solution.success, solution.message
        at = {"k": 1.4} if model.parameters else {}
        times = [0, 0.3]
        expected = model.trajectory(times, **at).values
        np.testing.assert_allclose(solution(times, **at), expected, rtol=1e-4, atol=1e-12)


@pytest.mark.parametrize("rate", ["log(s)", "1/s", "s**-0.5"])
def test_conditions_without_a_rate_name_the_term(rate):
    with pytest.raises(ro.ProblemError, match=r"the term `.*s.*` has no value at s = 0, under"):
        ro.Problem.from_strings(
            {"x": f"-k*x + {rate}"}, ro.SteadyState({"s": 0}), {"k": (1, 2), "s": (1, 2)}, (0, 3)
        )


@pytest.mark.slow
def test_starts_that_are_none():
    def refused(error, match, *arguments, **options):
        with pytest.raises(error, match=match):
            ro.solve(problem(*arguments, **options))

    decay = {x: dose - k * x}
    box, numbers = {k: (1, 2)}, {"constants": {dose: 1}}
    grows = {x: k * x * (1 - x)}
    rest = ro.SteadyState
    refused(ro.ConvergenceError, "not stable", grows, box, rest())
    refused(
        ro.ConvergenceError, "not stable", {x: y, y: -k * x}, box, rest(start={x: 1}, settle=20)
    )
    refused(ro.ConvergenceError, "blows up", {x: k * x**2}, box, rest(start={x: 1}))
    refused(ro.ProblemError, "time `t` appears", {x: sp.sin(t) - k * x}, box, rest())
    refused(ro.ProblemError, "mean `dose`", decay, box, rest({"doze": 0}), **numbers)
    refused(ro.ProblemError, "is a state", decay, box, rest({x: 0}), **numbers)
    refused(
        ro.ProblemError, "has `off`, which is neither", decay, box, rest({dose: off}), **numbers
    )
    refused(ro.ProblemError, "is `nan`", decay, box, rest({dose: sp.nan}), **numbers)
    refused(ro.ProblemError, "has a value for `y", decay, box, rest(start={y: 1}), **numbers)
    refused(ro.ProblemError, "sum of `x.*start at zero", {x: -k * x, y: k * x}, box, rest())
    with pytest.raises(ro.ConvergenceError, match=r"ends in a fold at a = 0\.0"):
        ro.solve(gene(0, 0.06))
    with pytest.raises(ro.ProblemError, match="not a mapping"):
        ro.SteadyState(3)
    with pytest.raises(ro.OptionError, match="settle"):
        ro.SteadyState(settle=0)
    algebraic = [sp.Eq(x.diff(t), k - y), sp.Eq(y**3 + y, x)]
    with pytest.raises(ro.ProblemError, match="algebraic equations"):
        ro.Problem(algebraic, (t, 0, 1), box, ro.SteadyState(start={x: 1, y: 1}))


def test_a_start_that_has_decayed_to_zero():
    """A long integration ends at rounding of what was there; that is zero."""
    decay = problem(
        {x: dose - k * x}, {k: (1, 2), dose: (1, 2)}, ro.SteadyState({dose: 0}, start={x: 1})
    )
    solution = ro.solve(decay)
    assert solution.success
    assert solution(t=1, k=1.5, dose=1.2) == pytest.approx(0.8 * (1 - np.exp(-1.5)), abs=1e-4)
