"""Where a box would have to end so that nothing blows up, and the solution on that part of it."""

import pickle

import numpy as np
import pytest

import rankone as ro
from tests.problems import REFERENCE


def blown(rates, initial, box, horizon=(0, 1), rtol=1e-4, **options):
    problem = ro.Problem.from_strings(rates, initial, box, horizon)
    with pytest.raises(ro.BlowUpError) as caught:
        ro.solve(problem, rtol, **options)
    return caught.value


@pytest.mark.parametrize(
    ("rate", "initial", "box", "horizon", "end", "said"),
    [
        ("k*x**2", "1", {"k": (0.2, 2)}, (0, 1), 1.0, "`k` below 0.98"),
        ("-k*x**2", "1", {"k": (-2, 2)}, (0, 1), -1.0, "`k` above -"),
        ("x**2", "k", {"k": (-1, 2)}, (-1, 1), 0.5, "`k` below 0."),
        pytest.param(
            "k*x**2",
            "a",
            {"k": (0.2, 2), "a": (0.2, 1)},
            (-1, 1),
            0.5,
            "`k` below 0.49",
            marks=pytest.mark.slow,
        ),
        ("-k*sqrt(x)", "1", {"k": (0.1, 3)}, (0, 1), 2.0, "`k` below 1.9"),
        ("-1/x", "k", {"k": (0.5, 3)}, (0, 3), 6**0.5, "`k` above 2.45"),
    ],
)
def test_the_part_of_the_box_without_a_blow_up(rate, initial, box, horizon, end, said):
    error = blown({"x": rate}, {"x": initial}, box, horizon)
    assert f"narrow the box: {said}" in str(error)
    assert error.solution.parameters == box
    assert error.solution.error <= 1e-4
    part = error.part
    assert part.success
    assert part.time == horizon
    assert {name: ends for name, ends in part.parameters.items() if name != "k"} == {
        name: ends for name, ends in box.items() if name != "k"
    }
    lower, upper = part.parameters["k"]
    assert not lower < end < upper
    whole = box["k"][1] - end if lower > end else end - box["k"][0]
    assert upper - lower > 0.9 * whole
    assert error.part is part


@pytest.mark.slow
def test_the_axis_that_keeps_most_is_taken():
    """Blow-up where a k >= 1: k below 1 keeps 9 % of its interval, a below 0.5 keeps 37 %."""
    error = blown({"x": "k*x**2"}, {"x": "a"}, {"k": (0.9, 2), "a": (0.2, 1)})
    assert error.solution.outcome.safe[0].parameter == 1
    assert error.part.parameters["k"] == (0.9, 2)


@pytest.mark.parametrize(("rate", "box"), [("x**2", {}), ("k*x**2", {"k": (2, 3)})])
def test_nothing_is_left_of_the_box(rate, box):
    error = blown({"x": rate}, {"x": "1"}, box, (0, 2))
    assert error.part is None
    assert "would do" not in str(error)
    assert error.solution.time[1] < error.time < 2


@pytest.mark.slow
def test_the_work_is_bounded_and_the_same_each_time():
    problem = ro.compile(REFERENCE["coupled"]())
    messages, works = [], []
    for _ in range(2):
        with pytest.raises(ro.BlowUpError) as caught:
            problem.solve(1e-4, t_final=1, effort="low")
        messages.append(str(caught.value))
        works.append(caught.value.solution.outcome.work)
    assert messages[0] == messages[1]
    assert works[0] == works[1]
    assert works[0]["reference"] < 2.5e9


def test_a_copy_has_the_part_if_it_was_asked_for():
    error = blown({"x": "k*x**2"}, {"x": "1"}, {"k": (0.2, 2)})
    assert pickle.loads(pickle.dumps(error)).part is None
    at = {"t": 0.7, "k": 0.4}
    exact = 1 / (1 - 0.4 * 0.7)
    assert error.part["x"](**at) == pytest.approx(exact, rel=1e-3)
    copy = pickle.loads(pickle.dumps(error))
    np.testing.assert_array_equal(copy.part(**at), error.part(**at))
    assert str(copy) == str(error)
