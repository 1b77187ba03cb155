"""The same call ends in the same way, whatever the clock says and whoever integrates.

``tests/benchmarks/repeatable.py`` does so with forty solves on a busy machine.
"""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import rankone as ro
from rankone.solvers.engines.cross_samples import TrajectoryEnds
from rankone.support.budget import limited
from rankone.trajectories.integrators.integrator import Tolerances
from rankone.trajectories.integrators.workers import open_workers
from rankone.trajectories.stacks.stack import StackedIntegrator
from tests.problems import EXAMPLES

KINK = ro.Problem.from_strings(
    {"x": "-x + abs(a + b + c - 1.5)"}, {"x": "1"}, dict.fromkeys("abc", (0, 1)), (0, 2)
)
FAR = ro.Problem.from_strings(
    {"x": "10*(y - x)", "y": "x*(r - z) - y", "z": "x*y - 8*z/3"},
    {"x": "1", "y": "1", "z": "20"},
    {"r": (26, 30)},
    (0, 20),
)
CALLS = {
    "success": (EXAMPLES["lotka_volterra"].problem, 1e-4, {}),
    "two engines": (FAR, 1e-5, {"effort": 0.03}),
    "no budget left": (KINK, 1e-8, {"effort": 0.005}),
}


def ended(problem, rtol, options):
    """Bits, engine, message and counted work of a solve."""
    solution = ro.solve(problem, rtol, **options)
    bits = [core.tobytes() for slab in solution.outcome.slabs for core in slab.cores]
    return bits, solution.method, solution.message, solution.work


class Wild:
    """A clock on which every look is hours after the one before."""

    def __init__(self):
        self.hours = itertools.count()

    def perf_counter(self):
        return 3600.0 * next(self.hours)


SLOW = ["two engines"]


@pytest.mark.parametrize(
    "call",
    [pytest.param(CALLS[c], marks=pytest.mark.slow if c in SLOW else ()) for c in CALLS],
    ids=CALLS,
)
def test_neither_a_clock_nor_an_executor_changes_a_solve(call, monkeypatch):
    problem, rtol, options = call
    plain = ended(problem, rtol, options)
    monkeypatch.setattr("rankone.support.budget.clock", Wild())
    monkeypatch.setattr("rankone.solvers.attempts.clock", Wild())
    assert ended(problem, rtol, options) == plain
    with ThreadPoolExecutor(3) as executor:
        assert ended(problem, rtol, options | {"executor": executor}) == plain


def failing(system, number, work):
    """A task of so much work; odd ones fail."""
    from rankone.support.budget import charge

    charge(work)
    if number % 2:
        raise TrajectoryEnds(float(number), np.zeros(1))
    return number


@pytest.mark.parametrize("budget", [5.0, 25.0, 45.0, 1e3])
def test_tasks_end_as_one_after_the_other(budget):
    """Whichever comes first in their order: a failure, or the end of the budget."""
    system = ro.compile(EXAMPLES["decay"].problem).system
    tasks = [(0, 10.0), (2, 10.0), (4, 10.0), (1, 10.0), (3, 1e6)]
    ends = []
    with ThreadPoolExecutor(5) as executor:
        for chosen in (None, executor):
            with open_workers(system, chosen) as workers, limited(budget) as account:
                try:
                    workers.map(failing, tasks, TrajectoryEnds)
                except Exception as error:
                    ends.append((type(error), error.args[:1], account.done))
    assert ends[0] == ends[1]


def test_large_stacks_are_inverted_in_pieces(monkeypatch):
    """So that a limit is looked at in between."""
    names = [f"x{i}" for i in range(30)]
    rates = {name: f"-{10 * (i + 1)}*k*{name}" for i, name in enumerate(names)}
    problem = ro.Problem.from_strings(rates, dict.fromkeys(names, "1"), {"k": (1, 2)}, (0, 1))
    monkeypatch.setattr("rankone.support.costs._PIECE_OPERATIONS", 1e6)
    inverted = []
    inv = np.linalg.inv
    monkeypatch.setattr(np.linalg, "inv", lambda some: inverted.append(some.shape) or inv(some))
    points = np.linspace(1, 2, 200)[:, None]
    system = ro.compile(problem).system
    tolerances = Tolerances(1e-3, np.full((30, 1), 1e-6))
    StackedIntegrator(stiff=True).run(system, points, (0.0, 1e-3), tolerances)
    assert len(inverted) > 2
    assert max(len(shape) and shape[0] for shape in inverted) < 100


@pytest.mark.slow
@pytest.mark.parametrize("width", [1.8, 2.0])
def test_eleven_parameters_are_not_given_up_while_the_error_falls(width):
    names = [f"p{i}" for i in range(11)]
    start = "1/(1 + " + " + ".join(f"({name} - 1)**2" for name in names) + ")"
    box = dict.fromkeys(names, (1 - width, 1 + width))
    problem = ro.Problem.from_strings({"x": "-x"}, {"x": start}, box, (0, 1))
    assert ro.solve(problem, 1e-4).success


def test_growth_from_nearly_nothing():
    problem = ro.Problem.from_strings(
        {"x": "r*x*(1 - x)"}, {"x": "x0"}, {"r": (0.8, 1.2), "x0": (1e-19, 1e-18)}, (0, 50)
    )
    assert ro.solve(problem, 1e-5).success
