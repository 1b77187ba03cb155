"""Evaluation in blocks: all points once, the same values, and bounded sizes."""

import re
import resource
import subprocess
import sys

import numpy as np
import pytest

import rankone as ro
from rankone.solution.evaluation.core import bytes_of


@pytest.fixture(scope="module")
def solution():
    box = {"k": (0.5, 5), "a": (1, 2)}
    return ro.solve(ro.Problem.from_strings({"u": "-k*u"}, {"u": "a"}, box, (0, 2)), 1e-4)


@pytest.mark.parametrize("points", [1, 7, 300, 10**6])
def test_blocks_cover_all_points_once(solution, points, monkeypatch):
    monkeypatch.setattr("rankone.support.options._LEAST", 1.0)
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


def test_a_call_within_a_limit_has_the_same_values(solution, monkeypatch):
    monkeypatch.setattr("rankone.support.options._LEAST", 1.0)
    k, a, t = np.linspace(0.5, 5, 10)[:, None], np.linspace(1, 2, 9), np.linspace(0, 2, 8)
    for of in (solution, solution["u"], solution.gradient):
        for times in (t[:, None, None], 1.0):
            expected = of(times, k=k, a=a)
            least = expected.nbytes + bytes_of(7, 3, 2)
            assert np.abs(of(times, k=k, a=a, max_memory=least) - expected).max() < 1e-13
    on_grid = solution.grid(t, k=k[:, 0], a=a)
    same = solution.grid(t, k=k[:, 0], a=a, max_memory=on_grid.nbytes + bytes_of(1, 3, 1))
    assert np.array_equal(on_grid, same)


def test_times_of_their_own_stay_together(solution, monkeypatch):
    """Blocks divide the parameters, whose cores would be multiplied again for other times."""
    monkeypatch.setattr("rankone.support.options._LEAST", 1.0)
    t, k = np.linspace(0, 2, 11)[:, None], np.linspace(0.5, 5, 100)
    indices = [i for i, _ in solution.blocks(t, k=k, a=1.5, max_memory=bytes_of(55, 3, 1))]
    assert all(index[0] == slice(0, 11) for index in indices)
    assert len(indices) == 20


def test_what_does_not_fit_into_a_limit_is_refused_beforehand(solution, monkeypatch):
    monkeypatch.setattr(type(solution._evaluator), "curves", None)
    monkeypatch.setattr(type(solution._evaluator), "grid", None)
    k, a = np.broadcast_to(1.0, (10**4, 1)), np.broadcast_to(1.5, 10**4)
    calls = [
        (lambda limit: solution(1.0, k=k, a=a, max_memory=limit), "800 MB"),
        (lambda limit: solution["u"](1.0, k=k, a=a, max_memory=limit), "800 MB"),
        (lambda limit: solution.gradient(1.0, k=k, a=a, max_memory=limit), "1.6 GB"),
        (lambda limit: solution.grid(1.0, k=k[:, 0], a=a, max_memory=limit), "800 MB"),
    ]
    for call, size in calls:
        message = f"all values take {size}, their evaluation .* and max_memory is 500 MB.*blocks"
        with pytest.raises(ro.EvaluationError, match=message):
            call("500MB")
    for times in (1.0, [], [1.0, 2.0]):
        for limit in (-1, "lots", np.nan, True):
            for call in (solution, solution["u"], solution.grid, solution.gradient):
                with pytest.raises(ro.OptionError, match="max_memory="):
                    call(times, k=1.0, a=1.5, max_memory=limit)


EVENTS = {
    "one order": [{"when": "u - 0.8", "direction": "falling", "then": {"u": "a"}}],
    "two orders": [
        {"when": "t - a", "direction": "rising", "then": {"u": "u + 1"}},
        {"when": "t - 1.5", "direction": "rising", "then": {"u": "u/2"}},
    ],
}


@pytest.fixture(scope="module", params=EVENTS)
def with_events(request):
    box = {"k": (0.3, 0.5), "a": (1.2, 2)}
    events = EVENTS[request.param]
    problem = ro.Problem.from_strings({"u": "-k*u"}, {"u": "a"}, box, (0, 3), events=events)
    return ro.solve(problem, 1e-4)


