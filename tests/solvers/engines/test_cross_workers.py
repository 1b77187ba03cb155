"""Trajectories on the workers of an executor: the same bits, and clear errors."""

from __future__ import annotations

import concurrent.futures
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.solvers.engines import cross_samples as sampled
from tests.problems import EXAMPLES
from tests.solvers.engines.cross_functions import (
    FLAG,
    cosine,
    dying,
    dying_once,
    raising,
    shapeless,
    sine,
    slow,
)


def problem(value=sine, slope=cosine):
    """x' = -f(x) + k sin(m t), with enough parameters for several chunks."""
    t, k, m = sp.symbols("t k m")
    x = sp.Function("x")(t)
    f = ro.function("f", value, slope)
    equation = sp.Eq(x.diff(t), -f(x) + k * sp.sin(m * t))
    return ro.Problem([equation], (t, 0, 2), {k: (0.5, 1.5), m: (1, 4)}, {x: k})


def bits(solution):
    """Values at some points, and the history."""
    assert solution.success, solution.message
    t = np.linspace(*solution.time, 7)
    point = {name: np.linspace(*ends, 7) for name, ends in solution.parameters.items()}
    return solution(t, point).tobytes(), solution.history


@pytest.fixture
def processes_have_ended():
    """Whether none is left that a test started, after a moment: a thread may have to reap it."""
    before = {*multiprocessing.active_children()}

    def ended():
        end = time.perf_counter() + 60.0
        while {*multiprocessing.active_children()} - before and time.perf_counter() < end:
            time.sleep(0.05)
        return {*multiprocessing.active_children()} <= before

    return ended


@pytest.fixture(scope="module", autouse=True)
def _many_chunks():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sampled, "CROSS", replace(sampled.CROSS, stack_states=2000))
        yield


@pytest.fixture(scope="module")
def compiled():
    return ro.compile(EXAMPLES["kirchhoff"].problem)


@pytest.fixture(scope="module")
def alone(compiled):
    return bits(compiled.solve(1e-4, method="cross"))


@pytest.fixture(scope="module")
def processes():
    """Two processes of the user for several solves: each would start its own for a second."""
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as executor:
        yield executor


@pytest.mark.slow
def test_processes_give_the_same_bits(compiled, alone, processes_have_ended):
    assert bits(compiled.solve(1e-4, executor=2)) == alone
    assert processes_have_ended()


def test_threads_give_the_same_bits_and_are_left_running(compiled, alone):
    with ThreadPoolExecutor(2) as executor:
        assert bits(compiled.solve(1e-4, method="cross", executor=executor)) == alone
        assert executor.submit(int, 3).result() == 3


@pytest.mark.slow
@pytest.mark.parametrize("states", [3, 210])
def test_processes_integrate_the_reference(states, processes):
    """One by one, or in groups of many states."""
    rates = {f"x{i}": f"k*(x{(i - 1) % states} - x{i}) - m*x{i}" for i in range(states)}
    starts = {name: f"{1 + i % 3}" for i, name in enumerate(rates)}
    box = {"k": (1, 2), "m": (0.5, 1.5)}
    compiled = ro.compile(ro.Problem.from_strings(rates, starts, box, (0, 1)))
    options = {"method": "cross", "integrator": "single" if states == 3 else "auto"}
    assert bits(compiled.solve(1e-4, **options, executor=processes)) == bits(
        compiled.solve(1e-4, **options)
    )


@pytest.mark.slow
def test_functions_of_the_user_give_the_same_bits(processes):
    compiled = ro.compile(problem())
    alone = bits(compiled.solve(1e-6, method="cross"))
    assert bits(compiled.solve(1e-6, executor=processes)) == alone


@pytest.mark.slow
def test_dask_gives_the_same_bits(compiled, alone):
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(**options) as cluster, distributed.Client(cluster) as client:
        executor = client.get_executor()
        assert bits(compiled.solve(1e-4, executor=executor)) == alone
        options = {"method": "cross", "integrator": "single"}  # the reference too
        expected = bits(compiled.solve(1e-4, **options))
        assert bits(compiled.solve(1e-4, **options, executor=client)) == expected


