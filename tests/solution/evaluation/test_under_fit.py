"""Statistics under a fit: means and spreads by its estimates and their covariance."""

from __future__ import annotations

import functools
import warnings

import numpy as np
import pytest

import rankone as ro

TIMES = np.linspace(0.5, 4.0, 12)


@functools.cache
def solved():
    """x = c + a t."""
    box = {"a": (-5, 5), "c": (-5, 5), "e": (-5, 5)}
    problem = ro.Problem.from_strings({"x": "a + 0*e"}, {"x": "c + e"}, box, (0, 6))
    return ro.solve(problem, 1e-8)


@functools.cache
def fitted():
    return solved().fit(TIMES, 1.0 - 0.5 * TIMES, observe="x", sigma=0.4, fixed={"e": 0.25})


@pytest.mark.parametrize("t", [1.0, 5.0])
def test_a_line_has_the_band_of_its_fit(t):
    """The model is linear: its spread is exactly sqrt(g^T C g), with C correlated and e held."""
    fit, solution = fitted(), solved()
    names = list(fit.parameters)
    slope = np.array([t if name == "a" else 1.0 for name in names])
    std = np.sqrt(slope @ fit.covariance @ slope)
    centre = fit.x["c"] + 0.25 + fit.x["a"] * t
    assert abs(fit.covariance[0, 1]) > 0.5 * np.sqrt(np.prod(np.diag(fit.covariance)))
    assert solution.mean(t, under=fit)[0] == pytest.approx(centre, abs=1e-6)
    assert solution.std(t, under=fit)[0] == pytest.approx(std, rel=1e-5)
    assert solution.quantile(0.8413447, t, under=fit)[0] == pytest.approx(centre + std, rel=2e-2)
    assert solution.probability(t, above=centre + std, under=fit).value == pytest.approx(
        0.1587, abs=5e-3
    )
    density = solution.density(t, under=fit)
    peak = np.interp(centre, density.values, density.density)
    assert peak == pytest.approx(1.0 / np.sqrt(2.0 * np.pi) / std, rel=0.03)
    drawn = solution.sample(2000, under=fit)
    assert set(drawn["e"]) == {0.25}
    assert np.corrcoef(drawn["a"], drawn["c"])[0, 1] < -0.5
    assert solution.std(t, under=fit, correlation={})[0] != pytest.approx(std, rel=0.1)


def test_decades_are_log_normal_and_outputs_take_fits():
    problem = ro.Problem.from_strings(
        {"u": "-k*u"}, {"u": "b"}, {"k": (1e-2, 10), "b": (0.5, 2)}, (0, 3)
    )
    solution = ro.solve(problem, 1e-6)
    times = np.linspace(0.2, 3, 8)
    data = np.exp(-0.4 * times)
    fit = solution.fit(times, data, sigma=0.03, bounds={"k": (1e-2, 10, "log")})
    spread = fit.std["k"] / fit.x["k"]
    drawn = solution.sample(4000, under=fit)["k"]
    assert np.log(drawn).std() == pytest.approx(spread, rel=0.05)
    assert np.median(drawn) == pytest.approx(fit.x["k"], rel=5e-3)
    logs = solution.output({"q": "log(k) + 0*u"})
    assert logs.std(under=fit)[0] == pytest.approx(spread, rel=1e-3)


@pytest.mark.parametrize("whole", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_pieces_and_events_hold_what_a_fit_fixes(whole):
    """The value that is held may be the edge of two pieces, and count once."""
    problem = ro.Problem.from_strings(
        {"u": "-k*u"}, {"u": "b"}, {"k": (0.1, 1), "b": (0.5, 1.5)}, (0, 3)
    )
    pieces = ro.Solution.join(ro.solve_many(problem, problem.split(b=2), rtol=1e-6))
    times = np.linspace(0.2, 3, 8)
    data = np.exp(-0.4 * times)
    fit = pieces.fit(times, data, sigma=0.03, fixed={"b": 1.0})
    k, s = fit.x["k"], fit.std["k"]
    exact = np.exp(-2 * k + 2 * s**2)
    assert pieces.mean(2.0, under=fit)[0] == pytest.approx(exact, rel=1e-5)
    if not whole:
        return
    event = {"when": "t - 1 - b/3", "then": {"u": "u + b/2"}, "direction": "rising"}
    jumping = ro.solve(
        ro.Problem.from_strings(
            {"u": "-k*u"}, {"u": "b"}, {"k": (0.1, 1), "b": (0.5, 1.5)}, (0, 3), events=[event]
        ),
        1e-4,
    )
    exact += 0.5 * np.exp(-(2 / 3) * k + (2 / 9) * s**2)
    assert jumping.mean(2.0, under=fit)[0] == pytest.approx(exact, rel=1e-3)


def test_sobol_indices_refuse_correlated_estimates_and_say_how():
    with pytest.raises(ro.OptionError, match="not defined for correlated") as refused:
        solved().sobol(5.0, under=fitted())
    assert "correlation={}" in refused.value.remedy
    sobol = solved().sobol(5.0, under=fitted(), correlation={})
    shares = {"a": 25 * fitted().std["a"] ** 2, "c": fitted().std["c"] ** 2, "e": 0.0}
    total = sum(shares.values())
    wanted = [shares[name] / total for name in solved().parameters]
    np.testing.assert_allclose(sobol.first.ravel(), wanted, atol=1e-4)


def test_what_is_refused():
    solution = solved()
    other = ro.solve(ro.Problem.from_strings({"u": "-m*u"}, {"u": 1}, {"m": (0.1, 1)}, (0, 3)))
    with pytest.raises(ro.OptionError, match=r"the fit is of `\w`"):
        other.mean(1.0, under=fitted())
    table = {"t": TIMES, "e": np.where(TIMES > 2, 0.0, 1.0), "x": 1.0 - 0.5 * TIMES}
    several = solution.fit(table, sigma=0.4)
    with pytest.raises(ro.OptionError, match="their own values of `e`"):
        solution.mean(1.0, under=several)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isfinite(solution.fix(e=0).mean(1.0, under=several)).all()
    apart = ro.solve(
        ro.Problem.from_strings({"x": "a"}, {"x": "e"}, {"a": (-5, 5), "e": (1, 2)}, (0, 6)), 1e-6
    )
    with pytest.raises(ro.OptionError, match=r"the fit has e = 0.25, outside \[1, 2\]"):
        apart.mean(1.0, under=fitted())
