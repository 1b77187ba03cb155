"""Trajectories with events, against exact solutions of each stretch."""

import itertools

import numpy as np
import pytest
import sympy as sp

import rankone as ro

t, k, e, h = sp.symbols("t k e h")
x, y, n = (sp.Function(name)(t) for name in "xyn")
v = x.diff(t)
GRAVITY = 9.81


def ball(*events, rate=-GRAVITY, time=(t, 0, 4), initial=None):
    box = {k: (0.01, 0.5), e: (0.3, 1.1), h: (0.5, 3)}
    used = ro.Event(k * e * h * t + 1, name="never")  # parameters are used, and nothing happens
    return ro.Problem(
        [sp.Eq(x.diff(t, 2), rate)], time, box, initial or {x: h, v: 0}, events=[*events, used]
    )


def bounce(**options):
    return ro.Event(x, "falling", then={v: -e * v}, name="bounce", **options)


POINT = {k: 0.1, e: 0.8, h: 2.0}


def flights(drag, restitution, height, count):
    """Impacts of a ball with quadratic drag: times, and speeds before each (exact)."""
    scale = np.sqrt(GRAVITY * drag)
    time, impacts = 0.0, []
    for _ in range(count):
        time += np.arccosh(np.exp(drag * height)) / scale
        speed = np.sqrt(GRAVITY / drag * -np.expm1(-2 * drag * height))
        impacts.append((time, speed))
        up = restitution * speed
        time += np.arctan(up * np.sqrt(drag / GRAVITY)) / scale
        height = np.log1p(drag * up**2 / GRAVITY) / (2 * drag)
    return np.transpose(impacts)


def test_a_bouncing_ball_with_drag():
    made = ball(bounce(), rate=-GRAVITY - k * v * sp.Abs(v))
    times, speeds = flights(0.1, 0.8, 2.0, 12)
    inside = times < 4
    trajectory = made.trajectory(4.0, POINT)
    np.testing.assert_allclose(trajectory.events["bounce"], times[inside], rtol=1e-7)
    assert len(trajectory.events["bounce"]) == 8
    at = trajectory.events["bounce"]
    np.testing.assert_allclose(made.trajectory(at, POINT)[v], 0.8 * speeds[inside], rtol=1e-6)
    np.testing.assert_allclose(made.trajectory(at - 1e-9, POINT)[v], -speeds[inside], rtol=1e-6)


@pytest.mark.parametrize("restitution", [0.3, 0.5, 0.9, 1.0, 1.1])
def test_a_bouncing_ball_without_drag(restitution):
    """Between the impacts a parabola, at any time."""
    fall = np.sqrt(2 * 2.0 / GRAVITY)
    flight = 2 * restitution * fall
    last = 3.9 if restitution >= 0.9 else fall * (1 + 2 * restitution + 1.9 * restitution**2)
    times = np.linspace(0.0, last, 200)
    trajectory = ball(bounce()).trajectory(times, {**POINT, e: restitution})
    impacts = [fall]
    while impacts[-1] < last:
        impacts.append(impacts[-1] + flight)
        flight *= restitution
    np.testing.assert_allclose(trajectory.events["bounce"], impacts[:-1], rtol=1e-7)
    number = np.searchsorted(impacts, times, side="right")
    start = np.array([-fall, *impacts])[number]
    speed = GRAVITY * fall * restitution**number
    since = times - start
    exact = speed * since - GRAVITY * since**2 / 2
    np.testing.assert_allclose(trajectory[x], exact, atol=2e-6)


@pytest.mark.parametrize("restitution", np.linspace(0.3, 0.6, 6).tolist())
def test_no_ball_falls_through_the_floor(restitution):
    """The last flights are below the tolerance of the steps, where rounding tells no side."""
    made = ball(bounce())
    for height in (0.578, 0.751, 1.266, 1.622):
        with pytest.raises(ro.ConvergenceError, match="event `bounce` happens again and again"):
            made.trajectory(4.0, {**POINT, e: restitution, h: height})


@pytest.mark.parametrize("then", [{x: 0, v: 0}, {v: 0}, {v: -0.0 * v}])
def test_a_ball_at_rest_on_the_floor_does_not_fall_through_it(then):
    landing = ro.Event(x, "falling", then=then, name="landing")
    with pytest.raises(ro.ConvergenceError, match="event `landing` happens again and again"):
        ball(landing).trajectory(4.0, POINT)


