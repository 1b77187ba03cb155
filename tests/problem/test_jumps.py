"""Jumps at known times: what may be given, and what becomes of it."""

import pickle
import warnings

import numpy as np
import pytest
import sympy as sp

import rankone as ro

t, k, dose = sp.symbols("t k dose")
x, v = (sp.Function(name)(t) for name in "xv")
BOX = {k: (0.5, 1.5), dose: (1, 2)}


def problem(jumps=None, rate=-k * x, box=BOX, initial=0, time=(t, 0, 10)):
    return ro.Problem([sp.Eq(x.diff(t), rate)], time, box, {x: initial}, jumps=jumps)


def test_repeated_doses_are_printed_once():
    made = problem({(4, 6): {x: x + dose}, 2.0: {x: dose}})
    assert list(made.jumps) == [2.0, 4.0, 6.0]
    for text in (repr(made), repr(ro.first_order(made)), repr(ro.weak_form(made))):
        assert "at t = 2: x -> dose" in text
        assert "at t = 4, 6: x -> dose + x" in text
    for shown in (made, ro.first_order(made), ro.weak_form(made)):
        assert r"t = 4, 6:\; & x \to dose + x" in shown._repr_latex_()
    compiled = ro.compile(made)
    assert "at t = 4, 6: x -> dose + x" in compiled.source
    assert compiled.system.jumps.times == (2.0, 4.0, 6.0)
    assert compiled.system.jumps.kinds == (0, 1, 1)
    assert repr(pickle.loads(pickle.dumps(made))) == repr(made)


def test_an_impulse_is_a_jump():
    """m x'' + k x = J delta(t - 1) kicks the velocity by J/m."""
    m = sp.Symbol("m")
    equation = sp.Eq(m * x.diff(t, 2) + k * x, dose * sp.DiracDelta(2 * t - 2) * t)
    made = ro.Problem([equation], (t, 0, 5), {**BOX, m: (1, 2)}, {x: 1, x.diff(t): 0})
    (jump,) = ro.first_order(made).jumps
    velocity = sp.Function("x_t")(t)
    assert jump.time == 1.0
    assert jump.values[0] == x
    assert sp.nsimplify(jump.values[1] - velocity - dose / (2 * m)) == 0
    assert not ro.first_order(made).rhs[1].has(sp.DiracDelta)


def test_a_jump_at_the_start_changes_the_initial_value():
    system = ro.first_order(problem({0: {x: 2 * x + dose}}, initial=k))
    assert system.initial == (2 * k + dose,)
    assert system.jumps == ()


def test_impulses_outside_of_the_horizon():
    made = problem(rate=-k * x + dose * (sp.DiracDelta(t + 1) + sp.DiracDelta(t - 20)))
    with pytest.warns(ro.RankoneWarning) as found:
        system = ro.first_order(made)
    assert [jump.time for jump in system.jumps] == [20.0]
    messages = sorted(str(each.message) for each in found)
    assert "`DiracDelta(t + 1)` is before the start of time, 0, and does nothing" in messages[0]
    assert "`DiracDelta(t - 20)` is not before the end of time, 10" in messages[1]


