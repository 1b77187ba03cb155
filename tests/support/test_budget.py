"""Counted work and deadlines: one limit inside of another, who runs out, and when."""

from __future__ import annotations

import contextvars

import numpy as np
import pytest
from scipy import special

from rankone.support.budget import (
    NORMAL,
    PATIENCE,
    REMEDIES,
    WAITING,
    OutOfTimeError,
    OutOfWorkError,
    charge,
    check_time,
    foresee,
    limited,
    looking,
    operations_for,
    patience_for,
    patient,
    seconds_left,
    unlimited,
    waiting,
    work_done,
    work_left,
)
from rankone.support.costs import Cost, function_cost, in_pieces


def test_nothing_is_limited_by_itself():
    charge(1e30)
    check_time()
    assert work_done() == 0.0
    assert np.isinf(work_left())
    assert np.isinf(seconds_left())


def test_the_clock_is_not_read_without_a_deadline(monkeypatch):
    monkeypatch.setattr("rankone.support.budget.clock", None)
    with limited(100.0):
        charge(10.0)
        assert np.isinf(seconds_left())


def test_work_inside_counts_outside():
    with limited(100.0):
        charge(10.0)
        with limited(1e9):
            charge(30.0)
            assert work_left() == 60.0
        with limited(20.0):
            with pytest.raises(OutOfWorkError):
                charge(21.0)
            assert work_left() == 0.0
            check_time()
        assert (work_done(), work_left()) == (60.0, 40.0)


def test_a_look_ends_where_it_foresees_too_much():
    with limited(1000.0):
        with looking(100.0):
            charge(10.0)
            foresee(1e9)  # so early it tells nothing
            charge(20.0)
            foresee(70.0)
            with pytest.raises(OutOfWorkError):
                foresee(71.0)
        assert (work_done(), work_left()) == (30.0, 970.0)
        foresee(1e9)  # nothing looks any more
        with looking(971.0):  # more than is left: it goes on to the end
            charge(800.0)
            foresee(1e9)


def test_what_must_be_done_is_counted_without_a_limit():
    with limited(1.0, 0.0):
        with unlimited():
            charge(5.0)
        assert work_done() == 5.0
        with pytest.raises(OutOfWorkError):
            charge(1.0)


def test_deadlines_inside_of_deadlines():
    with limited(seconds=100.0), limited(seconds=0.0):
        with pytest.raises(OutOfTimeError):
            check_time()
        with limited(seconds=50.0):
            assert seconds_left() <= 0.0
    check_time()


def test_what_would_end_too_late_is_not_begun():
    with limited(seconds=100.0):
        charge(1e9)
        with pytest.raises(OutOfTimeError):
            charge(1e12)


def test_other_contexts_have_budgets_of_their_own():
    with limited(10.0):
        assert np.isinf(contextvars.Context().run(work_left))


def test_efforts():
    efforts = {"low": 0.2, "normal": 1.0, "high": 10.0, 3: 3.0, 0.5: 0.5}
    for effort, factor in efforts.items():
        assert operations_for(effort) == factor * NORMAL


def rates(t, u, p):
    """As a generated function."""
    return np.exp(u) * p + 2.0 * u**3


def outer(t, u, p):
    return rates(t, u, p) - slow(u)


def slow(u):
    return u


def test_a_small_budget_has_the_patience_of_the_normal_one():
    assert patience_for(NORMAL) == PATIENCE
    assert patience_for(0.6 * NORMAL) == PATIENCE
    assert patience_for(0.1 * NORMAL) == pytest.approx((1.0 - REMEDIES) * 0.1 * NORMAL)
    assert patience_for(4.0 * NORMAL) == pytest.approx(4.0 * PATIENCE)


@pytest.mark.parametrize(
    ("work", "patience", "most", "left"),
    [
        (0.02 * NORMAL, 0.4 * NORMAL, NORMAL, 0.42 * NORMAL),
        (NORMAL, 0.4 * NORMAL, NORMAL, 0.4 * NORMAL + WAITING),
        (NORMAL, 0.4 * NORMAL, 0.5 * NORMAL, 0.45 * NORMAL),
        (NORMAL, NORMAL, 0.5 * NORMAL, 0.5 * NORMAL),
    ],
)
def test_waiting_leaves_something_of_the_budget(work, patience, most, left):
    with limited(most), patient(patience):
        with waiting(work):
            assert work_left() == pytest.approx(left)
        assert work_left() == min(patience, most)


def test_the_cost_of_generated_functions():
    plain, nested = function_cost(rates), function_cost(outer)
    assert plain(1) > 4e3
    assert plain(1e6) > 1e7  # one exp, one power
    assert nested.each > plain.each
    assert function_cost(outer, frozenset({"slow"})).once > 10.0 * nested.once
    assert Cost(1.0, 2.0) + Cost(3.0, 4.0) == Cost(4.0, 6.0)


def test_slow_functions_cost_more():
    names = {"special": special, "np": np}
    texts = {name: f"lambda t, u, p: special.{name}(p, u)" for name in ("jv", "hyp0f1")}
    slow, quick = (function_cost(eval(text, names)) for text in texts.values())
    assert slow.each > 10.0 * quick.each


def test_each_call_of_a_slow_function_counts():
    names = {"special": special, "slow": slow}
    users = frozenset({"slow"})
    for call, least in (("special.jv(p, u)", 1e3), ("slow(u)", 2e3)):
        texts = (f"lambda t, u, p: {' + '.join([call] * count)}" for count in (1, 4))
        one, four = (function_cost(eval(text, names), users) for text in texts)
        assert four.each - one.each > 3.0 * least


def test_stacks_are_divided_where_they_take_long():
    stack = np.zeros((10, 2, 2))
    assert [len(some) for some in in_pieces(stack, 1.0)] == [10]
    assert [len(some) for some in in_pieces(stack, 5e7)] == [4, 4, 2]
    assert [len(some) for some in in_pieces(stack, 1e12)] == [1] * 10


def test_a_square_costs_as_much_as_a_product():
    texts = "lambda x: x * x", "lambda x: x**2", "lambda x: x**3", "lambda x: 2**x"
    product, square, cube, power = (function_cost(eval(text)) for text in texts)
    assert square == product
    assert cube == power
    assert cube.each > 10.0 * square.each
    many = "lambda x: x[0] + " + " + ".join(f"{k}.5 * x" for k in range(300)) + " + x**2"
    assert function_cost(eval(many)) == function_cost(eval(many.replace("x**2", "x * x")))