def test_bounces_without_end_are_an_error():
    """The flights add up to a time inside the horizon."""
    fall = np.sqrt(2 * 2.0 / GRAVITY)
    end = fall * (1 + 2 * 0.5 / (1 - 0.5))
    with pytest.raises(ro.ConvergenceError, match="event `bounce` happens again and again") as f:
        ball(bounce()).trajectory(4.0, {**POINT, e: 0.5})
    assert f"t = {end:.4f}"[:-1] in str(f.value)
    early = ball(bounce()).trajectory(0.99 * end, {**POINT, e: 0.5})
    assert np.isfinite(early.values).all()


def test_a_relay_with_memory():
    """A thermostat: T' = 3 n - (T - 15)/5, on below 19, off above 21 (exact)."""
    heating = ro.Event(x - 19, "falling", then={n: 1}, name="on")
    idle = ro.Event(x - 21, "rising", then={n: 0}, name="off")
    equations = [sp.Eq(x.diff(t), 3 * n - k * (x - 15)), sp.Eq(n.diff(t), 0)]
    made = ro.Problem(equations, (t, 0, 40), {k: (0.1, 0.3)}, {x: 20, n: 0}, events=[heating, idle])
    rate, warm = 0.2, 15 + 3 / 0.2
    cooling, warming = np.log(6 / 4) / rate, np.log((warm - 19) / (warm - 21)) / rate
    first = np.log(5 / 4) / rate
    on = np.arange(first, 40, cooling + warming)
    off = np.arange(first + warming, 40, cooling + warming)
    times = np.linspace(0, 40, 300)
    trajectory = made.trajectory(times, k=rate)
    np.testing.assert_allclose(trajectory.events["on"], on, rtol=1e-6)
    np.testing.assert_allclose(trajectory.events["off"], off, rtol=1e-6)
    state = np.searchsorted(np.sort([*on, *off]), times, side="right") % 2
    np.testing.assert_array_equal(trajectory[n], state)


def line(*events, initial=None, end=4):
    """x' = k and n' = 0, and no other parameters."""
    return ro.Problem(
        [sp.Eq(x.diff(t), k), sp.Eq(n.diff(t), 0)],
        (t, 0, end), {k: (0.5, 2)}, initial or {x: 0, n: 0}, events=events,
    )  # fmt: skip


def test_a_delay_is_from_the_crossing_to_the_reset():
    """The delay is taken at the crossing, the values at the reset; several may be under way."""
    late = ro.Event(x - 1, "rising", then={n: n + x}, delay=1 + n, name="late")
    back = ro.Event(x - 1.5, "rising", then={x: 0}, name="back")
    trajectory = line(late, back, end=5).trajectory([1.9, 2.1, 3.9, 4.0, 4.6], k=1.0)
    # x is 1 at 1, 2.5 and 4, when n is 0, 1/2 and 1/2; so it is reset at 2, 4 and 5.5
    np.testing.assert_allclose(trajectory.events["late"], [2, 4], rtol=1e-9)
    np.testing.assert_allclose(trajectory[n], [0, 0.5, 0.5, 1.5, 1.5], atol=1e-8)
    np.testing.assert_allclose(trajectory.events["back"], [1.5, 3, 4.5], rtol=1e-9)


def test_a_delay_of_nothing_and_one_to_the_end():
    now = ro.Event(x - 1, "rising", then={n: n + 1}, delay=0, name="now")
    last = ro.Event(x - 1, "rising", then={n: n + 2}, delay=3, name="last")
    trajectory = line(now, last).trajectory([0.9, 1.0, 3.9, 4.0], k=1.0)
    np.testing.assert_allclose(trajectory[n], [0, 1, 1, 3], atol=1e-12)
    stop = ro.Event(x - 1, "rising", delay=k / 2, terminal=True, name="stop")
    ended = line(stop).trajectory([1.4, 1.6], k=1.0)
    np.testing.assert_array_equal(np.isnan(ended[x]), [False, True])
    np.testing.assert_allclose(ended.events["stop"], [1.5], rtol=1e-9)


