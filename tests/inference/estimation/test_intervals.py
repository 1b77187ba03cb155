"""Intervals with parameters that the data do not determine: marginal, and labelled where the box
decides."""

import functools

import numpy as np
import pytest

import rankone as ro
from tests.inference.estimation.systems import covered, line, noisy
from tests.reference.designs import DESIGNS, Design

TIMES = np.linspace(0.05, 1.0, 20)
BOX = {"k": (0.3, 3), "a": (0.5, 1.5), "c": (-0.05, 0.05)}
TRUTH = {"k": 1.0, "a": 1.0, "c": 0.0}
SIGMA = 0.02


@functools.cache
def relaxation():
    """x' = -k (x - c), x(0) = a, where c is known from its narrow box alone."""
    problem = ro.Problem.from_strings({"x": "-k*(x - c)"}, {"x": "a"}, dict(BOX), (0, 1))
    return ro.solve(problem, 1e-7)


def relaxed(seed):
    exact = TRUTH["c"] + (TRUTH["a"] - TRUTH["c"]) * np.exp(-TRUTH["k"] * TIMES)
    return relaxation().fit(TIMES, noisy(exact, SIGMA, seed), sigma=SIGMA)


def test_a_level_that_only_its_box_knows():
    """The intervals of the others hold with all of its values, and the covariance is marginal."""
    fit = relaxed(3)
    k, a, c = fit.x.values()
    decay = np.exp(-k * TIMES)
    jacobian = np.stack([-(a - c) * TIMES * decay, decay, 1.0 - decay], axis=1) / SIGMA
    widths = np.ptp(list(BOX.values()), axis=1)
    information = jacobian.T @ jacobian
    marginal = np.linalg.inv(information + np.diag(12.0 / widths**2))
    np.testing.assert_allclose(fit.covariance, marginal, rtol=1e-3)
    alone = np.sqrt(np.linalg.inv(information)[0, 0])
    assert fit.deviation(np.eye(3)[0]) * widths[0] == pytest.approx(alone, rel=1e-3)
    assert fit.identifiable == {"k": True, "a": True, "c": False}
    low, high = fit.interval()["k"]
    for level in BOX["c"]:
        held = relaxation().fit(
            TIMES, fit.observations.values, sigma=SIGMA, fixed={"c": level}, starts=1
        )
        assert low < held.x["k"] < high
    assert fit.limits["k"] == "bounds of `c`"
    assert any(line.split()[:1] == ["k"] and line.endswith("bounds of `c`")
               for line in repr(fit).splitlines())  # fmt: skip
    assert fit.to_dataframe()["limits"]["k"] == "bounds of `c`"
    assert not fit.success


@pytest.mark.slow
def test_coverage_beside_a_level_that_only_its_box_knows():
    fits = [relaxed(seed) for seed in range(60)]
    for method in ("profile", "linear"):
        for name in ("k", "a"):
            inside = sum(covered(fit.interval(method=method)[name], TRUTH[name]) for fit in fits)
            assert inside >= 55, (method, name, inside)


def test_a_bound_ends_an_interval():
    """The closed form: a line through its mean, with a slope that must not be negative."""
    times, sigma = np.linspace(0.0, 1.0, 12), 0.3
    data = noisy(0.4 - 0.1 * times, sigma, 2)
    fit = line().fit(times, data, sigma=sigma, bounds={"b": (0.0, 5.0)})
    slope = np.polyfit(times, data, 1)[0]
    half = 1.959964 * sigma / np.sqrt(np.sum((times - times.mean()) ** 2))
    assert abs(slope) < half
    low, high = fit.interval()["b"]
    assert low == 0.0
    rise = np.sqrt(half**2 + min(slope, 0.0) ** 2)  # above the cost at the best slope allowed
    assert high == pytest.approx(slope + rise, rel=1e-3)
    assert fit.limited == {"a": "", "b": "lower"}
    assert fit.identifiable["b"]
    assert "lower bound" in repr(fit)
    assert not fit.success
    assert fit.profile("b").limited == "lower"


def test_one_side_alone_is_no_success():
    """The data say that b is large, and not how large."""
    fit = relaxation().fit(
        [0.4, 0.8], [0.19, 0.0], sigma=0.1, fixed={"a": 1, "c": 0}, bounds={"k": (0.3, 3)}
    )
    low, high = fit.interval()["k"]
    assert 0.3 < low < fit.x["k"] <= high == 3.0
    assert fit.limited["k"] == "upper"
    assert not fit.success


def test_parameters_of_observables_without_bounds_have_endless_intervals():
    """scale*u + offset*u: the sum alone is seen, and neither has a box."""
    fit = line().fit(
        TIMES,
        noisy(3.0 * (1.0 + TIMES), 0.1, 1),
        observe={"s": "scale*u + offset*u"},
        sigma=0.1,
        fixed={"a": 1, "b": 1},
    )
    assert not any(fit.identifiable.values())
    assert fit.interval()["scale"] == (-np.inf, np.inf)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["enzyme, saturated at first", "a feed of zero, the end of its box"]
)
def test_coverage_of_designs(name):
    """Of 60 data sets; all 400 of each are counted by tests/benchmarks/intervals.py."""
    design: Design = next(each for each in DESIGNS if each.name == name)
    problem = ro.Problem.from_strings(
        dict(design.rates), dict(design.initial), dict(design.box), (0, design.end)
    )
    solution, inside = ro.solve(problem, design.rtol), dict.fromkeys(design.box, 0)
    for k in range(60):
        fit = solution.fit(design.times, design.data(k), sigma=design.sigma)
        assert all(fit.identifiable.values())
        for parameter, interval in fit.interval().items():
            inside[parameter] += covered(interval, design.truth[parameter])
    assert all(count >= 54 for count in inside.values()), inside


@pytest.mark.parametrize("last", [1.0, 1.3, 1.7])
def test_an_interval_goes_on_to_where_an_event_ends_the_solution_before_the_data(last):
    """x = 1 - k t ends at zero: nothing beyond k = 1/last has a value at the last time."""
    events = [{"when": "x", "direction": "falling", "terminal": True}]
    box = {"k": (0.2, 2)}
    problem = ro.Problem.from_strings({"x": "-k"}, {"x": 1}, box, (0, 2), events=events)
    times = np.linspace(0.1, last, 10)
    fit = ro.solve(problem, 1e-6).fit(times, 1.0 - 0.3 * times, sigma=0.8)
    assert fit.interval()["k"] == pytest.approx((0.2, 1.0 / last), rel=1e-4)
