"""Events: what may be given, how it is shown, and that ``solve`` refuses it."""

import pickle

import pytest
import sympy as sp

import rankone as ro
from rankone.share.commands.common import load_problem

t, e, k = sp.symbols("t e k")
x, y = (sp.Function(name)(t) for name in "xy")
v = x.diff(t)
BOUNCE = ro.Event(x, "falling", then={v: -e * v}, name="bounce")


def ball(*events):
    return ro.Problem(
        [sp.Eq(x.diff(t, 2), -9.81)], (t, 0, 4), {e: (0.5, 0.9), k: (1, 2)}, {x: k, v: 0},
        events=events,
    )  # fmt: skip


def test_events_are_kept_with_names_and_exact_numbers():
    made = ball(BOUNCE, ro.Event(v), ro.Event(t - 0.1 * k, then={x: 0.5 * x}, terminal=True))
    assert [event.name for event in made.events] == ["bounce", "event_1", "event_2"]
    assert made.events[0] == BOUNCE
    assert made.events[1] == ro.Event(v, name="event_1")
    assert made.events[2].when == t - k / 10
    assert made.events[2].then == {x: x / 2}
    copy = pickle.loads(pickle.dumps(made))
    assert copy.events == made.events
    assert repr(copy) == repr(made)
    assert ball().events == ()


def test_events_are_printed():
    made = ball(BOUNCE, ro.Event(v), ro.Event(x - 5, "rising", then={x: 5, v: 0}, terminal=True))
    assert repr(made).splitlines()[-3:] == [
        "  bounce: where x falls through 0: dx/dt -> -dx/dt*e",
        "  event_1: where dx/dt crosses 0",
        "  event_2: where x - 5 rises through 0: x -> 5, dx/dt -> 0, time ends",
    ]
    latex = made._repr_latex_()
    assert r"\text{bounce}:\; & x \searrow 0,\; \frac{d x}{d t} \to - \frac{d x}{d t} e" in latex
    assert r"\text{event\_1}:\; & \frac{d x}{d t} \leftrightarrows 0" in latex


def test_delays_and_priorities_are_printed():
    made = ball(
        ro.Event(x, "falling", then={v: -e * v}, delay=k / 10, persistent=False, name="late"),
        ro.Event(v, "falling", then={v: 0}, priority=2 * k),
    )
    assert repr(made).splitlines()[-2:] == [
        "  late: where x falls through 0, 0.1*k later, unless it turns back: dx/dt -> -dx/dt*e",
        "  event_1: where dx/dt falls through 0, of priority 2*k: dx/dt -> 0",
    ]
    latex = made._repr_latex_()
    assert r"x \searrow 0,\; \text{after } 0.1 k" in latex
    assert r"\text{priority } 2 k" in latex
    assert pickle.loads(pickle.dumps(made)).events == made.events
    assert "falls through 0, 0.1*k later, unless it" in repr(ro.compile(made).first_order)


def test_text_is_the_same():
    made = ro.Problem.from_strings(
        {"x": "v", "v": "-9.81"},
        {"x": "k", "v": 0},
        {"e": (0.5, 0.9), "k": (1, 2)},
        (0, 4),
        events=[
            {"when": "x", "direction": "falling", "then": {"v": "-e*v"}, "name": "bounce"},
            {"when": "t - k", "then": {"x": 2, "v": "v + x*t"}, "terminal": True},
            {
                "when": "v",
                "direction": "rising",
                "then": {"v": 0},
                "delay": "k/2",
                "priority": 1,
                "persistent": False,
            },
        ],
    )
    height, speed = (sp.Function(name)(t) for name in "xv")
    assert made.events == (
        ro.Event(height, "falling", then={speed: -e * speed}, name="bounce"),
        ro.Event(t - k, then={height: 2, speed: speed + height * t}, terminal=True, name="event_1"),
        ro.Event(
            speed,
            "rising",
            then={speed: 0},
            name="event_2",
            delay=k / 2,
            priority=sp.Integer(1),
            persistent=False,
        ),
    )