def test_a_delay_is_not_negative():
    wrong = ro.Event(x - 1, "rising", then={n: 1}, delay=1 - k, name="wrong")
    with pytest.raises(
        ro.ProblemError, match=r"the delay of event `wrong` is -1 at t = 0\.5, k = 2"
    ):
        line(wrong).trajectory(4.0, k=2.0)
    assert line(wrong).trajectory(4.0, k=0.5)[n] == 1


def test_what_turns_back_is_withdrawn_unless_it_persists():
    """The wave sin t is above 1/2 for 2 pi/3; a jump back withdraws as well."""

    def wave(*events):
        rates = [sp.Eq(x.diff(t), k * sp.cos(t)), sp.Eq(n.diff(t), 0)]
        return ro.Problem(rates, (t, 0, 6), {k: (0.5, 2)}, {x: 0, n: 0}, events=events)

    up = (x - 0.5, "rising")
    times = {
        (delay, persistent): wave(
            ro.Event(*up, then={n: n + 1}, delay=delay, persistent=persistent, name="up")
        ).trajectory(6.0, k=1.0).events["up"]
        for delay in (2, 2.2)
        for persistent in (True, False)
    }  # fmt: skip
    first = np.pi / 6
    for key in [(2, True), (2, False), (2.2, True)]:
        np.testing.assert_allclose(times[key], [first + key[0]], rtol=1e-6)
    assert times[2.2, False].size == 0
    reset = ro.Event(t - 1, "rising", then={x: 0}, name="reset")
    jumped = wave(ro.Event(*up, then={n: 1}, delay=2, persistent=False, name="up"), reset)
    assert jumped.trajectory(6.0, k=1.0).events["up"].size == 0


def test_priorities_are_taken_anew_after_each_event():
    add = ro.Event(x - 1, "rising", then={n: n + 1})
    double = ro.Event(x - 1, "rising", then={n: 2 * n}, priority=1)
    square = ro.Event(x - 1, "rising", then={n: n**2}, priority=n)
    at_three, at_nothing = ({x: 0, n: start} for start in (3, 0))
    assert line(add, double, initial=at_three).trajectory(2.0, k=1.0)[n] == 7
    assert line(add, double, square, initial=at_three).trajectory(2.0, k=1.0)[n] == 19
    # square is behind double at first; then both are of no priority, and go by the list
    assert line(add, double, square, initial=at_nothing).trajectory(2.0, k=1.0)[n] == 1


def test_an_event_that_another_one_turns_back_at_once():
    lower = ro.Event(x - 1, "rising", then={x: x - 0.5}, priority=1, name="lower")
    count = {"when": x - 1, "direction": "rising", "then": {n: n + 1}, "name": "count"}
    for persistent, counted in ((True, 1), (False, 0)):
        made = line(ro.Event(**count, persistent=persistent), lower)
        assert made.trajectory(1.2, k=1.0)[n] == counted


LATE = [
    # x is 2 when the delays are over; the second event lowers it, within what counts or below it
    ro.Event(x - 1, "rising", then={n: n + 1}, delay=1, persistent=False, name="late"),
    ro.Event(x - 1, "rising", then={x: h * x}, delay=1, priority=1, name="lower"),
]


@pytest.mark.parametrize(("share", "counted"), [(0.9, 1), (0.4, 0)])
def test_what_turns_back_at_the_very_end_of_the_delay(share, counted):
    made = ro.Problem(
        [sp.Eq(x.diff(t), 1), sp.Eq(n.diff(t), 0)],
        (t, 0, 2.5), {h: (share, share + 0.05)}, {x: 0, n: 0}, events=LATE,
    )  # fmt: skip
    assert made.trajectory(2.3, h=share)[n] == counted
    solution = ro.solve(made, 1e-3)
    assert solution.success
    assert solution[n](2.3, h=share) == pytest.approx(counted, abs=1e-6)


def test_a_surface_that_is_passed_in_spite_of_the_reset():
    """A slow relay: x'' = u - 1 goes on through the surface after u is set; exact parabolas."""
    events = [
        ro.Event(x, "falling", then={n: 2}, name="push"),
        ro.Event(x, "rising", then={n: 0}, name="release"),
    ]
    made = ro.Problem(
        [sp.Eq(x.diff(t, 2), n - 1), sp.Eq(n.diff(t), 0)],
        (t, 0, 12), {k: (0.5, 2)}, {x: k, v: 0, n: 0}, events=events,
    )  # fmt: skip
    trajectory = made.trajectory(12.0, k=1.0)
    fall = np.sqrt(2)  # time to fall by one, which is also the speed then
    np.testing.assert_allclose(trajectory.events["push"], fall + 4 * fall * np.arange(2), rtol=1e-6)
    np.testing.assert_allclose(
        trajectory.events["release"], 3 * fall + 4 * fall * np.arange(2), rtol=1e-6
    )


