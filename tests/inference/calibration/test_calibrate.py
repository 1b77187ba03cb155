"""Parameters over many decades from data: the starts, the boxes, and what is said of them."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import rankone as ro
from rankone.inference.calibration import calibrate as boxes
from tests.reference.designs import WIDE

TRUTH = {"k1": 0.04, "k2": 1e4, "k3": 3e7}
TIMES = np.geomspace(0.01, 40, 12)


@pytest.fixture(scope="module")
def kinetics():
    """Robertson's reaction, each rate over eight decades."""
    return ro.Problem.from_strings(
        rhs={"x": "-k1*x + k2*y*z", "y": "k1*x - k2*y*z - k3*y**2", "z": "k3*y**2"},
        initial={"x": "1", "y": "0", "z": "0"},
        parameters={"k1": (1e-6, 1e2, "log"), "k2": (1, 1e8, "log"), "k3": (1e3, 1e11, "log")},
        time=(0, 40),
    )


def concentrations(k1, k2, k3):
    """States of Robertson's reaction (3, times) by SciPy alone."""

    def rates(t, u):
        return [-k1 * u[0] + k2 * u[1] * u[2], k1 * u[0] - k2 * u[1] * u[2] - k3 * u[1] ** 2,
                k3 * u[1] ** 2]  # fmt: skip

    return solve_ivp(rates, (0, 40), [1, 0, 0], "Radau", TIMES, rtol=1e-10, atol=1e-14).y


def measured(states, share=0.02):
    """An experiment that measures all states with relative noise."""
    noise = np.random.default_rng(1).normal(size=states.shape)
    names = dict(zip("xyz", states, strict=True))
    data = dict(zip("xyz", states * (1.0 + share * noise), strict=True))
    sigma = {name: share * np.abs(curve) for name, curve in names.items()}
    return ro.Experiment(data, dict.fromkeys(names, TIMES), sigma=sigma), data, sigma


def log_likelihood(data, sigma, **rates):
    """The density of the data, with nothing of rankone."""
    whole = 0.0
    for name, curve in zip("xyz", concentrations(**rates), strict=True):
        r = (data[name] - curve) / sigma[name]
        whole -= float(np.sum(0.5 * r**2 + np.log(sigma[name]) + 0.5 * np.log(2 * np.pi)))
    return whole


@pytest.mark.slow
def test_every_start_over_eight_decades_reaches_the_optimum(kinetics):
    experiment, data, sigma = measured(concentrations(**TRUTH))
    calibration = ro.calibrate(kinetics, experiment, starts=4, seed=3)
    assert calibration.success, calibration.message
    assert calibration.agreeing == 4
    best = log_likelihood(data, sigma, **calibration.x)
    assert calibration.log_likelihood == pytest.approx(best, abs=0.01)
    for name in TRUTH:  # a maximum, by SciPy alone
        for factor in (0.99, 1.01):
            moved = {**calibration.x, name: factor * calibration.x[name]}
            assert log_likelihood(data, sigma, **moved) < best
    (box,) = calibration.boxes
    assert box.solved and box.inside  # noqa: PT018
    for name, (low, high) in calibration.fit.interval(0.99).items():
        assert low < TRUTH[name] < high
    for name, ends in calibration.fit.interval().items():
        np.testing.assert_allclose(calibration.intervals[name], ends, rtol=2e-3)


@pytest.mark.slow
def test_boxes_follow_the_fit_to_an_optimum_far_outside_of_the_first(kinetics):
    experiment, data, sigma = measured(concentrations(**TRUTH))
    calibration = ro.calibrate(kinetics, experiment, starts=1, seed=1, search="boxes")
    first = calibration.boxes[0].intervals
    assert any(not low < TRUTH[name] < high for name, (low, high) in first.items())
    assert len(calibration.boxes) > 2
    best = log_likelihood(data, sigma, **calibration.x)
    assert calibration.log_likelihood == pytest.approx(best, abs=0.01)
    assert best > log_likelihood(data, sigma, **TRUTH)


@pytest.mark.slow
def test_the_best_of_two_minima_is_reported_and_the_other_shown():
    problem = ro.Problem.from_strings(
        rhs={"x": "v", "v": "-w**2*x"},
        initial={"x": "1", "v": "0"},
        parameters={"w": (0.3, 30, "log")},
        time=(0, 6),
    )
    times = np.linspace(0.2, 6, 30)
    experiment = ro.Experiment(np.cos(3.0 * times), times, observe="x", sigma=0.1)
    calibration = ro.calibrate(problem, experiment, starts=4, seed=0, box=False)
    assert calibration.x["w"] == pytest.approx(3.0, rel=1e-4)
    ends = [start.log_likelihood for start in calibration.starts]
    assert ends == sorted(ends, reverse=True)
    assert ends[-1] < ends[0] - 10.0  # a frequency that is wrong, at a minimum of its own
    assert calibration.agreeing < len(ends)


