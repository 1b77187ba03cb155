"""Implicit steps of stacks: accurate, and their Newton matrices serve several steps."""

import numpy as np
import pytest

import rankone as ro
from rankone.trajectories.integrators.integrator import Spans, Tolerances
from rankone.trajectories.stacks import newton
from rankone.trajectories.stacks import stack as integrator
from rankone.trajectories.stacks.implicit import StackedRadau
from rankone.trajectories.stacks.stack import StackedIntegrator

STIFF = StackedIntegrator(stiff=True)


def forced(rates=(1.0, 1e5)):
    """A slow manifold that moves: y = cos(t) + (s - 1) exp(-k t) from any start s."""
    return ro.compile(
        ro.Problem.from_strings(
            {"y": "-k*(y - cos(t)) - sin(t)"}, {"y": "s"}, {"k": rates, "s": (1, 2)}, (0, 3)
        )
    ).system


def exact(points, times):
    rates, starts = points.T[:, :, None]
    return np.cos(times) + (starts - 1) * np.exp(-rates * times)


def drawn(rates=(1.0, 1e5)):
    generator = np.random.default_rng(3)
    return np.stack([np.geomspace(*rates, 40), 1 + generator.random(40)], axis=1)


@pytest.mark.parametrize("tolerance", [1e-4, 1e-6, 1e-8])
def test_the_nodes_of_a_step_are_taken_at_their_times(tolerance):
    points, tolerances = drawn(), Tolerances(tolerance, np.full((1, 1), tolerance))
    trajectories = STIFF.run(forced(), points, (0.0, 1.0, 3.0), tolerances)
    times = np.array([0.3, 1.0, 2.2, 3.0])
    assert trajectories.end == 3.0
    assert np.abs(trajectories(times)[0] - exact(points, times)).max() < 3 * tolerance


def test_spans_of_their_own():
    points, ends = drawn((1.0, 1e3)), np.linspace(1.0, 3.0, 40)
    spans = Spans(np.zeros(40), points[None, :, 1], ends)
    tolerances = Tolerances(1e-7, np.full((1, 1), 1e-7))
    paths = STIFF.paths(forced((1.0, 1e3)), points, spans, tolerances)
    last = np.array([path.state[0] for path in paths])
    np.testing.assert_allclose(last, np.diag(exact(points, ends)), atol=1e-6)


def robertson(tolerance, more_rates=()):
    """Thirty trajectories of Robertson's reaction, and of states that follow it."""
    rates = {"a": "-k*a + 1e4*b*c", "b": "k*a - 1e4*b*c - 3e7*b**2", "c": "3e7*b**2"}
    rates |= dict(more_rates)
    initial = dict.fromkeys(rates, "0") | {"a": "1"}
    problem = ro.Problem.from_strings(rates, initial, {"k": (0.02, 0.06)}, (0, 1000))
    absolute = np.full((len(rates), 1), 1e-2 * tolerance)
    absolute[1] *= 1e-4
    points = np.linspace(0.02, 0.06, 30)[:, None]
    trajectories = STIFF.run(
        ro.compile(problem).system, points, (0.0, 1000.0), Tolerances(tolerance, absolute)
    )
    assert trajectories.end == 1000.0
    np.testing.assert_allclose(trajectories.state[:3].sum(axis=0), 1.0, atol=1e-2 * tolerance)
    return trajectories


def test_newton_matrices_serve_several_steps(monkeypatch):
    inverted = []
    inv = np.linalg.inv

    def noted(some):
        inverted.extend([some.dtype] if some.ndim == 3 else [])  # others make the method itself
        return inv(some)

    monkeypatch.setattr(np.linalg, "inv", noted)
    trajectories = robertson(1e-7, {"d": "a - d"})
    real = inverted.count(np.dtype(float))
    assert inverted.count(np.dtype(complex)) == 2 * real
    assert 0 < real < 0.4 * trajectories.steps


def test_cofactors_of_three_states_serve_several_steps(monkeypatch):
    inverted = []
    by_cofactors = newton.by_cofactors

    def noted(matrices):
        inverted.append((matrices.dtype, matrices.shape))
        return by_cofactors(matrices)

    monkeypatch.setattr(newton, "by_cofactors", noted)
    trajectories = robertson(1e-7)
    real = inverted.count((np.dtype(float), (3, 3, 30)))
    assert inverted.count((np.dtype(complex), (3, 3, 60))) == real  # both shifts at once
    assert len(inverted) == 2 * real
    assert 0 < real < 0.55 * trajectories.steps


def test_cofactors_are_made_anew_sooner_which_saves_steps(monkeypatch):
    """Slow iterations of old matrices keep steps from growing."""
    often = robertson(3e-5).steps
    monkeypatch.setattr(newton.SmallJacobians, "iterations", newton.DenseJacobians.iterations)
    assert often < 0.7 * robertson(3e-5).steps


def test_three_states_take_five_stages_at_loose_tolerances_and_fewer_steps(monkeypatch):
    five = robertson(3e-5).steps
    monkeypatch.setattr(integrator, "stages_for", lambda *_: 3)
    assert five < 0.75 * robertson(3e-5).steps


def test_a_step_after_one_that_was_tried_again_is_no_longer(monkeypatch):
    tries = []
    collocated = StackedRadau._collocated

    def noted(stepper, h):
        tries.append((stepper.t, h))
        return collocated(stepper, h)

    monkeypatch.setattr(StackedRadau, "_collocated", noted)
    problem = ro.Problem.from_strings(
        {"x": "y", "y": "mu*(1 - x**2)*y - x"}, {"x": "2", "y": "0"}, {"mu": (80, 120)}, (0, 70)
    )
    tolerances = Tolerances(1e-4, np.full((2, 1), 1e-4))
    points = np.linspace(80, 120, 9)[:, None]
    STIFF.run(ro.compile(problem).system, points, (0.0, 70.0), tolerances)
    triples = zip(tries, tries[1:], tries[2:], strict=False)
    again = [(b[1], c[1]) for a, b, c in triples if a[0] == b[0] < c[0]]
    assert again
    rounded = 1.0 + 1e-12  # a length is the difference of two times
    assert all(following <= rounded * taken for taken, following in again)