def test_integrate_and_fire():
    """V' = I - V, reset to 0 at 1: the period is log(I/(I - 1))."""
    fire = ro.Event(x - 1, "rising", then={x: 0}, name="spike")
    made = ro.Problem([sp.Eq(x.diff(t), k - x)], (t, 0, 10), {k: (1.1, 3)}, {x: 0}, events=[fire])
    period = np.log(1.5 / 0.5)
    trajectory = made.trajectory([0.0, 2.0, 10.0], k=1.5)
    spikes = period * np.arange(1, 10)
    np.testing.assert_allclose(trajectory.events["spike"], spikes, rtol=1e-6)
    phases = np.array([0.0, 2.0, 10.0]) % period
    np.testing.assert_allclose(trajectory[x], 1.5 * -np.expm1(-phases), rtol=1e-5)
    either = ro.Event(x - 1, then={x: 0}, name="spike")  # its own reset does not set it off
    again = ro.Problem(made.equations, made.time, {k: (1.1, 3)}, {x: 0}, events=[either])
    np.testing.assert_array_equal(again.trajectory(10.0, k=1.5).events["spike"],
                                  trajectory.events["spike"])  # fmt: skip


def test_a_rocket_drops_its_stage():
    """v' = c b/(s + f) - g, f' = -b: Tsiolkovsky in each stage; then it is coasting."""
    speed, fuel, hull, burn = (sp.Function(name)(t) for name in ("w", "f", "s", "b"))
    last = n >= 1
    drop = ro.Event(
        fuel,
        "falling",
        then={
            n: n + 1,
            fuel: sp.Piecewise((0, last), (30, True)),
            hull: sp.Piecewise((hull, last), (10, True)),
            burn: sp.Piecewise((0, last), (2, True)),
        },
        name="empty",
    )
    rates = {speed: k * burn / (hull + fuel) - GRAVITY, fuel: -burn, hull: 0, burn: 0, n: 0}
    made = ro.Problem(
        [sp.Eq(u.diff(t), rate) for u, rate in rates.items()],
        (t, 0, 60), {k: (2000, 3000)}, {speed: 0, fuel: 100, hull: 60, burn: 5, n: 0},
        events=[drop],
    )  # fmt: skip
    times = np.array([10.0, 20.0, 30.0, 35.0, 50.0])
    trajectory = made.trajectory(times, k=2500)
    np.testing.assert_allclose(trajectory.events["empty"], [20, 35], rtol=1e-9)
    first, second = 2500 * np.log(160 / 60), 2500 * np.log(40 / 10)
    thrust = [2500 * np.log(160 / 110), first, first + 2500 * np.log(40 / 20),
              first + second, first + second]  # fmt: skip
    np.testing.assert_allclose(trajectory[speed], thrust - GRAVITY * times, rtol=1e-7)
    np.testing.assert_array_equal(trajectory[n], [0, 1, 1, 2, 2])


def test_values_after_a_terminal_event_are_not_numbers():
    made = ball(bounce(terminal=True))
    ground = np.sqrt(4 / GRAVITY)
    at = made.trajectory(4.0, POINT).events["bounce"]
    np.testing.assert_allclose(at, [ground], rtol=1e-7)
    trajectory = made.trajectory([3.0, *at, 0.1, ground + 1e-6], POINT)
    assert np.isnan(trajectory[x][[0, 3]]).all()
    np.testing.assert_allclose(trajectory[v][1], 0.8 * GRAVITY * ground, rtol=1e-6)
    np.testing.assert_allclose(trajectory[x][2], 2 - GRAVITY * 0.01 / 2, rtol=1e-7)