def test_parameters_that_the_data_do_not_tell_apart_are_named():
    problem = ro.Problem.from_strings(
        rhs={"x": "-a*b*x - c*x**2"},
        initial={"x": "1"},
        parameters={"a": (1e-3, 1e3, "log"), "b": (1e-3, 1e3, "log"), "c": (1e-3, 1e3, "log")},
        time=(0, 3),
    )
    times = np.linspace(0.1, 3, 20)

    def rates(t, u):
        return [-0.8 * u[0] - 1.5 * u[0] ** 2]

    curve = solve_ivp(rates, (0, 3), [1.0], "LSODA", times, rtol=1e-10, atol=1e-13).y[0]
    noise = 0.01 * np.random.default_rng(2).normal(size=20)
    experiment = ro.Experiment(curve + noise, times, observe="x", sigma=0.01)
    calibration = ro.calibrate(problem, experiment, starts=3, seed=0)
    assert calibration.not_identified == ("a", "b")
    assert not calibration.success
    assert "the data do not identify `a` and `b`" in calibration.message
    assert set(calibration.boxes[-1].intervals) == {"c"}
    assert calibration.x["a"] * calibration.x["b"] == pytest.approx(0.8, rel=0.2)
    # the interval holds for all values of the others, that of the fit for those that it holds
    fit, (low, high) = calibration.fit, calibration.intervals["c"]
    inner = fit.interval()["c"]
    assert low < inner[0] < inner[1] < high
    assert high - low > 1.5 * (inner[1] - inner[0])
    assert set(fit.held) == {"a", "b"}
    assert "`a` and `b` held" in repr(fit)
    assert not fit.success


def calibrated(name, k):
    """A design of wide bounds, calibrated from a data set."""
    design = next(each for each in WIDE if each.name == name)
    problem = ro.Problem.from_strings(
        dict(design.rates), dict(design.initial), dict(design.box), (0, design.end)
    )
    experiment = ro.Experiment(
        design.data(k), design.times, observe=design.observed, sigma=design.sigma
    )
    return ro.calibrate(problem, experiment, starts=4, seed=k), design


@pytest.mark.slow
def test_a_cascade_whose_fastest_rate_has_no_upper_bound():
    calibration, design = calibrated("cascade over four decades", 0)
    assert calibration.limited == {"k1": "upper"}
    assert calibration.intervals["k1"][1] == design.box["k1"][1]
    assert "upper bound" in repr(calibration)
    for name in ("k2", "k3"):
        low, high = calibration.intervals[name]
        assert low < design.truth[name] < high
    assert not calibration.success
    assert not calibration.fit.success


def test_a_volume_that_the_data_do_not_tell_has_no_interval():
    calibration, _ = calibrated("a volume of which only the clearance over it is seen", 0)
    assert {*calibration.not_identified, *calibration.limited} >= {"CL", "V"}
    assert "inf" not in repr(calibration)
    assert not calibration.success
    for low, high in calibration.intervals.values():
        assert low > 0.0
        assert np.isfinite(high)


def rise(design, k, name, value):
    """How much the sum of squares rises with a parameter held, by SciPy from many starts."""
    names = list(design.box)
    j = names.index(name)

    def residuals(z):
        at = {each: design.value(each, float(place)) for each, place in zip(names, z, strict=True)}
        return (design.curve(design.times, **at) - design.data(k)) / design.sigma

    def least(free, held):
        starts = np.random.default_rng(0).random((6, len(names) - len(held)))
        costs = [least_squares(lambda z: free(z, *held), s, bounds=(0, 1)).cost for s in starts]
        return 2.0 * min(costs)

    whole = least(residuals, ())
    return (
        least(lambda z, place: residuals(np.insert(z, j, place)), (design.place(name, value),))
        - whole
    )


@pytest.mark.parametrize(
    ("k", "words"), [pytest.param(15, "", marks=pytest.mark.slow), (0, "bounds of `ka` and `ke`")]
)
def test_ends_of_intervals_are_those_of_whole_profiles(k, words):
    """The sum of squares has two valleys over the rates, of which one is nearly flat in `ka`."""
    calibration, design = calibrated("oral dose from wide bounds", k)
    for name in ("ke", "V"):
        for end in set(calibration.intervals[name]) - set(design.box[name]):
            assert rise(design, k, name, end) == pytest.approx(1.96**2, rel=0.05)
    assert calibration.limits["V"] == words
    assert words in repr(calibration)


