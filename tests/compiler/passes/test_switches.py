"""Switches of the rates, held on their sides."""

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.compiler.passes import first_order
from rankone.compiler.passes.feature_pass import switching_term
from rankone.compiler.passes.switches import held_switches
from rankone.compiler.reformulated import held_form, held_system, with_sides

t, k = sp.symbols("t k")
x, v = sp.Function("x")(t), sp.Function("v")(t)
BOX = {k: (0.5, 1.5)}


def problem(rate, start=(1, 0), **more):
    equations = [sp.Eq(x.diff(t), v), sp.Eq(v.diff(t), rate)]
    return ro.Problem(equations, (t, 0, 3), BOX, {x: start[0], v: start[1]}, **more)


def held(rate, **more):
    return held_switches(first_order(problem(rate, **more)))


def test_a_smooth_system_has_no_switches():
    assert held(-k * x) is None


def test_switches_at_fixed_times_are_left_to_known_times():
    assert held(sp.Heaviside(t - 1) * x + sp.Max(0, sp.sin(3 * t))) is None


def test_a_switch_at_a_moving_time_is_held_at_that_time():
    system = held(sp.Heaviside(k - t) * x + sp.Heaviside(t - 1))
    assert {event.at for event in system.events} == {k, 1}
    assert {event.then[-2:] for event in system.events} == {
        (-1, system.functions[-1]),
        (system.functions[-2], 1),
    }


@pytest.mark.parametrize(
    ("clipped", "levels"),
    [
        (sp.Max(-12, sp.Min(12, x - k * v)), {-12, 12}),
        (sp.Min(12, sp.Max(-12, x - k * v)), {-12, 12}),
        (sp.Max(-k, sp.Min(k, x - k * v)), {-k, k}),
        (sp.Max(sp.Min(k, x - k * v), sp.Min(2, -12)), {-12, k}),
    ],
)
def test_nested_saturations_switch_where_their_argument_meets_a_limit(clipped, levels):
    switches = held(clipped).switches
    assert {abs(sp.expand(g - (x - k * v))) for g in switches} | {
        abs(sp.expand(g + (x - k * v))) for g in switches
    } >= {abs(level) for level in levels}
    assert not any(g.has(sp.Max, sp.Min) for g in switches)


def test_a_condition_is_not_read_where_it_cannot_be_slid_along():
    """On the surface it is as it was written: 0/0 of the other side is left alone."""
    system = held(sp.Piecewise((v / x, x > 0), (-1, True)))
    at_rest = {x: 0, v: 0, system.functions[-1]: 0}
    assert system.rhs[1].subs(at_rest) == -1


def test_absolute_values_become_products_with_their_side():
    system = held(-k * v * sp.Abs(v))
    side = system.functions[-1]
    assert system.switches == (v,)
    assert sp.simplify(system.rhs[1] + k * v**2 * side) == 0
    assert system.rhs[-1] == 0
    assert system.events[-1].then[-1] == -side


@pytest.mark.parametrize(
    "rate",
    [
        sp.Max(0, x - k) - sp.Min(x, v, 1),
        sp.Abs(x - sp.Abs(v)) - x,
        sp.Piecewise((k * x, x > 0.3), (-v, v < 0), (sp.sqrt(1 + x**2), True)),
        -sp.sign(v) * k - x,
        pytest.param(sp.Heaviside(x - v) * sp.Max(x, k) - sp.Heaviside(v), marks=pytest.mark.slow),
        sp.Abs(x) ** k - v,
        -k * sp.sign(v - x) - sp.sign(v),
    ],
)
def test_held_rates_are_those_that_were_written(rate):
    system = first_order(problem(rate))
    written = ro.compile(problem(rate)).system
    sided = held_system(held_form(system, written), written, "held")
    assert sided is not None
    rng = np.random.default_rng(5)
    u, p, at = rng.normal(size=(2, 200)), rng.uniform(0.5, 1.5, (1, 200)), np.full(200, 0.7)
    rates = sided.rhs(at, with_sides(sided, at, u, p), p)
    np.testing.assert_allclose(rates[:2], written.rhs(at, u, p), rtol=1e-12, atol=1e-14)


def test_a_side_is_where_a_trajectory_starts_or_goes_on_to():
    def first(rate, start):
        return ro.compile(problem(rate, start))._held.initial(np.array([[0.5, 1.5]]))[-1]

    np.testing.assert_array_equal(first(-v * sp.Abs(v) - x, (1, 2)), 1)
    np.testing.assert_array_equal(first(-v * sp.Abs(v) - x, (1, 0)), -1)  # it falls
    # friction of at most 1 holds it where k <= 1, and lets it go elsewhere
    np.testing.assert_array_equal(first(k - sp.sign(v), (0, 0)), [0, 1])


def test_a_side_that_changes_no_rate_is_told_as_soon_as_it_does():
    system = held(sp.Piecewise((-1, (x > 2) & (k * x + t > 3)), (-v, True)))
    idle, other = system.functions[-2:]
    passes, meets = system.events
    beside = {x: 1, v: 0, k: 1, t: 1}
    assert passes.when.xreplace({idle: 1, other: -1, **beside}) == 1  # x = 2 is no event
    assert passes.when.xreplace({idle: 1, other: 1, **beside}) == -1
    for place, side in ((1, -1), (3, 1)):
        at = {idle: 1, other: -1, x: place, v: 1, k: 1, t: 1}
        assert [each.xreplace(at) for each in meets.then[-2:]] == [side, 1]
    left = {idle: -1, other: 1, x: 1, v: -1, k: 1, t: 1}
    assert [each.xreplace(left) for each in meets.then[-2:]] == [1, -1]


def test_a_reset_sets_the_side_of_what_it_moves_alone():
    bounce = ro.Event(x, "falling", then={v: -v}, name="bounce")
    system = held(-1 - v * sp.Abs(v), events=[bounce])
    side, before = system.functions[-1], {x: 0, v: -2}
    after = system.events[0].then[-1]
    assert after.xreplace({side: -1, **before}) == 1
    mark = ro.Event(x - 1, then={x: x}, name="mark")
    system = held(-1 - v * sp.Abs(v), events=[mark])
    assert system.events[0].then[-1].xreplace({side: -1, x: 1, v: -2}) == -1


@pytest.mark.parametrize(("rate", "smooth"), [("sign(w)", "tanh(w/w_)"), ("sign(v)", "tanh(v/w_)")])
def test_the_width_of_a_smooth_step_has_a_name_of_its_own(rate, smooth):
    text = ro.Problem.from_strings({"w": f"-{rate}", "v": "-w"}, {"w": 1, "v": 1}, {}, (0, 1))
    term = switching_term(first_order(text))
    assert (term.smooth, term.width) == (smooth, "w_")