def test_markers_change_nothing():
    marked = ball(ro.Event(v + 5, name="fast"), ro.Event(sp.sin(20 * t), "rising", name="tick"))
    plain = ball()
    times = np.linspace(0, 0.6, 20)
    marks = marked.trajectory(times, POINT)
    np.testing.assert_allclose(marks.events["fast"], [5 / GRAVITY], rtol=1e-8)
    ticks = 2 * np.pi / 20 * np.arange(1, 2)
    np.testing.assert_allclose(marks.events["tick"], ticks, rtol=1e-9)
    np.testing.assert_allclose(marks[x], plain.trajectory(times, POINT)[x], rtol=1e-7)
    assert repr(marks).endswith("with events: 1 of fast, 1 of tick, 0 of never")


def drift(*events, jumps=None, rates=(1, 0, 0), time=(t, 0, 5), initial=(0, 0, 0)):
    """x' = 1 and two that stand still, unless other rates are given."""
    box = {k: (0.5, 2)}
    equations = [sp.Eq(u.diff(t), rate) for u, rate in zip((x, y, n), rates, strict=True)]
    states = dict(zip((x, y, n), initial, strict=True))
    states[y] += sp.S.Zero * k
    return ro.Problem(
        equations, time, box, states, jumps=jumps,
        events=[*events, ro.Event(k * t + 1, name="never")],
    )  # fmt: skip


@pytest.mark.parametrize("order", [0, 1])
def test_events_at_one_instant_are_applied_in_the_order_listed(order):
    """Each reads the values before itself: (y + 1) * 3 or y * 3 + 1."""
    events = [
        ro.Event(x - 2, then={y: y + 1}, name="a"),
        ro.Event(2 * x - 4, then={y: 3 * y}, name="b"),
    ]
    made = drift(*(events if order == 0 else events[::-1]), initial=(0, 1, 0))
    trajectory = made.trajectory([1.0, 5.0], k=1)
    np.testing.assert_array_equal(trajectory[y], [1, 6 if order == 0 else 4])
    assert trajectory.events["a"] == trajectory.events["b"]


def test_all_values_of_an_event_are_those_before_it():
    made = drift(ro.Event(x - 1, then={x: y, y: x}), rates=(1, 1, 0), initial=(0, -7, 0))
    trajectory = made.trajectory(1.5, k=1)
    np.testing.assert_allclose(trajectory.values[:2], [-5.5, 1.5], rtol=1e-9)


def test_events_set_off_others():
    """x passes 1, y jumps over 3, n jumps over 0.5: all at one instant."""
    made = drift(
        ro.Event(n - 0.5, "rising", then={x: x + 10}, name="third"),
        ro.Event(x - 1, "rising", then={y: 4}, name="first"),
        ro.Event(y - 3, "rising", then={n: n + 1}, name="second"),
        ro.Event(y - 3, "falling", then={n: 100}, name="other"),
        ro.Event(x - 5, name="marker"),
    )
    trajectory = made.trajectory(3.0, k=1)
    np.testing.assert_allclose(trajectory.values, [13, 4, 1], rtol=1e-9)
    events = {name: list(times) for name, times in trajectory.events.items()}
    assert events.pop("never") == events.pop("other") == []
    assert len({tuple(times) for times in events.values()}) == 1
    np.testing.assert_allclose(events["first"], [1.0])


def test_a_jump_sets_off_an_event():
    made = drift(
        ro.Event(x - 3, "rising", then={y: y + 1}, name="over"),
        ro.Event(x - 3, "falling", then={n: n + 1}, name="under"),
        jumps={1: {x: 4}, 2: {x: 0}},
    )
    trajectory = made.trajectory([1 - 1e-6, 1.0, 2.0, 4.9, 5.0], k=1)
    np.testing.assert_array_equal(trajectory[y], [0, 1, 1, 1, 1])
    np.testing.assert_array_equal(trajectory[n], [0, 0, 1, 1, 1])
    assert (trajectory.events["over"], trajectory.events["under"]) == (1.0, 2.0)


def test_a_jump_at_the_start_is_the_start():
    made = drift(ro.Event(x - 3, then={y: 1}, name="over"), jumps={0: {x: 4}})
    trajectory = made.trajectory([0.0, 5.0], k=1)
    np.testing.assert_allclose(trajectory[x], [4, 9], rtol=1e-9)
    assert trajectory.events["over"].size == 0


