"""Evaluation in blocks: all points once, the same values, and bounded sizes."""

import re
import resource
import subprocess
import sys

import numpy as np
import pytest

import rankone as ro
from rankone.solution.streaming import bytes_of


@pytest.fixture(scope="module")
def solution():
    box = {"k": (0.5, 5), "a": (1, 2)}
    return ro.solve(ro.Problem.from_strings({"u": "-k*u"}, {"u": "a"}, box, (0, 2)), 1e-4)


@pytest.mark.parametrize("points", [1, 7, 300, 10**6])
def test_blocks_cover_all_points_once(solution, points, monkeypatch):
    monkeypatch.setattr("rankone.support.memory._LEAST", 1.0)
    k = np.linspace(0.5, 5, 5)[:, None, None]
    a = np.linspace(1, 2, 11)
    t = np.linspace(0, 2, 13)[:, None]
    table, counts = np.zeros((1, 5, 13, 11)), np.zeros((5, 13, 11), dtype=int)
    for index, values in solution.blocks(t, k=k, a=a, max_memory=bytes_of(points, 3, 1)):
        table[(slice(None), *index)] = values
        counts[index] += 1
        assert values[0].size <= points
    assert (counts == 1).all()
    assert np.abs(table - solution(t, k=k, a=a)).max() < 1e-14


def test_values_beyond_the_memory_of_the_machine_are_refused_beforehand(solution):
    k, a = np.broadcast_to(1.0, (10**7, 1)), np.broadcast_to(1.5, 10**7)
    for evaluate in (solution, solution["u"]):
        with pytest.raises(ro.EvaluationError, match=r"take 800 TB.*blocks"):
            evaluate(1.0, k=k, a=a)
    with pytest.raises(ro.EvaluationError, match=r"take 800 TB.*blocks"):
        solution.grid(1.0, k=k[:, 0], a=a)


def test_grids_are_evaluated_in_parts(solution, monkeypatch):
    axes = np.linspace(0, 2, 7), np.array([0.7]), np.linspace(1, 2, 40)
    reversed_axes = np.linspace(0, 2, 7), np.linspace(0.5, 5, 30), np.linspace(1, 2, 4)
    for t, k, a in (axes, reversed_axes, (axes[0], axes[1], np.array([1.5]))):
        whole = solution.grid(t, k=k, a=a)
        with monkeypatch.context() as patch:
            patch.setattr("rankone.tensors.evaluator._HELD", 100)
            parts = solution.grid(t, k=k, a=a)
        assert parts.shape == whole.shape
        assert np.abs(parts - whole).max() < 1e-14


def test_single_points_and_nothing(solution):
    [(index, values)] = solution.blocks(1.0, k=1.0, a=1.5)
    assert index == ()
    assert values == solution(1.0, k=1.0, a=1.5)
    assert list(solution.blocks(1.0, k=np.zeros(0), a=1.5)) == []


def test_wrong_arguments(solution):
    with pytest.raises(ro.EvaluationError, match="outside its range"):
        list(solution.blocks(1.0, k=9.0, a=1.5))
    with pytest.raises(ro.EvaluationError, match="no value for"):
        list(solution.blocks(1.0, k=1.0))
    with pytest.raises(ro.OptionError, match="is no amount of memory"):
        list(solution.blocks(1.0, k=1.0, a=1.5, max_memory="lots"))
    with pytest.raises(ro.EvaluationError, match="do not broadcast"):
        list(solution.blocks(np.zeros(2), k=np.ones(3), a=1.5))


def test_a_solve_that_does_not_fit_is_refused():
    """Before anything is integrated, or as soon as the steps of the reference do not fit."""
    rates = {f"x{i}": f"{'-k' if i % 2 else 'k'}*x{i ^ 1}" for i in range(100)}
    problem = ro.Problem.from_strings(rates, dict.fromkeys(rates, "1"), {"k": (1, 2)}, (0, 99))
    compiled = ro.compile(problem)
    for rtol, check in ((1e-3, 1000), (1e-3, 100)):
        refused = compiled.solve(rtol, check=check, max_memory="50MB", method="cross")
        assert refused.status is ro.Status.MEMORY_LIMIT
        assert not refused.success
        needed = re.search(r"it needs about ([\d.]+) MB, and max_memory is 50 MB", refused.message)
        assert float(needed[1]) > 50
        assert not refused.outcome.history


SCRIPT = """
import re
import resource
import numpy as np, rankone as ro

problem = ro.Problem.from_strings({"u": "-k*u"}, {"u": "a"}, {"k": (0.5, 5), "a": (1, 2)}, (0, 2))
solution = ro.solve(problem, 1e-4)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
axes = {"k": np.linspace(0.5, 5, 2500)[:, None], "a": np.linspace(1, 2, 2500)}
count = sum(v.size for _, v in solution.blocks(1.0, **axes, max_memory="60MB"))
print(count, 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before))

rates = {f"x{i}": f"k*(x{(i + 1) % 200} - x{i}) - 0.1*x{i}" for i in range(200)}
starts = {name: f"{1 + i % 3}" for i, name in enumerate(rates)}
large = ro.compile(ro.Problem.from_strings(rates, starts, {"k": (1, 2)}, (0, 5)))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for method, effort in (("cross", 0.1), ("train", 0.1), ("greedy", 0.01)):
    large.solve(1e-4, method=method, effort=effort, max_memory="50MB")
print(1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before))
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="ru_maxrss is in other units")
def test_the_peak_is_within_the_limit():
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    call = [sys.executable, "-c", SCRIPT]
    done = subprocess.run(call, capture_output=True, text=True, check=True)
    count, streamed, solved = map(int, done.stdout.split())
    assert count == 2500**2
    assert streamed <= 1.5 * 60e6
    assert solved <= 1.5 * 50e6
