"""Fits of PEtab problems from random starts."""

from pathlib import Path

import numpy as np
import pytest

import rankone as ro
from tests.inference.calibration.conversion import skip_without_petab

skip_without_petab()
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

CONVERSION = Path(__file__).parents[3] / "examples" / "conversion"


@pytest.mark.slow
def test_random_starts_reach_a_maximum_of_the_objective():
    problem = ro.read_petab(CONVERSION / "conversion.yaml")
    calibration = problem.fit(starts=2, seed=1)
    assert calibration.agreeing == 2
    assert tuple(calibration.x) == problem.estimated
    least = problem.objective(calibration.x)
    assert calibration.log_likelihood == pytest.approx(-least, abs=1e-9)
    assert least < problem.objective() - 1.0
    for name, x in calibration.x.items():
        for factor in (0.97, 1.03):
            assert problem.objective({**calibration.x, name: factor * x}) > least
    standardised = np.concatenate([each.standardised for each in calibration.comparisons])
    expected = problem.evaluate(calibration.x).standardised
    np.testing.assert_allclose(np.sort(standardised), np.sort(-expected), atol=1e-3)


@pytest.mark.slow
def test_priors_pull_the_fit(tmp_path):
    for file in CONVERSION.iterdir():
        (tmp_path / file.name).write_text(file.read_text())
    lines = (tmp_path / "parameters.tsv").read_text().splitlines()
    lines[0] += "\tobjectivePriorType\tobjectivePriorParameters"
    lines[1:] = [
        line + ("\tparameterScaleNormal\t0.5;0.01" if line.startswith("k1\t") else "\t\t")
        for line in lines[1:]
    ]
    (tmp_path / "parameters.tsv").write_text("\n".join(lines) + "\n")
    problem = ro.read_petab(tmp_path / "conversion.yaml")
    calibration = problem.fit(starts=2, seed=1)
    assert np.log10(calibration.x["k1"]) == pytest.approx(0.5, abs=0.05)
    gradient = problem.evaluate(calibration.x).gradient
    assert np.abs(gradient).max() < 0.5  # of -log L and the prior, by log10 of each parameter
