"""Parameters of observables and noise at their best for given states, against SciPy's searches."""

import numpy as np
import pytest
import scipy.optimize

import rankone as ro
from rankone.inference.calibration.trajectory_likelihood import OfFiles
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
    return OfFiles.of_problem(problem._objective, problem.point())


def least(of, at, names):
    """The least cost that searches from many points find at the same states."""
    values = of.likelihood.free.values(at.z[None])
    states, _ = of.likelihood.followed(values)
    which = [of.names.index(name) for name in names]

    def cost(z):
        place = at.z.copy()
        place[which] = np.clip(z, 0.0, 1.0)
        with np.errstate(all="ignore"):
            whole = of.likelihood.costs_of(of.likelihood.free.values(place[None]), states)[0]
        return whole if np.isfinite(whole) else 1e6

    generator, bounds = np.random.default_rng(0), [(0.0, 1.0)] * len(names)
    points = generator.random((30, len(names)))
    best = sorted(points, key=cost)[:2]
    options = {"maxiter": 1500, "maxfev": 1500, "xatol": 1e-6, "fatol": 1e-6}
    return min(
        scipy.optimize.minimize(cost, z, method="Nelder-Mead", bounds=bounds, options=options).fun
        for z in best
    )


def expanded(of, k1, k2):
    """Where searches come to at these rates, from ones."""
    values = dict.fromkeys(of.names, 1.0) | {"k1": k1, "k2": k2, "a0": 1.5}
    return of.expanded(of.places(values))


@pytest.mark.parametrize("case", CASES)
def test_the_best_values_are_those_of_a_search(tmp_path, case):
    lines, names = CASES[case]
    of = likelihood(tmp_path, lines, names)
    assert {name for name, nested in zip(of.names, of.nested) if nested} == set(names)
    at = expanded(of, 0.5, 0.9)
    assert at.cost <= least(of, at, list(names)) + 2e-3


def test_priors_and_bounds_of_nested_parameters_hold(tmp_path):
    lines, names = CASES["a scale, an offset and a level"]
    priors = {"scale": "parameterScaleNormal\t-0.5;0.05", "offset": "normal\t4.5;0.1"}
    of = likelihood(tmp_path, lines, names, priors)
    at = expanded(of, 500.0, 0.002)
    assert at.cost <= least(of, at, list(names)) + 2e-3
    assert of.named(at.z)["offset"] <= 5.0


def test_the_expansion_has_the_objective_of_the_files_but_for_a_constant(tmp_path):
    """At the best values, whose derivatives vanish."""
    lines, names = CASES["two observables with a scale and a level each, and one level of both"]
    of = likelihood(tmp_path, lines, names)
    at, other = (of.expanded(np.full(len(of.names), z)) for z in (0.45, 0.5))
    difference = -2.0 * (of.log_likelihood(at) - of.log_likelihood(other))
    assert at.cost - other.cost == pytest.approx(difference, abs=2e-2)
    gradient = at.jacobian.T @ at.residuals
    assert np.abs(gradient[of.nested]).max() < 1e-6 * np.abs(gradient[~of.nested]).max()
