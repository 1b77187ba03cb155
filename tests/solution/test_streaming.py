"""Evaluation in blocks: all points once, the same values, and bounded sizes."""

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


def test_a_solve_that_does_not_fit_is_refused_beforehand():
    """The message says what it needs; nothing is integrated."""
    names = [f"x{i}" for i in range(400)]
    rates = {name: f"-k*{name}" for name in names}
    problem = ro.Problem.from_strings(rates, dict.fromkeys(names, "1"), {"k": (1, 2)}, (0, 1))
    refused = ro.compile(problem).solve(1e-3, check=500, max_memory="50MB", method="cross")
    assert refused.status is ro.Status.MEMORY_LIMIT
    assert not refused.success
    assert "and max_memory is 50 MB; raise max_memory" in refused.message
    assert not refused.outcome.history


SCRIPT = """
import resource
import numpy as np, rankone as ro

problem = ro.Problem.from_strings({"u": "-k*u"}, {"u": "a"}, {"k": (0.5, 5), "a": (1, 2)}, (0, 2))
solution = ro.solve(problem, 1e-4)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
axes = {"k": np.linspace(0.5, 5, 2500)[:, None], "a": np.linspace(1, 2, 2500)}
count = sum(v.size for _, v in solution.blocks(1.0, **axes, max_memory="60MB"))
print(count, 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before))
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="ru_maxrss is in other units")
def test_the_peak_is_within_the_limit():
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    call = [sys.executable, "-c", SCRIPT]
    done = subprocess.run(call, capture_output=True, text=True, check=True)
    count, peak = map(int, done.stdout.split())
    assert count == 2500**2
    assert peak <= 1.5 * 60e6