TOML = """
time = [0, 4]
rhs = { x = "v", v = "-9.81" }
initial = { x = "1", v = 0 }
parameters = { e = [0.5, 0.9] }

[[events]]
when = "x"
direction = "falling"
then = { v = "-e*v" }
name = "bounce"

[[events]]
when = "t - 3"
terminal = true
delay = "e/2"
priority = 2
"""


def test_a_file(tmp_path):
    path = tmp_path / "ball.toml"
    path.write_text(TOML)
    height, speed = (sp.Function(name)(t) for name in "xv")
    assert load_problem(path).events == (
        ro.Event(height, "falling", then={speed: -e * speed}, name="bounce"),
        ro.Event(t - 3, terminal=True, name="event_1", delay=e / 2, priority=sp.Integer(2)),
    )


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[[events]]", "[events]", "events"),
        ('when = "x"\n', "", "event `bounce` has no `when`"),
        ('when = "x"', "when = true", r"`when` in \[events\] is True, neither text nor a"),
        ('then = { v = "-e*v" }', 'then = "v"', "`then` is 'v', not a table; remedy: write then ="),
        ('then = { v = "-e*v" }', "then = { v = inf }", r"`v` in \[events\] is inf"),
        ('delay = "e/2"', "delay = [1]", r"`delay` in \[events\] is \[1\], neither text nor a"),
        ("direction", "diretion", r"unknown key `diretion` \(did you mean `direction`"),
    ],
)
def test_bad_files(tmp_path, old, new, message):
    path = tmp_path / "ball.toml"
    path.write_text(TOML.replace(old, new, 1))
    with pytest.raises(ro.ProblemError, match=message):
        load_problem(path)


@pytest.mark.parametrize(
    ("events", "message"),
    [
        (BOUNCE, r"events are Event\(.*, not a list of events"),
        ("x", "events are 'x', not a list"),
        ([x], r"event 0 is x\(t\), not a rankone.Event"),
        ([BOUNCE, {"when": "x"}], "event 1 is .*; remedy: .* Problem.from_strings takes mappings"),
        ([ro.Event("x")], "`when` of event `event_0` is 'x', not an expression.*without quotes"),
        ([ro.Event(x > 1)], r"is x\(t\) > 1, not an expression; remedy: .*: x - level"),
        ([ro.Event(sp.Symbol("E") - x)], r"unknown symbol `E` \(did you mean `e`"),
        ([ro.Event(y)], r"`when` of event `event_0`, `y\(t\)`, names `y\(t\)`, which is not a"),
        ([ro.Event(x.diff(t, 3))], r"names `Derivative\(x\(t\), \(t, 3\)\)`, which is not a state"),
        ([ro.Event(x.subs(t, t - 1))], r"names `x\(t - 1\)`, which is not a state"),
        ([ro.Event(k - 1)], "`when` of event `event_0`, `k - 1`, changes neither with time nor"),
        ([ro.Event(sp.Integer(0))], "changes neither"),
        ([ro.Event(sp.I * x)], "is not a finite real number"),
        ([ro.Event(x + sp.DiracDelta(t - 1))], "is not a finite real number"),
        ([ro.Event(x, "up")], "the direction of event `event_0` is 'up'; remedy: choose"),
        ([ro.Event(x, "raising")], r"is 'raising' \(did you mean `rising`"),
        ([ro.Event(x, 1)], "the direction of event `event_0` is 1;"),
        ([ro.Event(x, terminal="yes")], "`terminal` of event `event_0` is 'yes'"),
        ([ro.Event(x, persistent=0)], "`persistent` of event `event_0` is 0; remedy: give True or"),
        ([ro.Event(x, overlapping=1)], "`overlapping` of event `event_0` is 1; remedy: give True"),
        ([ro.Event(x, persistent=False)], "`event_0` is not persistent, and happens in both dire"),
        ([ro.Event(x, then={x: 1}, delay=-1)], "the delay of event `event_0` is `-1`; remedy: giv"),
        ([ro.Event(x, delay=1)], "event `event_0` has a delay, and resets nothing"),
        ([ro.Event(x, then={x: 1}, delay="1")], "`delay` of event `event_0` is '1', not an expre"),
        ([ro.Event(x, then={x: 1}, priority=y)], r"`priority` of event `event_0`, `y\(t\)`, names"),
        ([ro.Event(x, then={x: 1}, priority=sp.oo)], "is not a finite real number"),
        ([ro.Event(x, then={})], "event `event_0` has an empty `then`; remedy: leave it out"),
        ([ro.Event(x, then=[v])], "`then` of event `event_0` is .*, not a mapping"),
        ([ro.Event(x, then={y: 1})], r"event `event_0` resets y\(t\), which is not a state"),
        ([ro.Event(x, then={"x": 1})], r"resets 'x', which is not a state \(did you mean `x\(t\)`"),
        ([ro.Event(x, then={x.diff(t, 2): 1})], "resets .*, which is not a state"),
        ([ro.Event(x, then={x: "1"})], r"value of `x\(t\)` after event `event_0` is '1', not an"),
        ([ro.Event(x, then={x: y})], r"after event `event_0`, `y\(t\)`, names `y\(t\)`"),
        ([ro.Event(x, then={x: sp.oo})], "is not a finite real number"),
        ([ro.Event(x, name="2b")], "'2b' is not a name"),
        ([ro.Event(x, name="if")], "'if' is not a name"),
        ([ro.Event(x, name=3)], "3 is not a name"),
        ([BOUNCE, BOUNCE], "the name `bounce` belongs both to event 0 and to event 1"),
        ([ro.Event(x, name="event_1"), BOUNCE, ro.Event(v, name="event_0")], None),
        ([ro.Event(x, name="event_1"), ro.Event(v)], "the name `event_1` belongs both to event 0"),
        ([ro.Event(x, name="x")], r"the name `x` belongs both to unknown `x\(t\)` and to event 0"),
        ([ro.Event(x, name="x_t")], "the name `x_t` belongs both to unknown"),
        ([ro.Event(x, name="e")], "the name `e` belongs both to parameter `e` and to event 0"),
        ([ro.Event(x, name="t")], "the name `t` belongs both to the time and to event 0"),
    ],
)  # fmt: skip
def test_bad_events(events, message):
    def made():
        problem = [sp.Eq(x.diff(t, 2), -9.81)], (t, 0, 4), {e: (0.5, 0.9), k: (1, 2)}
        return ro.Problem(*problem, {x: k + e, v: 0}, events=events)

    if message is None:
        assert [event.name for event in made().events] == [event.name for event in events]
        return
    with pytest.raises(ro.ProblemError, match=message):
        made()


