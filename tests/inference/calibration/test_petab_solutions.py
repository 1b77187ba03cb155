"""Solutions of PEtab problems over boxes: what they say is what trajectories say."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

import rankone as ro
from rankone.inference.calibration.records import Prior
from tests.inference.calibration.conversion import (
    MODEL,
    OBSERVABLES,
    PARAMETERS,
    rows,
    simulated,
    skip_without_petab,
    table,
    write,
)

skip_without_petab()

NORMAL = OBSERVABLES.replace("laplace", "normal")
BOX = {"k1": (0.4, 1.6), "k2": (0.3, 1.2)}


def fixed(*names):
    """The table of parameters, some of which are not estimated."""
    lines = PARAMETERS.strip().split("\n")
    return "\n".join(x[:-1] + "0" if x.split("\t")[0] in names else x for x in lines) + "\n"


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    """Without measurements at infinite times, Laplace's noise and levels of noise."""
    finite = [line for line in rows() if line[4] != "inf"]
    files = {"observables": NORMAL, "measurements": table(finite), "parameters": fixed("sd_B")}
    return ro.read_petab(write(tmp_path_factory.mktemp("petab"), **files))


@pytest.fixture(scope="module")
def solutions(problem):
    return problem.solve(1e-6, box=BOX)


def test_each_experiment_has_a_solution(problem, solutions):
    assert solutions.success
    assert list(solutions.solutions) == ["low", "rest -> high"]
    assert solutions.error <= 1e-6
    high = problem.problem("rest -> high", box=BOX)
    t, at = np.array([0.3, 1.5]), {"k1": 0.5, "k2": 1.1}
    np.testing.assert_allclose(
        solutions.solutions["rest -> high"](t=t, **at),
        high.trajectory(t, at, rtol=1e-10).values,
        rtol=1e-5,
    )
    assert repr(solutions).splitlines()[0] == "CalibrationSolutions: 2 solutions for 2 experiments"


def test_a_fit_has_the_likelihood_of_trajectories(problem, solutions):
    """The scale is fitted with the rates, though no solution has it; a0 is nominal."""
    fit = solutions.fit()
    assert set(fit.x) == {"k1", "k2", "scale"}
    assert -fit.log_likelihood == pytest.approx(problem.objective(fit.x), abs=1e-4)
    at = problem.evaluate(fit.x)
    assert np.abs(at.gradient[[at.parameters.index(name) for name in fit.x]]).max() < 1e-2


@pytest.mark.parametrize(
    "prior",
    [
        Prior("normal", "log10", 0.1, 0.02, of_value=False),
        Prior("normal", "log", 0.3, 0.05, of_value=True),
        Prior("laplace", "lin", 1.2, 0.02, of_value=True),
        Prior("normal", "lin", 1.2, 0.02, of_value=True),
        Prior("uniform", "log10", -2.0, 1.0, of_value=False),
    ],
    ids=lambda prior: f"{prior.shape}, {prior.scale}",
)
def test_a_penalty_is_the_prior_of_the_objective_up_to_a_constant(prior):
    places = np.array([0.4, 0.9, 1.1, 1.5])
    costs = np.array([prior.cost(x)[0] for x in places])
    np.testing.assert_allclose(np.diff(-prior.penalty().logpdf(places)), np.diff(costs), atol=1e-9)


def test_priors_of_the_table_pull_a_fit(problem, solutions):
    prior = Prior("normal", "log10", 0.1, 0.02, of_value=False)
    pulled = replace(solutions, penalties={"k1": prior.penalty()})
    x = pulled.fit().x
    by_k1 = problem.evaluate(x).gradient[0]
    slope = prior.cost(x["k1"])[1] * x["k1"] * np.log(10.0)
    assert abs(slope) > 10.0
    assert by_k1 == pytest.approx(-slope, rel=1e-2)
    assert "k1" not in pulled.fit(fixed={"k1": 0.7}).x
    with pytest.raises(ro.ProblemError, match="prior of `k1` is Laplace's of its logarithm"):
        replace(solutions, penalties={"k1": None}).fit()


@pytest.mark.slow
def test_a_box_follows_a_fit(problem):
    calibration = problem.fit(starts=1, seed=3)
    solutions = problem.solve(1e-4, around=calibration)
    assert solutions.success
    (low, *_) = solutions.solutions.values()
    for name, (lower, upper) in low.parameters.items():
        assert lower < calibration.x[name] < upper
        assert upper <= 9.01 * lower
    fit = solutions.fit()
    assert -fit.log_likelihood == pytest.approx(problem.objective(fit.x), abs=1e-3)
    assert fit.log_likelihood == pytest.approx(calibration.log_likelihood, abs=1e-2)
    with pytest.raises(ro.OptionError, match="needs a Calibration, not dict"):
        problem.solve(1e-4, around=calibration.x)
    with pytest.raises(ro.OptionError, match="values and around"):
        problem.solve(1e-4, around=calibration, values={"k1": 1.0})
    with pytest.raises(ro.OptionError, match="no parameter `k3`"):
        problem.solve(1e-4, box=["k3"], around=calibration)


