"""Judgement of residual sequences."""

import math

from rankone.solvers.engines.train_engine import Convergence


def after(residuals, tolerance=1e-6, coarse=1e-6):
    convergence = Convergence(tolerance, coarse)
    for residual in residuals:
        convergence.add(residual)
    return convergence


def test_the_first_sweep_may_be_coarse_and_is_then_not_the_last():
    convergence = Convergence(1e-6, 1e-5)
    assert convergence.next_tolerance == 1e-5
    convergence.add(1e-9)
    assert convergence.next_tolerance == 1e-6
    assert not convergence.solved(limited=False)


def test_a_reliable_contraction_is_looked_ahead():
    assert after([1e-2, 1e-4, 3e-6]).solved(limited=False)
    assert not after([1e-2, 1e-4, 3e-5]).solved(limited=False)
    assert not after([3e-6]).solved(limited=False)
    assert after([1e-7]).solved(limited=False)


def test_a_restart_counts_anew_from_the_last_residual():
    convergence = after([1e-2, 9e-3, 8e-3])
    convergence.restart()
    assert convergence.contraction == 0.1
    convergence.add(7e-3)
    assert convergence.contraction == 7e-3 / 8e-3
    assert not convergence.hopeless(limited=False)


def test_divergence_and_stagnation_are_hopeless():
    assert after([math.inf]).hopeless(limited=False)
    assert after([2e3]).hopeless(limited=False)
    assert after([1e-2, 9e-3, 8e-3, 7e-3]).hopeless(limited=False)
    assert not after([1e-2, 9e-3, 8e-3]).hopeless(limited=False)
    assert not after([1e-2, 9e-3, 8e-3, 7e-3]).hopeless(limited=True)


def test_stagnation_at_the_rank_limit_is_as_good_as_it_gets():
    assert after([1e-2, 1e-3, 9e-4]).solved(limited=True)
    assert not after([1e-2, 1e-3, 9e-4]).solved(limited=False)