@pytest.mark.parametrize(
    ("place", "name"),
    [
        pytest.param(concurrent.futures, "wait", marks=pytest.mark.slow),
        (ProcessPoolExecutor, "submit"),
    ],
)
def test_processes_end_when_the_solve_is_interrupted(
    compiled, monkeypatch, place, name, processes_have_ended
):
    """While it waits for its workers, and while it starts them."""
    original = getattr(place, name)

    def interrupted(*arguments, **named):
        original(*arguments, **named)
        raise KeyboardInterrupt

    monkeypatch.setattr(place, name, interrupted)
    with pytest.raises(KeyboardInterrupt):
        compiled.solve(1e-4, executor=2)
    assert processes_have_ended()


class Counting(ThreadPoolExecutor):
    """Counts what it is given."""

    count = 0

    def submit(self, *arguments):
        self.count += 1
        return super().submit(*arguments)


def test_the_executor_is_used(compiled, alone):
    with Counting(2) as executor:
        assert bits(compiled.solve(1e-4, executor=executor)) == alone
    assert executor.count > 3


@pytest.mark.parametrize("executor", [0, -1, True, 1.5, "x"])
def test_what_is_no_executor(compiled, executor):
    with pytest.raises(ro.OptionError, match="executor="):
        compiled.solve(1e-4, executor=executor)


@pytest.mark.parametrize("method", ["train", "greedy"])
def test_other_engines_have_none(compiled, method):
    with pytest.raises(ro.OptionError, match=r"'executor' belongs to method='cross'"):
        compiled.solve(1e-4, method=method, executor=2)


@pytest.mark.parametrize("kind", [ThreadPoolExecutor, ProcessPoolExecutor])
def test_an_executor_that_is_shut_down(compiled, kind):
    executor = kind(1)
    executor.shutdown()
    with pytest.raises(ro.OptionError, match="takes no work"):
        compiled.solve(1e-4, executor=executor)


def test_a_function_that_cannot_be_pickled():
    compiled = ro.compile(problem(lambda x: np.sin(x), lambda x: np.cos(x)))
    with pytest.raises(ro.OptionError, match="cannot be sent to another process"):
        compiled.solve(1e-6, executor=2)
    with ThreadPoolExecutor(2) as executor:
        assert compiled.solve(1e-6, executor=executor).success


@pytest.mark.parametrize(
    ("value", "message"),
    [
        pytest.param(raising, "raised ValueError: not today", marks=pytest.mark.slow),
        pytest.param(shapeless, r"returned shape \(3,\)", marks=pytest.mark.slow),
    ],
)
def test_a_function_that_fails_in_a_worker(value, message, processes):
    for integrator in ("auto", "single"):
        with pytest.raises(ro.RankoneError, match=message):
            ro.solve(problem(value), rtol=1e-6, executor=processes, integrator=integrator)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("integrator", "workers"),
    [("auto", 2), ("single", 1)],  # of samples, and of the reference
)
def test_a_worker_that_dies_once(tmp_path, monkeypatch, integrator, workers):
    flag = tmp_path / "flag"
    flag.touch()
    monkeypatch.setenv(FLAG, str(flag))
    options = {"rtol": 1e-4, "check": 8, "integrator": integrator}
    expected = ro.solve(problem(), method="cross", **options)
    solution = ro.solve(problem(dying_once), executor=workers, **options)
    assert not flag.exists()
    assert bits(solution) == bits(expected)


@pytest.mark.slow
def test_a_worker_that_always_dies():
    with pytest.raises(ro.RankoneError, match="died, and once more"):
        ro.solve(problem(dying), rtol=1e-6, executor=1)
    spawn = multiprocessing.get_context("spawn")
    with (
        ProcessPoolExecutor(1, mp_context=spawn) as executor,
        pytest.raises(ro.RankoneError, match="died, and once more"),
    ):
        ro.solve(problem(dying), rtol=1e-6, executor=executor)


@pytest.mark.slow
def test_the_time_limit_holds_for_workers(processes_have_ended):
    solution = ro.solve(problem(slow), rtol=1e-6, executor=2, max_seconds=4.0)
    assert solution.status is ro.Status.TIME_LIMIT
    assert processes_have_ended()


def test_an_exported_solver_refuses_it(tmp_path):
    from rankone.compiler.codegen.layout import load_module
    from rankone.solvers.engines.cross_engine import ENGINE

    compiled = ro.compile(EXAMPLES["coupled"].problem)
    with pytest.raises(ro.OptionError, match="cannot load this one"):
        ENGINE.run(load_module(compiled.source, "bare"), 1e-4, executor=2)
