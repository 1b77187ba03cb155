"""Derivatives of the marginal likelihood and of the modes, against differences of searches."""

from __future__ import annotations

import numpy as np
import pytest

from rankone.inference.populations import individuals
from rankone.inference.populations.individuals import Start
from tests.inference.populations.simulated import oral, population, table_of

H = 2e-3  # Displacements of population parameters
CASES = {
    "correlated": ((0.15, 12), {"random": ["ka", "CL", "V"], "correlated": True}),
    "one shared by all": ((0.15, 12), {"random": ["ka", "V"]}),
    "subjects at an end": ((1.2, 12), {"random": ["ka", "CL", "V"]}),
    "a shared one beyond the end": ((2.4, 12), {"random": ["CL", "V"]}),
}


@pytest.mark.slow
def test_random_effects_that_are_one():
    """Two effects correlate with 1 in six subjects: the covariance is singular at the optimum."""
    fit = population(3, 6, correlated=[("CL", "V")])
    assert fit.success, fit.message
    assert fit.x["correlation_CL_V"] > 0.9999
    assert fit.log_likelihood == pytest.approx(-70.26343, abs=1e-4)
    assert fit.interval()["correlation_CL_V"][0] < 0.0


def test_modes_where_the_covariance_is_singular_but_for_rounding():
    """One of two correlated effects follows the other: how closely does not show in the modes."""
    table = table_of(3, 6)
    fit = oral().fit_population(table, random=["CL", "V"], noise="combined", correlated=True)
    marginal, layout = fit._marginal, fit._marginal.search.layout
    psi = np.tile(fit._psi, (4, 1))
    psi[:, layout.factors.start + 1] = [-12.0, -16.0, -20.0, -24.0]
    values, found = marginal.at(psi, Start.at(np.zeros((6, 2))))
    assert found.converged.all()
    np.testing.assert_allclose(values, values[-1], rtol=1e-7)
    gradient = marginal.slopes(psi, found).gradient
    np.testing.assert_allclose(gradient, np.tile(gradient[-1], (4, 1)), atol=1e-4)


def differences(rows):
    """Derivatives of fourth order."""
    plus, minus, far_plus, far_minus = rows.reshape(4, -1, *rows.shape[1:])
    return (8.0 * (plus - minus) - (far_plus - far_minus)) / (12.0 * H)


@pytest.mark.parametrize(("ends", "options"), CASES.values(), ids=CASES)
def test_derivatives_are_those_of_searches(ends, options, monkeypatch):
    """A step away from the optimum, where no derivative is zero."""
    # differences divide what a search leaves by H: here it goes on to rounding
    tuning = individuals.EffectTuning(least_decrement=1e-14)
    monkeypatch.setattr(individuals, "TUNING", tuning)
    fit = oral().restrict(ka=ends).fit_population(table_of(3, 8), noise="combined", **options)
    marginal, optimum = fit._marginal, fit._optimum
    psi = optimum.psi + 0.05 * np.random.default_rng(1).standard_normal(optimum.psi.size)
    _, here = marginal.at(psi[None], optimum.individuals.start())
    slopes = marginal.slopes(psi[None], here)
    moves = np.concatenate([h * np.eye(psi.size) for h in (H, -H, 2 * H, -2 * H)])
    values, moved = marginal.at(psi + moves, here.start())
    np.testing.assert_allclose(slopes.gradient[0], differences(values), atol=1e-3, rtol=1e-4)
    effects = np.moveaxis(differences(moved.eta), 0, -1)
    np.testing.assert_allclose(slopes.effects[0], effects, atol=1e-4)
    expected = slopes.start(moves).eta
    assert np.abs(expected - moved.eta).max() < 0.05 * np.abs(here.eta - moved.eta).max()
