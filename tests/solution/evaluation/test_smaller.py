"""Derivatives and smaller solutions: exact operations on the trains."""

import functools
import runpy
from dataclasses import replace

import numpy as np
import pytest
import scipy.integrate
import scipy.stats
import sympy as sp

import rankone as ro
from rankone.support.errors import OptionError, RankoneError
from rankone.tensors import BASES
from tests.problems import EXAMPLES, GENERAL


@functools.cache
def solved(name, rtol, **options):
    example = (EXAMPLES | GENERAL)[name]
    return ro.solve(example.problem, rtol)


def sensitivities(rhs, by_state, by_parameter, start, slopes, end):
    """Derivatives of states with respect to parameters by the variational equations."""
    n, d = slopes.shape

    def both(_, y):
        u, s = y[:n], y[n:].reshape(n, d)
        return np.concatenate([rhs(u), (by_state(u) @ s + by_parameter(u)).ravel()])

    start = np.concatenate([start, slopes.ravel()])
    run = scipy.integrate.solve_ivp(
        both, (0, end), start, "DOP853", rtol=1e-12, atol=1e-13, dense_output=True
    )
    return lambda times: run.sol(times)[n:].reshape(n, d, -1)


def coupled(p):
    return sensitivities(
        lambda u: np.array([1 - u[1] * u[2], 2 - u[0] * u[2], 3 - u[0] * u[1]]),
        lambda u: -np.array([[0, u[2], u[1]], [u[2], 0, u[0]], [u[1], u[0], 0]]),
        lambda u: np.zeros((3, 3)),
        p,
        np.eye(3),
        0.5,
    )


def lotka_volterra(p):
    return sensitivities(
        lambda u: np.array([u[0] * (1.5 - u[1]), -u[1] * (3 - u[0])]),
        lambda u: np.array([[1.5 - u[1], -u[0]], [u[1], u[0] - 3]]),
        lambda u: np.zeros((2, 2)),
        p,
        np.eye(2),
        6.0,
    )


def pendulum(p):
    return sensitivities(
        lambda u: np.array([u[1], -p[1] * u[1] - p[0] * np.sin(u[0])]),
        lambda u: np.array([[0, 1], [-p[0] * np.cos(u[0]), -p[1]]]),
        lambda u: np.array([[0, 0, 0], [-np.sin(u[0]), -u[1], 0]]),
        np.array([p[2], 0.0]),
        np.array([[0, 0, 1.0], [0, 0, 0]]),
        5.0,
    )


@pytest.mark.parametrize(
    ("name", "exact", "rtol", "within"),
    [
        ("coupled", coupled, 1e-8, 1e-5),
        ("lotka_volterra", lotka_volterra, 1e-8, 1e-5),
        ("pendulum", pendulum, 1e-6, 1e-4),
    ],
)
def test_gradients_against_variational_equations(name, exact, rtol, within):
    solution = solved(name, rtol)
    lower, upper = np.array([*solution.parameters.values()]).T
    times = np.linspace(*solution.time, 9)
    for share in np.random.default_rng(3).random((4, lower.size)):
        p = lower + (upper - lower) * share
        wanted = exact(p)(times)[: len(solution.unknowns)]
        found = solution.gradient(times, dict(zip(solution.parameters, p, strict=True)))
        assert found.shape == wanted.shape
        size = np.abs(wanted).max(axis=2, keepdims=True)
        assert np.all(np.abs(found - wanted) <= within * size.max(axis=1, keepdims=True))


def test_derivatives_are_solutions():
    solution, k = solved("decay", 1e-8), sp.Symbol("k")
    t, u = sp.Symbol("t"), sp.Function("u")(sp.Symbol("t"))
    slope = solution.diff(k)
    assert slope[u](t=1.0, k=2.0) == pytest.approx(-np.exp(-2.0), rel=1e-6)
    assert slope.diff(k)[u](t=1.0, k=2.0) == pytest.approx(np.exp(-2.0), rel=1e-5)
    assert solution.diff(t)[u](t=1.0, k=2.0) == pytest.approx(-2 * np.exp(-2.0), rel=1e-6)
    assert solution.diff("k").diff("t")[u](t=1.0, k=2.0) == pytest.approx(np.exp(-2), rel=1e-5)
    assert not slope.success
    assert "its error was not measured" in slope.message
    assert repr(slope)
    times = np.linspace(0, 2, 5)
    assert solution.gradient(t=times, k=2.0).shape == (1, 1, 5)


