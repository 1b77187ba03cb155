"""Events and jumps of problems with fields: what is taken, and what is refused."""

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.problem.field_events import known_field_time

N = 6
t, k = sp.symbols("t k")
u, v = ro.field("u", N), ro.field("v", N)
x = sp.Function("x")(t)
ROW = np.full((1, N), 1.0 / N)


def problem(events=None, **further):
    rates = {u: -k * u, x: 1}
    return ro.Problem(rates, (t, 0, 1), {k: (1, 2)}, {u: 1, x: 0}, events=events, **further)


def test_events_reset_whole_fields_and_scalars():
    event = ro.Event(
        ro.apply(ROW, u) - 0.5, "falling", then={u: 2 * u + 0.1, x: x / 2}, name="dose"
    )
    (checked,) = problem([event]).events
    assert checked.name == "dose"
    assert checked.then == {u: 2 * u + sp.Rational(1, 10), x: x / 2}
    assert str(problem([event])).endswith(
        f"dose: where apply(<1 x {N}>, u) - 0.5 falls through 0: u -> 2*u + 0.1, x -> x/2"
    )
    assert "dose" in problem([event])._repr_latex_()


def test_values_after_events_may_be_arrays():
    (checked,) = problem([ro.Event(x - 0.5, then={u: np.arange(N)})]).events
    assert checked.then == {u: ro.apply(np.arange(N), 1)}


def test_jumps_are_events_at_known_times():
    events = problem(jumps={(0.25, 0.75): {u: u + 1}, k / 4: {x: 0}}).events
    assert [event.name for event in events] == ["jump_0", "jump_1", "jump_2"]
    times = [known_field_time(event, t) for event in events]
    assert times == [k / 4, sp.Rational(1, 4), sp.Rational(3, 4)]


def test_times_that_fields_tell_are_not_known():
    assert known_field_time(ro.Event(t - ro.apply(ROW, u)), t) is None
    assert known_field_time(ro.Event(t - x), t) is None


def test_velocities_are_named_by_derivatives():
    rates = [sp.Eq(u.diff(t, 2), -k * u)]
    event = ro.Event(ro.apply(ROW, u), "falling", then={u.diff(t): -u.diff(t)})
    start = {u: 1, u.diff(t): 0}
    (checked,) = ro.Problem(rates, (t, 0, 3), {k: (1, 2)}, start, events=[event]).events
    velocity = ro.field("u_t", N)
    assert checked.then == {velocity: -velocity}


def test_problems_with_other_events_differ():
    events = [ro.Event(x - 0.5, then={u: u / 2})]
    assert problem(events) == problem(events)
    assert problem(events) != problem()
    assert problem(events) != problem([ro.Event(x - 0.5, then={u: u / 3})])
    assert problem(events) != problem([ro.Event(x - 0.5, "rising", then={u: u / 2})])


def test_entry_by_entry_events_are_those_of_the_entries():
    event = ro.Event(ro.apply(ROW, u) - 0.5, then={u: ro.apply(2 * np.eye(N), u)})
    (event,) = problem([event]).scalar().events
    entries = [sp.Function(f"u{i}")(t) for i in range(N)]
    assert event.when.subs(dict.fromkeys(entries, 3.0)) == pytest.approx(2.5)
    assert dict(event.then) == {entry: 2 * entry for entry in entries}


def test_text():
    written = ro.Problem.from_strings(
        rhs={"u": "-k*u"},
        fields={"u": N},
        matrices={"row": ROW},
        time=(0, 1),
        parameters={"k": (1, 2)},
        initial={"u": 1},
        events=[{"when": "apply(row, u) - 1/2", "then": {"u": "2*u"}, "name": "dose"}],
        jumps={0.25: {"u": "u + 1"}},
    )
    assert [event.name for event in written.events] == ["dose", "jump_0"]


@pytest.mark.parametrize(
    ("event", "message"),
    [
        (ro.Event(u - 1), "`when` of event `event_0`, `u - 1`, has 6 entries"),
        (ro.Event(k - 1), "changes neither with time nor with an unknown"),
        (ro.Event("x"), "`when` of event `event_0` is 'x', not an expression"),
        (ro.Event(ro.apply(ROW, u.diff(t))), "names `du/dt`"),
        (ro.Event(x - sp.Symbol("y")), "event `event_0`: unknown symbol `y`"),
        (ro.Event(ro.apply(ROW, v)), "`v` has no equation"),
        (ro.Event(sp.Abs(x) - 1), "`Abs(x(t))` is not smooth"),
        (ro.Event(x, "up"), "the direction of event `event_0` is 'up'"),
        (ro.Event(x, terminal=True, delay=1), "has `delay`, which events of fields do not take"),
        (ro.Event(x, priority=1), "has `priority`, which events of fields do not take"),
        (ro.Event(x, "rising", persistent=False), "has `persistent=False`"),
        (ro.Event(x, overlapping=False), "has `overlapping=False`"),
        (ro.Event(x, then={}), "`then` of event `event_0`, `{}`, is empty"),
        (ro.Event(x, then=u), "`then` of event `event_0` is u, not a mapping"),
        (ro.Event(x, then={k: 1}), "event `event_0` resets k, which is not a state"),
        (ro.Event(x, then={"u": 1}), "event `event_0` resets 'u', which is not a state"),
        (ro.Event(x, then={u: np.ones(3)}), "has 3 entries; remedy: give 6 entries"),
        (ro.Event(x, then={x: u}), "has 6 entries; remedy: give 1 entry"),
        (ro.Event(x, then={u: sp.Max(u, 0)}), "`Max(0, u)` is not smooth"),
        (ro.Event(x, name="u"), "`u`"),
        (x, "event 0 is x(t), not a rankone.Event"),
    ],
)
def test_what_is_refused(event, message):
    with pytest.raises(ro.ProblemError) as raised:
        problem([event])
    assert message in str(raised.value)


@pytest.mark.parametrize(
    ("jumps", "message"),
    [
        ([1], "jumps are [1], not a mapping"),
        ({1.5: {u: 0}}, "there is a jump at t = 1.5, which is no time of the horizon"),
        ({x: {u: 0}}, "the time of a jump, `x(t)`, depends on"),
        ({0.5: {k: 0}}, "event `jump_0` resets k, which is not a state"),
    ],
)
def test_jumps_that_are_refused(jumps, message):
    with pytest.raises(ro.ProblemError) as raised:
        problem(jumps=jumps)
    assert message in str(raised.value)


def test_functionals_of_functions_are_refused_by_name():
    squares = problem([ro.Event(ro.apply(ROW, u**2) - 0.5, then={u: 1})])
    with pytest.raises(ro.RankoneError, match=r"`when` of event.*linear in the fields alone"):
        ro.compile(squares)