def decaying(scale, **options):
    """A decay in units of which a scale is one, with noise of a deviation that is not told."""
    times = np.linspace(0.2, 6.0, 30)
    noise = np.random.default_rng(5).standard_normal(30)
    problem = ro.Problem.from_strings(
        {"x": "-k*x"},
        {"x": "a"},
        {"k": (0.01, 100, "log"), "a": (0.1 * scale, 100 * scale, "log")},
        (0, 6),
    )
    data = scale * (2.0 * np.exp(-0.5 * times) + 0.02 * noise)
    experiment = ro.Experiment(data, times, observe="x")
    return ro.calibrate(problem, experiment, starts=4, seed=1, box=False, **options)


@pytest.mark.parametrize(
    ("scale", "search"),
    [
        (1e-9, "trajectories"),
        (1e6, "trajectories"),
        pytest.param(1e-9, "boxes", marks=pytest.mark.slow),
    ],
)
def test_units_of_the_data_do_not_matter(scale, search):
    usual, other = decaying(1.0, search=search), decaying(scale, search=search)
    assert other.success, other.message
    assert [s.iterations for s in other.starts] == [s.iterations for s in usual.starts]
    assert other.x["k"] == pytest.approx(usual.x["k"], rel=1e-6)
    assert other.intervals["k"] == pytest.approx(usual.intervals["k"], rel=1e-4)


def test_every_start_has_boxes_of_its_own(monkeypatch):
    monkeypatch.setattr(boxes, "TUNING", boxes.BoxTuning(most_boxes=4))
    calibration = decaying(1.0, search="boxes")
    assert len(calibration.boxes) > 4
    assert all(start.arrived and start.iterations for start in calibration.starts)
    assert calibration.agreeing == 4


def test_an_unknown_noise_widens_intervals_as_in_a_fit():
    """Student's quantile and the variance without bias, as a fit in a box has them."""
    times = np.linspace(0.2, 3.0, 8)
    data = 2.0 * np.exp(-0.7 * times) + 0.05 * np.random.default_rng(4).normal(size=8)
    problem = ro.Problem.from_strings(
        {"x": "-k*x"}, {"x": "a"}, {"k": (0.1, 10, "log"), "a": (0.1, 10, "log")}, (0, 3)
    )
    calibration = ro.calibrate(problem, ro.Experiment(data, times, observe="x"), starts=2)
    assert calibration.success, calibration.message
    for name, ends in calibration.fit.interval().items():
        np.testing.assert_allclose(calibration.intervals[name], ends, rtol=5e-3)


@pytest.mark.slow
def test_workers_take_starts_and_change_no_bit(kinetics):
    experiment, _, _ = measured(concentrations(**TRUTH))
    options = {"starts": 4, "seed": 3, "box": False}
    here = ro.calibrate(kinetics, experiment, **options)
    there = ro.calibrate(kinetics, experiment, executor=1, **options)
    assert there.x == here.x
    assert there.log_likelihood == here.log_likelihood
    assert repr(there.starts) == repr(here.starts)


def test_what_a_calibration_cannot_take_is_said(kinetics):
    experiment, _, _ = measured(concentrations(**TRUTH))
    with pytest.raises(ro.OptionError, match="search='boxes' takes no executor"):
        ro.calibrate(kinetics, experiment, search="boxes", executor=2)
    with pytest.raises(ro.OptionError, match="executor='here' is not valid"):
        ro.calibrate(kinetics, experiment, executor="here")
    with pytest.raises(ro.OptionError, match="search='gradient' is unknown"):
        ro.calibrate(kinetics, experiment, search="gradient")
    with pytest.raises(ro.OptionError, match="no list of experiments"):
        ro.calibrate(kinetics, [])
    with pytest.raises(ro.OptionError, match="starts"):
        ro.calibrate(kinetics, experiment, starts=0)
    with pytest.raises(ro.RankoneError, match="Problem"):
        ro.calibrate("kinetics", experiment)
    event = ro.Problem.from_strings(
        rhs={"x": "-k*x"},
        initial={"x": "1"},
        parameters={"k": (0.1, 10, "log")},
        time=(0, 3),
        events=[{"when": "x - 0.5", "direction": "falling", "then": {"x": "x + 1"}}],
    )
    with pytest.raises(ro.OptionError, match="events"):
        ro.calibrate(event, ro.Experiment([1.0, 2.0], [0.1, 0.2]))
    jump = ro.Problem.from_strings(
        {"x": "-k*x + Heaviside(x - 1/2)"}, {"x": "1"}, {"k": (0.1, 10, "log")}, (0, 3)
    )
    lag = ro.Problem.from_strings(
        {"x": "-k*x + Heaviside(t - lag)"}, {"x": "1"}, {"k": (0.1, 10), "lag": (0.5, 1.5)}, (0, 3)
    )
    with pytest.raises(ro.ProblemError, match="rates jump where `lag` says"):
        ro.calibrate(lag, ro.Experiment([1.0, 2.0], [0.1, 0.2]))
    with pytest.raises(ro.ProblemError, match="rates jump with the states"):
        ro.calibrate(jump, ro.Experiment([1.0, 2.0], [0.1, 0.2]))
