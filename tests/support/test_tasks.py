"""Calls on a pool whose workers die: with futures that fail as those of real executors do."""

import os
import pickle
from concurrent.futures import BrokenExecutor, CancelledError, Future, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool

import pytest

from rankone.support.errors import OptionError, RankoneError
from rankone.support.tasks import Shared, Tasks, open_pool


class FakePool:
    """Runs calls at once; those in ``deadly`` kill the process as often as they say."""

    def __init__(self, processes, deadly=(), error=BrokenProcessPool):
        self.processes, self.deadly, self.error = processes, dict(deadly), error
        self.restarts, self.order = 0, []

    def submit(self, function, number):
        future = Future()
        self.order.append(number)
        if self.deadly.get(number, 0) > 0:
            self.deadly[number] -= 1
            future.set_exception(self.error("it died"))
        else:
            future.set_result(function(number))
        return future

    def restart(self):
        self.restarts += 1


def square(number):
    return number**2


def run(pool, count=5, skipped=()):
    answers = {}

    def begin(number):
        return None if number in skipped else (square, (number,))

    Tasks(pool, begin, answers.__setitem__).run(range(count))
    return answers


def test_all_calls_are_answered():
    assert run(FakePool(2)) == {k: k**2 for k in range(5)}
    assert run(FakePool(None)) == {k: k**2 for k in range(5)}


def test_calls_that_are_not_needed_any_more_are_left_out():
    pool = FakePool(2)
    assert run(pool, skipped=(1, 3)) == {0: 0, 2: 4, 4: 16}
    assert pool.order == [0, 2, 4]


def test_calls_are_tried_again_after_a_death():
    pool = FakePool(2, {1: 2, 4: 1})
    assert run(pool) == {k: k**2 for k in range(5)}
    assert pool.restarts == 3


def test_a_deadly_call_is_given_up_and_the_others_finish():
    pool = FakePool(2, {2: 1000})
    answers = run(pool)
    assert isinstance(answers.pop(2), RankoneError)
    assert answers == {0: 0, 1: 1, 3: 9, 4: 16}
    assert pool.order.count(2) <= 7


def test_workers_that_die_at_once_are_an_error_that_names_the_guard():
    pool = FakePool(2, dict.fromkeys(range(5), 1000))
    with pytest.raises(RankoneError, match=r"none finished anything.*__main__"):
        run(pool)
    assert len(pool.order) < 15


def test_a_broken_executor_of_others_is_an_error():
    with pytest.raises(RankoneError, match="takes no work any more"):
        run(FakePool(None, {2: 1}, BrokenExecutor))


def test_cancelled_calls_of_others_are_tried_again():
    assert run(FakePool(None, {2: 3}, CancelledError)) == {k: k**2 for k in range(5)}


def test_what_is_finished_is_kept_after_an_interrupt():
    pool, answers = FakePool(None), {}

    def interrupted(number, answer):
        answers[number] = answer
        if len(answers) == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Tasks(pool, lambda number: (square, (number,)), interrupted).run(range(4))
    assert answers == {k: k**2 for k in range(4)}


def power(base, exponent):
    if base == "die":
        os._exit(1)
    if base == "fail":
        raise ValueError("not today")
    return base**exponent


def test_what_is_shared_is_read_by_all_tasks():
    tasks = [(k,) for k in range(5)]
    expected = [3**k for k in range(5)]
    assert Shared("the base", 3, None).map(power, tasks) == expected
    with ThreadPoolExecutor(2) as executor, open_pool(executor) as pool:
        assert Shared("the base", 3, pool).map(power, tasks) == expected
        with pytest.raises(RankoneError, match="failed: ValueError: not today"):
            Shared("the base", "fail", pool).map(power, tasks)


@pytest.mark.slow
def test_processes_get_what_is_shared_once():
    with open_pool(2) as pool:
        shared = Shared("the base", 3, pool)
        assert pickle.loads(shared._sent.data) == 3
        assert shared.map(power, [(k,) for k in range(5)]) == [3**k for k in range(5)]
        with pytest.raises(RankoneError, match="failed: ValueError: not today"):
            Shared("the base", "fail", pool).map(power, [(1,), (2,)])
        with pytest.raises(RankoneError, match="workers died 5 times"):
            Shared("the base", "die", pool).map(power, [(1,), (2,)])
        with pytest.raises(OptionError, match="the base cannot be sent to another process"):
            Shared("the base", lambda: 0, pool)