@pytest.mark.parametrize("kind", BASES)
def test_derivative_and_part_of_a_basis(kind):
    basis = BASES[kind](0.5, 3.0, 7, 3, (1.1, 1.7))
    points = np.linspace(0.5, 2.999, 40)

    def coefficients(function):
        return basis.to_modal @ (np.sqrt(basis.weights) * function(basis.nodes))

    cubic = np.polynomial.Polynomial([1.0, -2.0, 0.5, 0.3])
    derivative, same = basis.derivative
    assert same is basis
    found = basis.modal_values(points) @ (derivative @ coefficients(cubic))
    np.testing.assert_allclose(found, cubic.deriv()(points), atol=1e-11)
    part = basis.restricted(1.0, 2.0)
    assert part.edges.tolist() == [1.0, 1.1, 1.7, 2.0]
    assert basis.restricted(1.2, 1.5).elements == 1


def test_fixed_and_restricted_solutions_are_the_same_functions(tmp_path):
    solution = solved("coupled", 1e-8)
    names = [*solution.parameters]
    middle = dict(zip(names, (0.7, 1.1, 1.3), strict=True))
    fixed = solution.fix({names[1]: 1.1})
    assert [*fixed.parameters] == [names[0], names[2]]
    at = {names[0]: 0.7, names[2]: 1.3}
    np.testing.assert_allclose(fixed(0.4, at), solution(0.4, middle), rtol=1e-13)
    none = solution.fix(middle)
    np.testing.assert_allclose(none(t=0.4), solution(0.4, middle), rtol=1e-13)
    part = solution.restrict({names[0]: (0.6, 0.8), names[2]: (1.25, 1.5)})
    assert part.parameters[names[0]] == (0.6, 0.8)
    np.testing.assert_allclose(part(0.4, middle), solution(0.4, middle), rtol=1e-12)
    with pytest.raises(ro.RankoneError, match="outside its range"):
        part(0.4, {**middle, names[0]: 0.9})
    for smaller in (fixed, none, part):
        assert smaller.success
        again = ro.load(smaller.save(tmp_path / "u.npz", overwrite=True))
        points = {**dict.fromkeys(smaller.parameters), **{n: middle[n] for n in smaller.parameters}}
        np.testing.assert_array_equal(again(0.3, points), smaller(0.3, points))
    smaller.export(tmp_path / "model.py")


def test_a_part_at_the_corners_is_no_success_where_they_are_worse():
    """Four parameters: the tolerance is met in the interior, not at the corners."""
    factors = [f"p{i}" for i in range(4)]
    problem = ro.Problem.from_strings(
        {"x": f"-x + {'*'.join(factors)}"}, {"x": "1"}, dict.fromkeys(factors, (0.5, 1.5)), (0, 1)
    )
    solution = ro.solve(problem, 1e-3)
    measured = replace(solution.outcome.measured, corners=(2e-3,))
    solution = ro.Solution(replace(solution.outcome, measured=measured), solution.metadata)
    assert solution.success
    part = solution.fix(dict.fromkeys(factors[:3], 1.5))
    assert not part.success
    assert "on this part of the box it may be that at the corners" in part.message
    assert part.corner_error == solution.corner_error
    inner = solved("coupled", 1e-8)
    inner = inner.fix({next(iter(inner.parameters)): 1.0})
    assert inner.success
    assert inner.message.endswith("of which this solution is a part")


def test_elements_are_cut_where_the_part_ends():
    problem = ro.Problem.from_strings({"x": "-abs(k - 1)*x"}, {"x": 1}, {"k": (0, 3)}, (0, 1))
    solution = ro.solve(problem, 1e-7)
    part = solution.restrict(k=(0.5, 1.5))
    k = np.linspace(0.5, 1.5, 21)
    np.testing.assert_allclose(part["x"](t=1.0, k=k), solution["x"](t=1.0, k=k), rtol=1e-12)