@pytest.mark.slow
def test_solutions_with_events_are_evaluated_in_parts(with_events, monkeypatch):
    rng = np.random.default_rng(3)
    times, k, a = (rng.uniform(*ends, 40) for ends in ((0, 3), (0.3, 0.5), (1.2, 2)))
    halves = [with_events.restrict(k=ends) for ends in ((0.3, 0.4), (0.4, 0.5))]
    for one in (with_events, ro.Solution.join(halves)):
        calls = [
            lambda one=one: one(times, k=k, a=a),
            lambda one=one: one(times[:, None], k=k, a=a),
            lambda one=one: one.grid(times, k=k, a=a[:6]),
            lambda one=one: one.gradient(times, k=k, a=a),
        ]
        for call in calls:
            whole = call()
            with monkeypatch.context() as patch:
                patch.setattr("rankone.tensors.timeline_evaluator.AT_ONCE", 20)
                patch.setattr("rankone.tensors.branch_evaluator.AT_ONCE", 300)
                parts = call()
            np.testing.assert_allclose(parts, whole, rtol=0, atol=1e-12)


def test_no_points_cost_nothing(solution, with_events, monkeypatch):
    none, many = np.zeros(0), np.linspace(0.3, 0.5, 50)
    for one in (solution, with_events):
        for method in ("curves", "grid", "one", "linearised"):
            monkeypatch.setattr(type(one._evaluator), method, None, raising=False)
    assert with_events(none, k=0.4, a=1.5).shape == (1, 0)
    assert with_events(none[:, None], k=many, a=1.5).shape == (1, 0, 50)
    assert with_events.grid(none, k=many, a=many + 1).shape == (1, 0, 50, 50)
    assert with_events.grid(many, k=none, a=many + 1).shape == (1, 50, 0, 50)
    assert with_events.gradient(none[:, None], k=many, a=1.5).shape == (1, 2, 0, 50)
    assert solution["u"].grid(none, k=many + 1, a=1.5).shape == (0, 50, 1)
    with pytest.raises(ro.EvaluationError, match="outside its range"):
        with_events.grid(none, k=many, a=9.0)


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
            patch.setattr("rankone.tensors.evaluator.AT_ONCE", 100)
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
    with pytest.raises(ro.EvaluationError, match="are masked"):
        list(solution.blocks(1.0, k=np.ma.masked_less([0.5, 2.0], 1.0), a=1.5))


@pytest.mark.slow
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


def test_samples_that_do_not_fit_are_refused_with_what_they_need(monkeypatch):
    monkeypatch.setattr("rankone.solvers.engines.cross_samples.COPIES", 1e6)
    problem = ro.Problem.from_strings({"x": "-k*x"}, {"x": "1"}, {"k": (1, 2)}, (0, 2))
    refused = ro.solve(problem, 1e-3, max_memory="50MB", method="cross")
    assert refused.status is ro.Status.MEMORY_LIMIT
    needed = re.search(r"it needs about ([\d.]+) (MB|GB), and max_memory is 50 MB", refused.message)
    assert needed is not None
    assert float(needed[1]) > (50 if needed[2] == "MB" else 0)


SCRIPT = """
import re
import resource
import numpy as np, rankone as ro

problem = ro.Problem.from_strings({"u": "-k*u"}, {"u": "a"}, {"k": (0.5, 5), "a": (1, 2)}, (0, 2))
solution = ro.solve(problem, 1e-4)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
axes = {"k": np.linspace(0.5, 5, 2500)[:, None], "a": np.linspace(1, 2, 2500)}
solution(1.0, **axes, max_memory="70MB")
called = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(1024 * (called - before))
before = called
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
    called, count, streamed, solved = map(int, done.stdout.split())
    assert called <= 1.5 * 70e6
    assert count == 2500**2
    assert streamed <= 1.5 * 60e6
    assert solved <= 1.5 * 50e6
