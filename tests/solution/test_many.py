"""Many solves of one problem, here and on workers."""

import multiprocessing
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import sympy as sp

import rankone as ro


@pytest.fixture(scope="module")
def problem():
    return ro.Problem.from_strings(
        {"u": "-k*u + c"}, {"u": "1"}, {"k": (0.5, 5)}, (0, 2), constants={"c": 0.0}
    )


def bits(solutions):
    """Values of all solutions at the middle of their boxes."""
    middles = [{n: 0.5 * sum(ends) for n, ends in s.parameters.items()} for s in solutions]
    times = np.linspace(0, 2, 5)
    return [s(times, middle).tobytes() for s, middle in zip(solutions, middles)]


def test_split_tiles_the_box(problem):
    boxes = problem.split(k=3)
    assert boxes == [{"k": (0.5, 2.0)}, {"k": (2.0, 3.5)}, {"k": (3.5, 5.0)}]
    assert problem.split({"k": [1, 2]}) == [{"k": (0.5, 1.0)}, {"k": (1.0, 2.0)}, {"k": (2.0, 5.0)}]
    decades = problem.vary(k=(1e-2, 100, "log")).split(k=4)
    assert np.allclose([box["k"][1] for box in decades], [0.1, 1, 10, 100])
    assert problem.split() == [{"k": (0.5, 5.0)}]


@pytest.mark.parametrize(
    ("counts", "text"),
    [
        ({"kk": 2}, "there is no parameter `kk` .did you mean `k`"),
        ({"k": 0}, "the number of pieces of `k`=0 is not valid"),
        ({"k": [3, 2]}, "the cuts of `k` are"),
        ({"k": "ab"}, "the number of pieces of `k`='ab'"),
        ({"k": ["x"]}, "the cuts of `k`"),
        (3, "is not a mapping"),
    ],
)
def test_wrong_cuts(problem, counts, text):
    with pytest.raises(ro.OptionError, match=text):
        problem.split(counts)


def test_solutions_are_those_of_single_solves(problem):
    boxes = problem.split(k=2)
    many = ro.solve_many(problem, boxes, 1e-6)
    single = [ro.compile(problem).solve(1e-6, parameters=box) for box in boxes]
    assert bits(many) == bits(single)
    assert many.statuses == (ro.Status.CONVERGED,) * 2
    assert many.success
    assert "2 solutions, all of them a success" in repr(many)
    assert "[0.5, 2.75]" in repr(many)
    assert "<table" in many._repr_html_()


@pytest.mark.slow
def test_processes_give_the_same_bits_and_end(problem):
    boxes = problem.split(k=3)
    calls = []
    many = ro.solve_many(
        problem, boxes, 1e-6, executor=2, progress=lambda done, total: calls.append((done, total))
    )
    assert bits(many) == bits(ro.solve_many(problem, boxes, 1e-6))
    assert calls == [(1, 3), (2, 3), (3, 3)]
    assert not multiprocessing.active_children()


def test_threads_are_left_running(problem):
    boxes = problem.split(k=3)
    with ThreadPoolExecutor(2) as executor:
        many = ro.solve_many(problem, boxes, 1e-6, executor=executor)
        assert executor.submit(int, 3).result() == 3
    assert bits(many) == bits(ro.solve_many(problem, boxes, 1e-6))


def test_conditions_and_designs(problem):
    boxes = [{"c": 1.0}, {"c": 0.0, "k": (1, 2)}, {"k": 3.0, "c": 2.0}]
    many = ro.solve_many(problem, boxes, 1e-6)
    k = 1.5
    with_source = np.exp(-k) + (1 - np.exp(-k)) / k
    assert many[0](1.0, k=k)[0] == pytest.approx(with_source, rel=1e-5)
    assert many[1].parameters == {"k": (1.0, 2.0)}
    assert many[2](1.0)[0] == pytest.approx(np.exp(-3) + 2 * (1 - np.exp(-3)) / 3, rel=1e-5)
    with pytest.raises(ro.OptionError, match="differ"):
        many.join()


def test_a_box_that_fails_does_not_stop_the_others():
    problem = ro.Problem.from_strings({"u": "u**2"}, {"u": "a"}, {"a": (0.1, 2)}, (0, 1))
    many = ro.solve_many(problem, [{"a": (0.1, 0.5)}, {"a": (0.5, 2)}], 1e-4)
    assert many.statuses == (ro.Status.CONVERGED, ro.Status.BLOW_UP)
    assert not many.success
    assert many[1].time[1] < 1.0
    assert "1 without success" in repr(many)
    joined = many.join()
    assert not joined.success
    assert joined.time == many[1].time


