"""Outputs on the workers of an executor: the same bits, the same errors."""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.solution.outputs import sampling
from tests.solvers.engines.cross_functions import cosine, sine


@pytest.fixture(autouse=True)
def _small_chunks(monkeypatch):
    monkeypatch.setattr(sampling, "AT_ONCE", 1 << 14)


@pytest.fixture(scope="module")
def process():
    """One process of the user for all: each would start for a second."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as executor:
        yield executor


class Counting(ThreadPoolExecutor):
    """Counts what it is given."""

    count = 0

    def submit(self, *arguments):
        self.count += 1
        return super().submit(*arguments)


def swing():
    box = {"k": (0.8, 1.2), "c": (0.1, 0.3)}
    return ro.Problem.from_strings({"x": "v", "v": "-k*x - c*v"}, {"x": 1, "v": 0}, box, (0, 6))


def bouncing():
    drop = {"when": "x", "direction": "falling", "then": {"v": "-0.8*v"}, "name": "bounce"}
    rates, box = {"x": "v", "v": "-g"}, {"g": (9, 10), "x0": (0.9, 1.1)}
    return ro.Problem.from_strings(rates, {"x": "x0", "v": 0}, box, (0, 1.2), events=[drop])


def swapping():
    dose = {"when": "t - a", "direction": "rising", "then": {"x": "x + 1"}}
    wash = {"when": "t - b", "direction": "rising", "then": {"x": "x/2"}}
    box = {"a": (1, 3), "b": (1.5, 3.5)}
    return ro.Problem.from_strings({"x": "-x"}, {"x": 1}, box, (0, 4), events=[dose, wash])


def in_pieces():
    return ro.solve_many(swing(), swing().split(k=2), 1e-4).join()


def bits(solution):
    point = {name: np.linspace(*ends, 7)[1:-1] for name, ends in solution.parameters.items()}
    at = () if solution.metadata.timeless else (0.37 * solution.time[1],)
    return solution(*at, **point).tobytes(), solution.errors, solution.message


@pytest.mark.slow
@pytest.mark.parametrize(
    ("solved", "outputs"),
    [
        (lambda: ro.solve(swing(), 1e-4), {"e": "v**2 + k*x**2", "i": "integral(x**2)"}),
        (lambda: ro.solve(swing(), 1e-4), {"peak": "maximum(v)"}),
        (in_pieces, {"peak": "maximum(v)"}),
        (lambda: ro.solve(bouncing(), 1e-4), {"s": "at_event(v, bounce, 0)*g"}),
        (lambda: ro.solve(bouncing(), 1e-4), {"e": "v**2/2 + g*x"}),
        (lambda: ro.solve(swapping(), 1e-3), {"y": "x + a"}),
    ],
    ids=["plain", "timeless", "pieces", "instant", "stretches", "branches"],
)
def test_the_bits_do_not_depend_on_workers(solved, outputs, process):
    solution = solved()
    alone = bits(solution.output(outputs))
    with Counting(2) as executor:
        assert bits(solution.output(outputs, executor=executor)) == alone
    assert executor.count > 10
    assert bits(solution.output(outputs, executor=process)) == alone


def test_the_work_and_its_end_do_not_depend_on_workers():
    solution = ro.solve(swing(), 1e-4)
    options = {"effort": 0.003, "rtol": 1e-9}
    alone = solution.output({"peak": "maximum(v)"}, **options)
    with Counting(2) as executor:
        spread = solution.output({"peak": "maximum(v)"}, **options, executor=executor)
    assert not alone.success
    assert bits(spread) == bits(alone)


@pytest.mark.slow
def test_errors_of_workers_are_those_of_this_process(process):
    solution = ro.solve(swing(), 1e-4)
    for outputs in ({"q": "log(k - 1)"}, {"q": "first_crossing(x + 0.65)"}):
        messages = []
        for executor in (None, process):
            with pytest.raises(ro.RankoneError) as caught:
                solution.output(outputs, executor=executor)
            messages.append(str(caught.value))
        assert messages[0] == messages[1]


@pytest.mark.slow
def test_functions_of_the_user_are_sent_by_name():
    x = sp.Function("x")(sp.Symbol("t"))
    solution = ro.solve(swing(), 1e-4)
    named = {"q": ro.function("f", sine, cosine)(x)}
    assert bits(solution.output(named, executor=1)) == bits(solution.output(named))
    nameless = {"q": ro.function("f", lambda x: x, cosine)(x)}
    with pytest.raises(ro.OptionError, match="cannot be sent to another process"):
        solution.output(nameless, executor=1)


@pytest.mark.parametrize("executor", [0, True, "x"])
def test_what_is_no_executor(executor):
    with pytest.raises(ro.OptionError, match="executor="):
        ro.solve(swing(), 1e-3).output({"q": "x"}, executor=executor)
