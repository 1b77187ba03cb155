"""Parameters of observables and noise at their best for given states, against SciPy's searches."""

import numpy as np
import pytest
import scipy.optimize

import rankone as ro
from rankone.inference.calibration.searched import OfFiles
from tests.inference.calibration.conversion import (
    PARAMETERS,
    rows,
    skip_without_petab,
    table,
    write,
)

skip_without_petab()
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

FINITE = [line for line in rows() if line[4] != "inf"]
HEADER = (
    "observableId\tobservableFormula\tnoiseFormula\tobservableTransformation\tnoiseDistribution"
)
NESTED = {
    "scale": "log10\t0.01\t100",
    "sd_B": "log10\t0.001\t10",
    "offset": "lin\t-5\t5",
    "factor": "log10\t0.0001\t10000",
    "sd_A": "log\t0.0001\t10",
    "rel_A": "log10\t0.0001\t10",
}
CASES = {
    "a scale, an offset and a level": (
        ["obs_B\tobservableParameter1_obs_B * B + offset\tnoiseParameter1_obs_B\tlin\tnormal"],
        ("scale", "offset", "sd_B"),
    ),
    "two observables with a scale and a level each, and one level of both": (
        [
            "obs_B\tobservableParameter1_obs_B * B\tnoiseParameter1_obs_B\tlin\tnormal",
            "obs_A\tfactor * A\tsd_A\tlin\tnormal",
            "obs_share\tfactor * A / (A + B)\tsd_B\tlin\tnormal",
        ],
        ("scale", "factor", "sd_B", "sd_A"),
    ),
    "noise that grows with the observable": (
        ["obs_A\tfactor * A\tsd_A + rel_A * factor * A\tlin\tnormal"],
        ("factor", "sd_A", "rel_A"),
    ),
    "logarithms": (
        ["obs_A\toffset + factor * A\tsd_A\tlog10\tnormal"],
        ("offset", "factor", "sd_A"),
    ),
    "Laplace's noise": (
        ["obs_A\tA\tsd_A\tlin\tlaplace", "obs_share\tA\trel_A\tlog\tlaplace"],
        ("sd_A", "rel_A"),
    ),
}


def likelihood(folder, lines, names, priors=None):
    """The problem with these observables, as searches take it."""
    observed = {line.split("\t")[0] for line in lines}
    priors = priors or {}
    header, *states = PARAMETERS.split("\n")[:4]
    own = [f"{n}\t{NESTED[n]}\t0.5\t1" for n in names]
    listed = [f"{line}\t{priors.get(line.split()[0], chr(9))}" for line in [*states, *own]]
    header += "\tobjectivePriorType\tobjectivePriorParameters"
    files = {
        "observables": "\n".join([HEADER, *lines]) + "\n",
        "parameters": "\n".join([header, *listed]) + "\n",
        "measurements": table([line for line in FINITE if line[0] in observed]),
    }
    problem = ro.read_petab(write(folder, **files))
    return OfFiles.of(problem._evaluator, problem.point())


def least(nested, simulated, values, names):
    """The least objective that searches from many points find at the same states."""
    cube = nested.cube.some(names)

    def cost(z):
        try:
            here = {**values, **cube.named(np.clip(z, 0.0, 1.0))}
            return nested.evaluator.evaluated(simulated, here, ()).objective
        except ro.RankoneError:
            return 1e6

    generator, bounds = np.random.default_rng(0), [(0.0, 1.0)] * len(names)
    points = generator.random((30, len(names)))
    best = sorted(points, key=cost)[:2]
    options = {"maxiter": 1500, "maxfev": 1500, "xatol": 1e-6, "fatol": 1e-6}
    return min(
        scipy.optimize.minimize(cost, z, method="Nelder-Mead", bounds=bounds, options=options).fun
        for z in best
    )


@pytest.mark.parametrize("case", CASES)
def test_the_best_values_are_those_of_a_search(tmp_path, case):
    lines, names = CASES[case]
    of = likelihood(tmp_path, lines, names)
    assert set(of.best.names) == set(names)
    values = {**of.fixed, "k1": 0.5, "k2": 0.9, **dict.fromkeys(names, 1.0)}
    simulated = of.evaluator.simulated(values, (), 1e-8)
    best = of.best.best(simulated, values)
    reached = of.evaluator.evaluated(simulated, best, ()).objective
    assert reached <= least(of.best, simulated, values, list(names)) + 1e-3


def test_priors_and_bounds_of_nested_parameters_hold(tmp_path):
    lines, names = CASES["a scale, an offset and a level"]
    priors = {"scale": "parameterScaleNormal\t-0.5;0.05", "offset": "normal\t4.5;0.1"}
    of = likelihood(tmp_path, lines, names, priors)
    values = {**of.fixed, "k1": 500.0, "k2": 0.002}
    simulated = of.evaluator.simulated(values, (), 1e-8)
    best = of.best.best(simulated, values)
    reached = of.evaluator.evaluated(simulated, best, ()).objective
    assert reached <= least(of.best, simulated, values, list(names)) + 1e-3
    assert best["offset"] <= 5.0


def test_the_expansion_has_the_objective_of_the_files(tmp_path):
    """At the best values, whose derivatives vanish."""
    lines, names = CASES["two observables with a scale and a level each, and one level of both"]
    of = likelihood(tmp_path, lines, names)
    at = of.expanded(np.full(len(of.names), 0.45))
    assert at.cost == pytest.approx(-2.0 * of.log_likelihood(at), abs=1e-2)
    gradient = at.jacobian.T @ at.residuals
    assert np.abs(gradient[of.nested]).max() < 1e-6 * np.abs(gradient[~of.nested]).max()