@pytest.mark.parametrize(
    ("use", "message"),
    [
        (lambda s: s.diff("q"), "there is no parameter `q`"),
        (lambda s: s.fix(k=9), "`k` = 9 is outside its range"),
        (lambda s: s.fix(k="x"), "`k` is 'x', not a number"),
        (lambda s: s.fix(j=1), "there is no parameter `j`; remedy: choose from `k`"),
        (lambda s: s.restrict(k=(2, 1)), r"the interval \(2, 1\) of `k` does not ascend"),
        (lambda s: s.fix(5), "5 is not a mapping from names"),
        (lambda s: s.fix({"k": 1}, k=2), "`k` is given twice"),
        (lambda s: s.fix(k=True), "`k` is True, not a number"),
        (lambda s: s.restrict(k={1, 2}), "the interval of `k` is {1, 2}, not a pair"),
        (lambda s: s.restrict(k=(1, 1 + 1e-12)), "of `k` is too narrow"),
        (lambda s: s.restrict(k=3), "the interval of `k` is 3, not a pair"),
        (lambda s: s.restrict(k=(0, 1)), "`k` = 0 is outside"),
        (lambda s: s.restrict(k=(1, float("nan"))), "`k` = nan is outside"),
    ],
)
def test_bad_input(use, message):
    with pytest.raises(OptionError, match=message):
        use(solved("decay", 1e-8))


def test_at_a_time():
    solution = solved("lotka_volterra", 1e-6)
    later = solution.at(2.5)
    x0, y0 = np.array([8.2, 11.0]), np.array([4.4, 5.9])
    assert later.metadata.timeless
    assert np.allclose(later(x0=x0, y0=y0), solution(t=2.5, x0=x0, y0=y0), rtol=1e-13, atol=0)
    assert later(x0=9.0, y0=5.0).shape == (2,)
    assert later.grid(x0=x0, y0=4.5).shape == (2, 2, 1)
    assert np.allclose(later["y"].grid(x0=x0, y0=4.5), solution["y"].grid(2.5, x0=x0, y0=4.5)[0])
    assert np.allclose(later.gradient(x0=9.0, y0=5.0), solution.gradient(t=2.5, x0=9.0, y0=5.0))
    assert np.allclose(later.fix(x0=9.0)(y0=5.0), solution(t=2.5, x0=9.0, y0=5.0))
    assert "x0 in" in repr(later)
    assert "t in" not in repr(later)


def test_at_the_start_and_the_end():
    solution = solved("lotka_volterra", 1e-6)
    start, end = solution.time
    for time in (start, end):
        values = solution(t=time, x0=9, y0=5)
        assert np.allclose(solution.at(time)(x0=9, y0=5), values, rtol=1e-13, atol=0)


def test_statistics_without_time():
    solution = solved("lotka_volterra", 1e-6)
    later, under = solution.at(2.5), {"x0": scipy.stats.norm(10, 0.4)}
    for name in ("mean", "var", "std", "cov"):
        wanted = getattr(solution, name)(2.5, under=under)
        assert np.allclose(getattr(later, name)(under=under), wanted, rtol=1e-12)
    sobol, wanted = later.sobol(), solution.sobol([2.5])
    assert np.allclose(sobol.total, wanted.total[..., 0])
    assert np.allclose(sobol.second, wanted.second[..., 0])
    assert np.allclose(later.quantile([0.1, 0.9]), solution.quantile([0.1, 0.9], 2.5))


def test_without_time_files_labels_and_models(tmp_path):
    later = solved("lotka_volterra", 1e-6).at(2.5)
    values = later(x0=9.0, y0=5.0)
    read = ro.load(later.save(tmp_path / "later.npz"))
    assert np.array_equal(read(x0=9.0, y0=5.0), values)
    data = later.to_xarray(x0=[9.0, 10.0], y0=5.0)
    assert data["x"].dims == ("x0",)
    assert np.isclose(data["x"].values[0], values[0], rtol=1e-13, atol=0)
    later.export(tmp_path / "exported.py", allow_failed=True)


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda s: s.at(2.5)(t=1.0, x0=9, y0=5), "do not depend on time"),
        (lambda s: s.at(2.5)(1.0, {"x0": 9, "y0": 5}), "do not depend on time"),
        (lambda s: s.at(2.5)(x0=9), "no value for `y0`"),
        (lambda s: s.at(2.5).mean(1.0), "do not depend on time"),
        (lambda s: s.mean(), "no times were given"),
        (lambda s: s.at([1.0, 2.0]), "not a number"),
        (lambda s: s.at(7.0), "outside its horizon"),
        (lambda s: s.at(2.5).at(2.5), "do not depend on time"),
        (lambda s: s.at(2.5).diff("t"), "no parameter `t`"),
    ],
)
def test_time_that_is_not_there(call, match):
    with pytest.raises(RankoneError, match=match):
        call(solved("lotka_volterra", 1e-6))