def test_a_posterior_has_the_mean_of_the_density_by_trajectories(problem, solutions):
    """One free rate, uniform in its logarithm: the mean over a grid of objectives."""
    fixed = {"k2": 0.6, "scale": 2.0}
    posterior = ro.posterior(solutions.fit(fixed=fixed))
    z, weights = np.polynomial.legendre.leggauss(24)
    k1 = np.exp(0.5 * (np.log(1.6) + np.log(0.4) + z * np.log(4.0)))
    logs = np.array([-problem.objective({"k1": x, **fixed}, rtol=1e-7) for x in k1])
    density = weights * np.exp(logs - logs.max())
    mean = float(k1 @ density / density.sum())
    assert posterior.mean["k1"] == pytest.approx(mean, rel=1e-3)


def test_a_parameter_that_a_condition_makes_vanish_is_left_out(tmp_path):
    """k1 times a dose of zero: it acts where the condition before has a dose, and only there."""
    model = MODEL.replace("<plus/><ci>k1</ci>", "<times/><ci>k1</ci>")
    assert model != MODEL
    conditions = "conditionId\tdose\nrest\t3\nlow\t0\nhigh\t0\n"
    files = {"model": model, "conditions": conditions, "observables": NORMAL}
    problem = ro.read_petab(write(tmp_path, **files))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        names = {
            each: [*problem.problem(each, box=BOX).parameters] for each in ("low", "rest -> high")
        }
    assert [str(symbol) for symbol in names["low"]] == ["k2"]
    assert [str(symbol) for symbol in names["rest -> high"]] == ["k1", "k2"]


def test_many_conditions_share_a_solution(tmp_path):
    doses = np.linspace(0.2, 1.4, 5)
    conditions = "conditionId\tdose\n" + "".join(f"d{i}\t{d}\n" for i, d in enumerate(doses))
    lines = [
        ("obs_A", "", f"d{i}", repr(float(np.exp(-d))), at, "", "")
        for i, d in enumerate(doses)
        for at in ("0.5", "1")
    ]
    parameters = "\n".join(PARAMETERS.split("\n")[:4]) + "\n"
    observables = "\n".join([NORMAL.split("\n")[0], NORMAL.split("\n")[3]]) + "\n"
    files = {"measurements": table(lines), "parameters": parameters, "observables": observables}
    problem = ro.read_petab(write(tmp_path, conditions=conditions, **files))
    solutions = problem.solve(1e-5, box=["k1", "k2"], spread=1.3)
    assert len({id(solution) for solution in solutions.solutions.values()}) == 1
    assert [*solutions.solutions["d0"].parameters] == ["k1", "k2", "dose"]
    fit = solutions.fit()
    assert -fit.log_likelihood == pytest.approx(problem.objective(fit.x), abs=1e-3)


def test_what_solutions_do_not_have_is_refused(tmp_path):
    problem = ro.read_petab(write(tmp_path))
    with pytest.raises(ro.ProblemError, match="`obs_share` is Laplace's"):
        problem.solve(1e-3, box=BOX)
    with pytest.raises(ro.OptionError, match="`scale` is in no rate"):
        problem.solve(1e-3, box=["scale"])
    with pytest.raises(ro.OptionError, match="no parameter `k3`"):
        problem.solve(1e-3, box={"k3": (1, 2)})
    with pytest.raises(ro.OptionError, match="an experiment has to be chosen"):
        problem.problem()
    with pytest.raises(ro.OptionError, match="no experiment `lo`"):
        problem.problem("lo")
    normal = ro.read_petab(write(tmp_path, observables=NORMAL))
    with pytest.raises(ro.ProblemError, match="at the steady state in `rest -> high`"):
        normal.solve(1e-3, box=BOX)


def test_levels_of_noise_have_the_names_and_the_bounds_of_the_table(tmp_path):
    """A name like that of the observable, a prediction that begins at zero, an idle level."""
    formula = "observableParameter1_obs_B * (B - 0.2)"
    header = OBSERVABLES.split("\n")[0]
    generator = np.random.default_rng(3)
    times = np.repeat(np.linspace(0.0, 3.0, 7), 2)
    measured = 2.0 * (simulated("low", "", times)[1] - 0.2) + generator.normal(0.0, 0.05, 14)
    lines = [
        ("obs_B", "", "low", repr(float(y)), str(at), "scale", "")
        for at, y in zip(times, measured, strict=True)
    ]
    levels = "sd_obs_B\tlog10\t1e-05\t1000\t0.1\t1\nrel\tlog10\t1e-05\t1000\t1e-5\t1\n"
    problem = ro.read_petab(
        write(
            tmp_path,
            observables=f"{header}\nobs_B\t{formula}\tsd_obs_B + rel * {formula}\tlin\tnormal\n",
            measurements=table(lines),
            parameters=fixed("k2", "a0").split("sd_B")[0] + levels,
        )
    )
    fit = problem.solve(1e-5, box={"k1": (0.4, 1.6)}).fit()
    assert set(fit.x) == {"k1", "scale", "sd_obs_B", "rel"}
    assert -fit.log_likelihood == pytest.approx(problem.objective(fit.most_likely), abs=1e-3)
    assert fit.most_likely["rel"] == pytest.approx(1e-5, rel=0.5)