@pytest.mark.parametrize(
    ("event", "message"),
    [
        ({"when": "x", "then": {"X": 1}}, r"event `event_0` resets `X`, .*\(did you mean `x`"),
        ({"when": "x + z"}, "unknown name `z` in the `when` of event `event_0`"),
        ({"when": "x", "then": {"v": "w"}}, "unknown name `w`.*value of `v` after event `event_0`"),
        ({"when": "x", "then": {"µ": 1, "μ": 2}}, "event `event_0` has two names that Python"),
        ({"when": "x", "then": "v"}, "`then` of event `event_0` is 'v', not a mapping"),
        ({"when": None}, "the `when` of event `event_0` is None, neither text nor a number"),
        ({"when": "x", "them": {}}, r"has the unknown key `them` \(did you mean `then`"),
        ({"then": {"v": 0}, "name": "stop"}, "event `stop` has no `when`"),
    ],
)  # fmt: skip
def test_bad_text(event, message):
    with pytest.raises(ro.ProblemError, match=message):
        ro.Problem.from_strings(
            {"x": "v", "v": "-9.81"}, {"x": 1, "v": 0}, {}, (0, 4), events=[event]
        )


def test_a_parameter_of_events_alone_is_used(recwarn):
    made = ball(BOUNCE)
    assert made.events
    assert not recwarn.list
    with pytest.warns(ro.RankoneWarning, match="parameter `e` appears nowhere"):
        ball()


def test_tables_in_events_have_names_of_their_own():
    first, second = (ro.table([0, 1], [0, height], name="f") for height in (1, 2))
    with pytest.raises(ro.ProblemError, match="`f` names two tables"):
        ball(ro.Event(first(t)), ro.Event(second(t)))