@pytest.mark.parametrize("delay", [None, 1])
@pytest.mark.parametrize("at", [0, 1, 5])
def test_known_times_at_both_ends(at, delay):
    """With a delay what happens at the end is put off beyond it."""
    made = drift(ro.Event(t - at * k, "rising", then={y: y + 1}, name="dose", delay=delay))
    trajectory = made.trajectory([0.0, 4.0, 5.0], k=1)
    happens = at + (delay or 0)
    np.testing.assert_array_equal(trajectory[y], [happens <= time for time in (0, 4, 5)])
    np.testing.assert_array_equal(trajectory.events["dose"], [happens][: happens <= 5])


@pytest.mark.parametrize(("start", "count"), [(0, 0), (-0.1, 1), (0.1, 0), (sp.Rational(1, 3), 0)])
def test_a_start_on_the_surface_is_no_crossing(start, count):
    level = start if count == 0 and start != 0.1 else 0
    made = drift(ro.Event(x - level, then={y: y + 1}, name="cross"), initial=(start, 0, 0))
    trajectory = made.trajectory(5.0, k=1)
    assert len(trajectory.events["cross"]) == count == trajectory[y]


def test_a_ball_that_starts_on_the_floor():
    made = ball(bounce(), initial={x: 0, v: h})
    first = 2 * 2.0 / GRAVITY
    trajectory = made.trajectory(1.0, {**POINT, e: 1.0})
    np.testing.assert_allclose(trajectory.events["bounce"], [first, 2 * first], rtol=1e-7)


def test_events_that_set_off_each_other_without_end():
    made = drift(
        ro.Event(x - 1, "rising", then={y: -y}, name="a"),
        ro.Event(y, "rising", then={y: -1}, name="up"),
        ro.Event(y, "falling", then={y: 1}, name="down"),
        initial=(0, 1, 0),
    )
    with pytest.raises(ro.ConvergenceError, match=r"`(up|down)` .*t = 1, k = 1: more than 100"):
        made.trajectory(2.0, k=1)
    assert made.trajectory(0.9, k=1)[y] == 1


def test_a_surface_that_is_touched_and_left_is_not_crossed():
    """x' = n: it falls to zero, turns there, and rises for ever."""
    made = drift(
        ro.Event(x, "rising", then={n: -1}, name="down"),
        ro.Event(x, "falling", then={n: 1}, name="up"),
        rates=(n, 0, 0),
        initial=(1, 0, -1),
    )
    trajectory = made.trajectory(5.0, k=1)
    assert trajectory.events["down"].size == 0
    np.testing.assert_allclose(trajectory.events["up"], [1.0], rtol=1e-12)
    np.testing.assert_allclose(trajectory[x], 4.0, rtol=1e-9)


@pytest.mark.parametrize("gap", [1e-3, 1e-6, 1e-9])
def test_both_crossings_of_a_shallow_dip(gap):
    """x = (t - 2)^2 - gap crosses zero twice, closely: a dip of one step is seen."""
    when = x - gap
    made = drift(
        ro.Event(when, "falling", name="enter"), ro.Event(when, "rising", name="leave"),
        rates=(2 * (t - 2), 0, 0), initial=(4, 0, 0),
    )  # fmt: skip
    trajectory = made.trajectory(5.0, k=1, rtol=1e-11)
    width = np.sqrt(gap)
    if width > 5 / 2048:
        np.testing.assert_allclose(trajectory.events["enter"], [2 - width], rtol=1e-6)
        np.testing.assert_allclose(trajectory.events["leave"], [2 + width], rtol=1e-6)
    assert len(trajectory.events["enter"]) == len(trajectory.events["leave"])


@pytest.mark.slow
def test_events_at_known_times_are_all_seen():
    """A hundred doses at times that depend on a parameter, while nothing else happens."""
    made = drift(
        ro.Event(sp.sin(40 * sp.pi * (t - k / 100)), "rising", then={y: y + 1}, name="dose"),
        rates=(0, 0, 0),
    )
    trajectory = made.trajectory(5.0, k=1.3)
    np.testing.assert_allclose(trajectory.events["dose"], 0.013 + np.arange(100) / 20, rtol=1e-9)
    assert trajectory[y] == 100


def test_a_trajectory_ends_at_the_last_time():
    made = drift(
        ro.Event(x - 1, then={x: 0}, name="reset"), rates=(1, y**2, 0), initial=(0, 0.25, 0)
    )
    trajectory = made.trajectory(3.5, k=1)
    assert len(trajectory.events["reset"]) == 3
    with pytest.raises(ro.BlowUpError, match="beyond t = 4"):
        made.trajectory(5.0, k=1)


