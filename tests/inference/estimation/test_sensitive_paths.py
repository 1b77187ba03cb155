"""Derivatives of trajectories with respect to parameters."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rankone as ro
from rankone.inference.estimation.fitted_models import sensitive_to_parameters
from rankone.trajectories.integrators.integrator import Tolerances


@pytest.mark.slow
def test_stiff_kinetics_agree_with_differences_of_tight_trajectories():
    problem = ro.Problem.from_strings(
        rhs={
            "x": "-k1*x + k2*y*z",
            "y": "k1*x - k2*y*z - k3*y**2",
            "z": "k3*y**2",
        },
        initial={"x": "a", "y": "0", "z": "0"},
        parameters={"k1": (0.01, 0.1), "k2": (1e3, 1e5), "k3": (1e7, 1e8), "a": (0.5, 2)},
        time=(0, 40),
    )
    system, point = ro.compile(problem).system, np.array([0.04, 1e4, 3e7, 1.0])
    times = np.array([0.0, 0.1, 1.0, 40.0])
    tolerances = Tolerances(1e-5, np.full((3, 1), 1e-10))
    free = [0, 2, 3]
    sensitive = sensitive_to_parameters(system, point, (0.0, 40.0), tolerances, times, free)

    def reference(p):
        def rates(t, u):
            forth, back, slow = p[0] * u[0], p[1] * u[1] * u[2], p[2] * u[1] ** 2
            return [-forth + back, forth - back - slow, slow]

        start = [p[3], 0.0, 0.0]
        return solve_ivp(rates, (0, 40), start, "Radau", times, rtol=1e-11, atol=1e-16).y.T

    np.testing.assert_allclose(sensitive.states, reference(point), rtol=1e-5, atol=1e-12)
    for column, j in enumerate(free):
        step = 1e-4 * point[j] * (np.arange(4) == j)
        expected = (reference(point + step) - reference(point - step)) / (2.0 * step[j])
        error = np.abs(sensitive.slopes[..., column] - expected).max(axis=0)
        assert (error <= 1e-6 * np.abs(expected).max(axis=0)).all()


def test_jumps_carry_the_derivatives_of_what_they_reset():
    problem = ro.Problem.from_strings(
        rhs={"c": "-k*c"},
        initial={"c": "d"},
        parameters={"k": (0.1, 2), "d": (1, 5)},
        time=(0, 2),
        jumps={1: {"c": "c/2 + d**2"}},
    )
    system, (k, d) = ro.compile(problem).system, (0.5, 3.0)
    times = np.array([0.5, 1.0, 2.0])
    tolerances = Tolerances(1e-7, np.full((1, 1), 1e-12))
    point, edges = np.array([k, d]), (0.0, 1.0, 2.0)
    sensitive = sensitive_to_parameters(system, point, edges, tolerances, times, [0, 1])
    early, late = np.exp(-k * times), np.exp(-k * (times - 1.0))
    after = times >= 1.0
    by_k = np.where(after, -0.5 * d * times * early - d**2 * (times - 1) * late, -d * times * early)
    by_d = np.where(after, 0.5 * early + 2.0 * d * late, early)
    np.testing.assert_allclose(sensitive.slopes[:, 0], np.stack([by_k, by_d], axis=1), rtol=1e-7)


def test_nothing_is_said_beyond_the_end_of_a_trajectory():
    problem = ro.Problem.from_strings(
        rhs={"x": "k*x**2"}, initial={"x": "1"}, parameters={"k": (0.1, 2)}, time=(0, 1)
    )
    system = ro.compile(problem).system
    times, tolerances = np.array([0.25, 0.75]), Tolerances(1e-6, np.full((1, 1), 1e-9))
    sensitive = sensitive_to_parameters(system, np.array([2.0]), (0.0, 1.0), tolerances, times, [0])
    np.testing.assert_allclose(sensitive.slopes[0, 0], [0.25 / 0.5**2], rtol=1e-5)
    assert np.isnan(sensitive.states[1]).all()
    assert np.isnan(sensitive.slopes[1]).all()