@pytest.mark.parametrize("written", ["jump", "impulse", "event"])
@pytest.mark.parametrize(("lag", "is_late"), [(1, False), (7, True)])
def test_doses_at_times_of_parameters_behind_the_end(written, lag, is_late):
    """No trajectory gets such a dose; at the lower end of `k` it may come before the end."""
    at = lag + 4 * k
    options = {"jumps": {at: {x: x + dose}}} if written == "jump" else {}
    if written == "event":
        options = {"events": [ro.Event(t - at, "rising", then={x: x + dose}, name="jump_0")]}
    rate = -k * x + (dose * sp.DiracDelta(t - at) if written == "impulse" else 0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        ro.Problem(
            [sp.Eq(x.diff(t), rate)], (t, 0, 10), {k: (1, 3), dose: (1, 2)}, {x: 1}, **options
        )
    late = [str(each.message) for each in caught]
    assert bool(late) is is_late
    if is_late:
        assert "`jump_0` happens at t = 4*k + 7, which is not before the end of time, 10" in late[0]


def test_times_may_be_ranges_and_states_have_names():
    assert list(problem({range(2, 9, 3): {x: x + 1}}).jumps) == [2.0, 5.0, 8.0]
    with pytest.raises(ro.ProblemError, match="the jump at 2 resets `X`, which has no equation"):
        ro.Problem.from_strings({"x": "-x"}, {"x": 1}, {}, (0, 3), jumps={2: {"X": "1"}})


def test_text_and_impulses_of_a_list():
    made = ro.Problem.from_strings(
        {"x": "-k*x + dose*DiracDelta(t - 3)", "v": "-v"},
        {"x": "0", "v": "1"},
        {"k": (0.5, 1.5), "dose": (1, 2)},
        (0, 10),
        jumps={(4, 8): {"x": "x + dose*exp(-t)", "v": 2}},
    )
    assert [jump.time for jump in ro.first_order(made).jumps] == [3.0, 4.0, 8.0]
    assert "exp(-4)" in str(made.jumps[4.0])  # time is known there


def test_lifted_states_are_reset_with_what_they_stand_for():
    made = problem({1: {x: x + dose}}, rate=-k * sp.sin(x), initial=1)
    lifting = ro.compile(made).lifted.lifting
    (jump,) = lifting.system.jumps
    after = dict(zip(map(str, lifting.system.functions), jump.values, strict=True))
    assert after["s(t)"] == sp.sin(dose + x)
    assert after["c(t)"] == sp.cos(dose + x)


@pytest.mark.parametrize(
    ("jumps", "message"),
    [
        ([8], "jumps are .* not a mapping"),
        ({8: x + 1}, "the jump at t = 8 is .*, not a mapping from unknowns"),
        ({(): {x: 1}}, "a jump has no times"),
        ({8: {}}, "the jump at t = 8 is .*, not a mapping"),
        ({"8": {x: 1}}, "the time of a jump is .*, not a real number"),
        ({t: {x: 1}}, "the time of a jump, `t`, depends on `t`"),
        ({float("nan"): {x: 1}}, "the time of a jump is nan"),
        ({-1: {x: 1}}, "the jump at t = -1 is before the start of time, 0"),
        ({(2, 2.0): {x: 1}}, "two jumps at t = 2"),
        ({2: {x: 1}, 2 + 1e-12: {x: 1}}, "too close to each other"),
        ({2: {None: 1}}, "resets None, which is not a state"),
        ({2: {v: 1}}, r"resets `?v\(t\)`?, which is not a state"),
        ({2: {"x": 1}}, r"resets .x., which is not a state \(did you mean `x\(t\)`"),
        ({2: {x: v}}, r"the value of `x\(t\)` after the jump at t = 2, `v\(t\)`, names `v\(t\)`"),
        ({2: {x: sp.Symbol("z")}}, "unknown symbol `z`"),
        ({2: {x: sp.oo}}, "not a finite real number"),
        ({2: {x: "1"}}, "not an expression"),
        ({2: {x: x.diff(t)}}, "names `Derivative"),
    ],
)
def test_bad_jumps(jumps, message):
    with pytest.raises(ro.ProblemError, match=message):
        problem(jumps)


@pytest.mark.parametrize(
    ("rate", "message"),
    [
        (sp.DiracDelta(x - k), r"equation 1: .* is at a time that depends on `x\(t\)`"),
        (x * sp.DiracDelta(t - k), r"equation 1: .*multiplied by `x\(t\)`, which jumps there"),
        (sp.Heaviside(t - 1) * sp.DiracDelta(t - k), "equation 1: .* may switch at the same"),
        (sp.DiracDelta(t - k) ** 2, "equation 1: .* does not enter as a product"),
        (sp.DiracDelta(t**2 - k), "equation 1: .* is not at one time"),
        (sp.DiracDelta(t * 1e-310 - 1), "equation 1: .* is at no finite time"),
        (x.diff(t) * sp.DiracDelta(t - 1), "equation 1: an impulse, .* is in front of"),
        (
            sp.DiracDelta(t - 1) * ro.table([0, 1, 10], [0, 1, 5], "previous")(t),
            "equation 1: .* is multiplied by .*, which may switch",
        ),
        (sp.DiracDelta(t**2 - 4), "equation 1: .* is not at one time"),
        (sp.DiracDelta(t - 1, 1), "equation 1: .* is a derivative of an impulse"),
        (sp.sin(sp.DiracDelta(t - 1)), "equation 1: .* does not enter as a product"),
        (x * sp.DiracDelta(t - 1), r"equation 1: .*multiplied by `x\(t\)`, which jumps there"),
        (sp.Heaviside(t - 1) * sp.DiracDelta(t - 1), "equation 1: .* may switch at the same"),
    ],
)
def test_bad_impulses(rate, message):
    with pytest.raises(ro.ProblemError, match=message):
        ro.compile(problem(rate=rate - k * x + dose))


def test_impulses_at_times_of_parameters_are_events():
    """A kick of a mass on a spring, and a dose beside it: exact solutions."""
    y, m = sp.Function("y")(t), sp.Symbol("m", positive=True)
    kicked = ro.Problem(
        [
            sp.Eq(m * x.diff(t, 2) + x, t * sp.DiracDelta(2 * t - 2 * k)),
            sp.Eq(y.diff(t), dose * sp.DiracDelta(t - k) + sp.DiracDelta(t - 4)),
        ],
        (t, 0, 6), {m: (1, 2), k: (1, 2), dose: (1, 2)}, {x: 0, x.diff(t): 0, y: 0},
    )  # fmt: skip
    (jump,) = kicked.events
    assert jump.name == "jump_0"
    assert jump.when == t - k
    assert jump.then == {x.diff(t): x.diff(t) + k / (2 * m), y: y + dose}
    assert pickle.loads(pickle.dumps(kicked)).events == kicked.events
    times = np.array([0.5, 1.5, 3.0, 5.0])
    found = kicked.trajectory(times, m=1.44, k=1.5, dose=1.2)
    since = np.maximum(times - 1.5, 0) / 1.2
    np.testing.assert_allclose(found[x], 0.75 / 1.2 * np.sin(since), atol=1e-7)
    np.testing.assert_allclose(found[y], [0, 1.2, 1.2, 2.2])


def test_both_at_one_time():
    both = problem({1: {x: 1}}, rate=dose * sp.DiracDelta(t - 1) - k * x)
    with pytest.raises(ro.ProblemError, match="both a jump and a DiracDelta at t = 1"):
        ro.compile(both)


def test_a_jump_after_the_end_counts_where_the_end_is_moved():
    with pytest.warns(ro.RankoneWarning, match="jump at t = 10 and 1 more: not before the end"):
        made = problem({(12, 10): {x: x + dose}, 1: {x: dose}})
    assert list(made.jumps) == [1.0, 10.0, 12.0]