def test_values_do_not_depend_on_the_times_asked_for():
    made = ball(bounce())
    times = np.linspace(0, 4, 30)
    together = made.trajectory(times, POINT)[x]
    alone = [made.trajectory(at, POINT)[x] for at in times[[3, 17, 29]]]
    np.testing.assert_array_equal(together[[3, 17, 29]], alone)


def test_users_functions_in_events():
    square = ro.function("square", lambda z: z**2, lambda z: 2 * z)
    level = ro.table([0, 5], [4, 4.0])
    made = drift(ro.Event(square(x) - level(t), "rising", then={y: square(x) + level(t)}))
    trajectory = made.trajectory([1.9, 5.0], k=1)
    np.testing.assert_allclose(trajectory.events["event_0"], [2], rtol=1e-9)
    np.testing.assert_allclose(trajectory[y], [0, 8], rtol=1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_random_balls_in_a_box(seed):
    """A point between two walls, with springs of its own: separately coded, flight by flight."""
    rng = np.random.default_rng(seed)
    place, speed, loss = rng.uniform(-0.9, 0.9), rng.uniform(1, 3), rng.uniform(0.7, 1)
    made = ro.Problem(
        [sp.Eq(x.diff(t, 2), 0)], (t, 0, 5), {e: (0.5, 1.1)}, {x: place, v: speed},
        events=[
            ro.Event(x - 1, "rising", then={v: -e * v}, name="right"),
            ro.Event(x + 1, "falling", then={v: -e * v}, name="left"),
        ],
    )  # fmt: skip
    times, walls = [], itertools.cycle([1, -1])
    now, at, velocity = 0.0, place, speed
    for wall in walls:
        now, at = now + (wall - at) / velocity, wall
        if now > 5:
            break
        velocity *= -loss
        times.append(now)
    trajectory = made.trajectory(5.0, {e: loss})
    np.testing.assert_allclose(trajectory.events["right"], times[::2], rtol=1e-9)
    np.testing.assert_allclose(trajectory.events["left"], times[1::2], rtol=1e-9)


def test_an_expression_with_a_pole():
    """1/(2 - x) + 1 vanishes at x = 3, and has a pole at 2."""
    made = drift(ro.Event(1 / (2 - x) + 1, "rising", then={y: y + 1}, name="cross"),
                 initial=(sp.Rational(5, 2), 0, 0))  # fmt: skip
    trajectory = made.trajectory(5.0, k=1)
    np.testing.assert_allclose(trajectory.events["cross"], [0.5], rtol=1e-9)


def test_a_step_of_an_expression_is_a_crossing():
    made = drift(ro.Event(sp.sign(x - 1), "rising", then={y: y + x}, name="step"))
    trajectory = made.trajectory(5.0, k=1)
    np.testing.assert_allclose(trajectory.events["step"], [1.0], rtol=1e-9)
    np.testing.assert_allclose(trajectory[y], 1.0, rtol=1e-9)


def test_a_tank_runs_empty():
    """x' = -k sqrt(x) - 1/10 has no rate beyond the event: it empties (exact) all the same."""
    empty = ro.Event(x, "falling", then={x: 0, y: 1}, terminal=True, name="empty")
    made = drift(empty, rates=(-k * sp.sqrt(x) - 0.1, 0, 0), initial=(1, 0, 0))
    end = 2 - 0.2 * np.log(1.1 / 0.1)
    trajectory = made.trajectory([1.0, 5.0], k=1)
    np.testing.assert_allclose(trajectory.events["empty"], [end], rtol=1e-7)
    assert np.isnan(trajectory[x][1])


def test_no_event_is_made_up_where_a_trajectory_cannot_go_on():
    made = drift(ro.Event(x + 1, terminal=True), rates=(-sp.sqrt(x) - 1, 0, 0), initial=(1, 0, 0))
    with pytest.raises(ro.BlowUpError, match=r"cannot be continued beyond t = 0\.61370"):
        made.trajectory(5.0, k=1)


def test_a_reset_to_what_is_no_number():
    made = drift(ro.Event(x - 1, then={x: sp.log(-x)}), rates=(1, 0, 0))
    with pytest.raises(ro.BlowUpError, match=r"beyond t = 1, k = 1: .* a state or rate is"):
        made.trajectory(5.0, k=1)
