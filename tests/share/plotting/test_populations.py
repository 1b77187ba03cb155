"""Curves of subjects, and predictive checks, are those of the fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import rankone as ro
from rankone import plotting
from tests.inference.populations.simulated import levels, one_way
from tests.share.plotting.drawn import legend, lines


def test_subjects():
    fit = levels()
    axes = plotting.plot_population(fit, subjects=[0, "3"])
    assert [ax.get_title() for ax in axes] == ["0", "3"]
    for ax, subject in zip(axes, (0, 3), strict=True):
        (_, typical), (_, curve), (times, data) = lines(ax)
        np.testing.assert_allclose(typical, fit.x["a"])
        np.testing.assert_allclose(curve, fit.individuals["a"][subject], rtol=1e-6)
        np.testing.assert_array_equal(data, one_way(1)[subject])
        np.testing.assert_allclose(times, np.linspace(0, 4, 4))
    assert len(plotting.plot_population(fit)) == 12
    assert [ax.get_title() for ax in plotting.plot_population(fit, subjects=range(3))] == list(
        "012"
    )


def test_predictive_check():
    check = levels().predictive_check()
    (ax,) = plotting.plot_population(check)
    assert legend(ax) == ["data", "quantiles of data: 5, 50, 95 %", "simulated: 95 %"]
    for (_, curve), quantile in zip(lines(ax), check.observed, strict=False):
        np.testing.assert_array_equal(curve, quantile)
    assert len(ax.collections) == 3


def test_units():
    fit = levels()
    solution = fit.solution
    metadata = replace(solution.metadata, units=(("u", "mg/l"), ("t", "h")))
    check = replace(fit.predictive_check(), solution=ro.Solution(solution.outcome, metadata))
    (ax,) = plotting.plot_population(check)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("t [h]", "u [mg/l]")
    assert {ax.get_ylabel() for ax in plotting.plot_population(fit)} == {"u"}


def test_what_is_refused():
    with pytest.raises(ro.OptionError, match="no subject `x`"):
        plotting.plot_population(levels(), subjects=["x"])
    with pytest.raises(ro.OptionError, match="needs a PopulationFit"):
        plotting.plot_population(3)
    with pytest.raises(ro.OptionError, match="all subjects"):
        plotting.plot_population(levels().predictive_check(), subjects=[1])
    with pytest.raises(ro.OptionError, match="`v` was not observed"):
        plotting.plot_population(levels(), observable="v")