@pytest.mark.parametrize(
    ("boxes", "options", "error", "text"),
    [
        ({"k": (1, 2)}, {}, ro.OptionError, "not a list of mappings"),
        ([], {}, ro.OptionError, "no boxes to solve"),
        ([(1, 2)], {}, ro.OptionError, r"box 0: \(1, 2\) is not a mapping"),
        ([{"k": (1, 2)}, {"q": (1, 2)}], {}, ro.OptionError, "box 1: there is no parameter `q`"),
        ([{"k": (2, 1)}], {}, ro.OptionError, "box 0: the range of `k`"),
        ([{"m": 2.0}], {}, ro.ProblemError, "box 0: there is no constant or parameter `m`"),
        ([{"k": (1, 2)}], {"parameters": {}}, ro.OptionError, "does not take parameters="),
        ([{"k": (1, 2)}], {"on_failure": "raise"}, ro.OptionError, "does not take on_failure="),
        ([{"k": (1, 2)}], {"rtoll": 1}, ro.OptionError, "unknown option 'rtoll'"),
        ([{"k": (1, 2)}], {"max_memory": "lots"}, ro.OptionError, "is no amount of memory"),
        ([{"k": (1, 2)}], {"unknowns": ["v"]}, ro.OptionError, "there is no unknown `v`"),
        ([{"k": (1, 2)}], {"outputs": {"q": "v"}}, ro.OptionError, "unknown name `v`"),
        ([{"k": (1, 2)}], {"executor": "here"}, ro.OptionError, "executor='here' is not valid"),
        ([{"k": (1, 2)}], {"progress": 3}, ro.OptionError, "progress is 3"),
    ],
)
def test_wrong_arguments(problem, boxes, options, error, text):
    with pytest.raises(error, match=text):
        ro.solve_many(problem, boxes, 1e-4, **options)


@pytest.mark.parametrize(
    ("boxes", "output", "exact"),
    [
        ([{"c": 1.0}, {"c": 2.0}], "x/c", [np.exp(-0.3), np.exp(-0.3) / 2]),
        (
            [{"k": (0.1, 0.5)}, {"k": (0.5, 1)}],
            "sqrt(k)*x",
            [np.sqrt(0.3) * np.exp(-0.3), np.sqrt(0.75) * np.exp(-0.75)],
        ),
    ],
)
def test_outputs_that_the_boxes_allow_and_the_problem_does_not(boxes, output, exact):
    base = ro.Problem.from_strings(
        {"x": "-k*x"}, {"x": "1"}, {"k": (-1, 1)}, (0, 1), constants={"c": 0.0}
    )
    with pytest.raises(ro.OptionError):
        ro.solve(base, 1e-5, outputs={"q": output})
    many = ro.solve_many(base, boxes, 1e-5, outputs={"q": output})
    at = [0.5 * sum(box["k"]) if "k" in box else 0.3 for box in boxes]
    values = [solution(1.0, k=k)[0] for solution, k in zip(many, at)]
    np.testing.assert_allclose(values, exact, rtol=1e-4)


def test_outputs_that_no_box_allows_are_not_sent():
    base = ro.Problem.from_strings(
        {"x": "-k*x"}, {"x": "1"}, {"k": (1, 2)}, (0, 1), constants={"c": 1.0}
    )
    sent = ThreadPoolExecutor(1)
    sent.shutdown()  # raises when something is sent
    with pytest.raises(ro.OptionError, match="division by zero in the output `q`"):
        ro.solve_many(base, [{"c": 0.0}], 1e-5, outputs={"q": "x/c"}, executor=sent)


def test_functions_that_cannot_be_sent():
    t, k = sp.symbols("t k")
    u = sp.Function("u")(t)
    f = ro.function("f", lambda x: -x, lambda x: -np.ones_like(x))
    problem = ro.Problem([sp.Eq(u.diff(t), k * f(u))], (t, 0, 1), {k: (1, 2)}, {u: 1})
    with pytest.raises(ro.OptionError, match="cannot be sent to another process"):
        ro.solve_many(problem, problem.split(k=2), 1e-4, executor=1)