def test_what_was_fixed_is_said(tmp_path):
    """Files, exports and the summary have the values of coordinates that are none any more."""
    whole = solved("lotka_volterra", 1e-4)
    part = whole.fix(x0=9.5).at(2.0)
    assert part.metadata.fixed == (("x0", 9.5), ("t", 2.0))
    assert "; at x0 = 9.5, t = 2" in str(part)
    part.save(tmp_path / "part.npz")
    assert ro.load(tmp_path / "part.npz").metadata == part.metadata
    for written, said in (("py", "py"), ("c", "h"), ("js", "d.ts")):
        part.export(tmp_path / f"model.{written}")
        text = (tmp_path / f"model.{said}").read_text()
        assert "x0 = 9.5" in text
        assert "t = 2.0" in text
    assert whole.metadata.fixed == ()


def test_some_unknowns_are_a_part_of_the_solution(tmp_path):
    """Rows of the trains: nothing is interpolated, and errors are those of these unknowns."""
    problem = ro.Problem.from_strings(
        {"x": "-k*x", "y": "x - y", "z": "y - k*z"}, {"x": 1, "y": 0, "z": 0}, {"k": (1, 2)}, (0, 1)
    )
    whole = ro.solve(problem, 1e-5)
    part = whole.output(["z", "x"])
    at = {"t": np.linspace(0, 1, 5), "k": np.linspace(1, 2, 5)}
    assert part.states == ("z", "x")
    np.testing.assert_allclose(part(**at), whole(**at)[[2, 0]], atol=1e-13)
    assert dict(part.errors) == {name: whole.errors[name] for name in ("z", "x")}
    assert part.success
    whole.export(tmp_path / "part.py", states=["z"])
    module = runpy.run_path(str(tmp_path / "part.py"))
    assert module["UNKNOWNS"] == ("z",)
    with pytest.raises(ro.OptionError, match="no unknown `zz`"):
        whole.export(tmp_path / "other.py", states=["zz"])
    with pytest.raises(ro.OptionError, match=r"\[\] names no output; remedy"):
        whole.output([])
    with pytest.raises(ro.OptionError, match="unknown name `q` in the output `q`; remedy"):
        whole.output(["x", "q"])


def test_some_unknowns_may_be_accurate_enough_where_others_are_not():
    whole = solved("lotka_volterra", 1e-4)
    measured = replace(whole.outcome.measured, interior=(1e-6, 1.0))
    failed = replace(whole.outcome, status=ro.Status.TOLERANCE, measured=measured)
    failed = ro.Solution(failed, whole.metadata)
    good, bad = (failed.output([name]) for name in failed.states)
    assert good.success
    assert "1.0e-06" in good.message
    assert bad.status is ro.Status.TOLERANCE


def test_some_unknowns_of_a_solution_with_events():
    ball = ro.Problem.from_strings(
        {"y": "v", "v": "-2"},
        {"y": "h", "v": 0},
        {"h": (0.8, 1.2)},
        (0, 2),
        events=[{"when": "y", "direction": "falling", "then": {"v": "-v/2"}, "name": "bounce"}],
    )
    whole = ro.solve(ball, 1e-5)
    part = whole.output(("v",))
    at = {"t": np.linspace(0, 2, 5), "h": np.linspace(0.8, 1.2, 5)}
    np.testing.assert_allclose(part(**at), whole(**at)[1:], atol=1e-13)
    met = [each.event_times("bounce", h=1) for each in (part, whole)]
    np.testing.assert_allclose(*met, rtol=1e-13)
