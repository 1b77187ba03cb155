"""Outputs of solutions with events, against closed forms and single trajectories."""

import numpy as np
import pytest
import sympy as sp

import rankone as ro

t = sp.Symbol("t")
x, y, v = (sp.Function(name)(t) for name in ("x", "y", "v"))


@pytest.fixture(scope="module")
def ball():
    """A ball that falls from h with g = 2: it lands at sqrt(h), and flies 2 e sqrt(h) then."""
    problem = ro.Problem.from_strings(
        {"y": "v", "v": "-2"},
        {"y": "h", "v": 0},
        {"h": (0.8, 1.2), "e": (0.7, 0.9)},
        (0, 3.5),
        events=[{"when": "y", "direction": "falling", "then": {"v": "-e*v"}, "name": "bounce"}],
    )
    solution = ro.solve(problem, 1e-5)
    assert solution.success, solution.message
    return solution


H, E = 1.1, 0.75
AT = {"h": H, "e": E}


def asked(ball, output, **options):
    one = ball.output({"q": output}, **options)
    assert one.success, one.message
    assert one.error < 1e-3
    return float(one["q"](**AT))


def test_times_of_events(ball):
    first = np.sqrt(H)
    assert asked(ball, ro.event_time("bounce", 0)) == pytest.approx(first, rel=1e-4)
    flight = ro.event_time("bounce", 1) - ro.event_time("bounce")
    assert asked(ball, flight) == pytest.approx(2 * E * first, rel=1e-4)
    assert asked(ball, "event_time(bounce, 1)") == pytest.approx((1 + 2 * E) * first, rel=1e-4)


def test_states_on_both_sides_of_an_event(ball):
    speed = 2 * np.sqrt(H)
    assert asked(ball, ro.at_event(v, "bounce", 0)) == pytest.approx(-speed, rel=1e-4)
    after = asked(ball, "at_event(v, bounce, 0, after)")
    assert after == pytest.approx(E * speed, rel=1e-4)
    lost = ro.at_event(v**2, "bounce", 0) - ro.at_event(v**2, "bounce", 0, side="after")
    assert asked(ball, lost) == pytest.approx((1 - E**2) * speed**2, rel=1e-4)


@pytest.mark.slow
def test_functions_of_time_run_through_events(ball):
    first = np.sqrt(H)
    assert asked(ball, ro.maximum(v)) == pytest.approx(2 * first * E, rel=1e-4)
    assert asked(ball, ro.minimum(v)) == pytest.approx(-2 * first, rel=1e-4)
    assert asked(ball, ro.first_crossing(v, 0, "rising")) == pytest.approx(first, rel=1e-4)
    falling = asked(ball, ro.first_crossing(y, H / 4, "falling"))
    assert falling == pytest.approx(first * np.sqrt(0.75), rel=1e-4)
    smooth = ball.restrict(h=(1.05, 1.15), e=(0.74, 0.76))  # falls at the end, all over the box
    assert asked(smooth, ro.duration(-v)) == pytest.approx(duration_of_fall(), rel=1e-4)


def duration_of_fall():
    """For how long the ball falls before t = 3.5."""
    falls = start = np.sqrt(H)
    rise = E * start
    while start < 3.5:
        falls += np.clip(3.5 - start - rise, 0, rise)
        start, rise = start + 2 * rise, E * rise
    return falls


def test_integrals_over_time(ball):
    first = np.sqrt(H)
    to_floor = sp.Integral(y, (t, 0, ro.event_time("bounce", 0)))
    assert asked(ball, to_floor) == pytest.approx(2 / 3 * H * first, rel=1e-4)
    flight = sp.Integral(y, (t, ro.event_time("bounce", 0), ro.event_time("bounce", 1)))
    rise = E * first
    assert asked(ball, flight) == pytest.approx(4 / 3 * rise**3, rel=1e-4)
    # at a fixed time after the first bounce
    share = 1.3 - first
    part = 2 / 3 * H * first + rise * share**2 - share**3 / 3
    assert asked(ball, sp.Integral(y, (t, 0, 1.3))) == pytest.approx(part, rel=1e-4)


def test_outputs_of_the_time_that_exists():
    problem = ro.Problem.from_strings(
        {"x": "u", "u": "0", "y": "v", "v": "-2"},
        {"x": 0, "u": "w", "y": 0, "v": "w"},
        {"w": (0.8, 1.2)},
        (0, 4),
        events=[{"when": "y", "direction": "falling", "terminal": True, "name": "ground"}],
    )
    flight = ro.solve(problem, 1e-6)
    outputs = flight.output(
        {
            "range": ro.at_event(x, "ground"),
            "top": ro.maximum(y),
            "area": sp.Integral(y, t),
            "twice": "2*event_time(ground)",
        }
    )
    assert outputs.success, outputs.message
    w = 0.9
    exact = [w**2, w**2 / 4, w**3 / 6, 2 * w]
    np.testing.assert_allclose(outputs(w=w).ravel(), exact, rtol=1e-4)
    with pytest.raises(ro.OptionError, match="the solution ends there"):
        flight.output({"q": ro.at_event(x, "ground", side="after")})


@pytest.mark.slow
def test_the_stated_error_covers_the_error_of_event_times():
    problem = ro.Problem.from_strings(
        {"x": "-k*x"},
        {"x": 1},
        {"k": (0.5, 2)},
        (0, 2),
        events=[{"when": "x - 0.5", "then": {"x": "x + 1"}, "name": "half"}],
    )
    solution = ro.solve(problem, 1e-3)
    first = solution.output({"half": ro.event_time("half")})
    k = np.linspace(0.5, 2, 31)
    missed = np.abs(first["half"](k=k) - np.log(2) / k).max() / (np.log(2) / 0.5)
    assert missed <= first.error


@pytest.mark.parametrize(
    ("output", "message"),
    [
        (ro.event_time("bouncy"), r"no event `bouncy` \(did you mean `bounce`\?\)"),
        (ro.event_time("bounce", 9), "has no occurrence 9 before the end"),
        (ro.at_event(y, "bounce", 0, "beside"), "the side is `beside`"),
    ],
)
def test_what_cannot_be_asked(ball, output, message):
    with pytest.raises(ro.OptionError, match=message):
        ball.output({"q": output})


@pytest.mark.parametrize("last", [True, False])
def test_an_occurrence_that_is_not_reached_everywhere(ball, last):
    occurrence = -1 if last else len(ball.event_times("bounce", **AT)) - 1
    told = r"does not happen at h = .*: fewer of these events come .*, or take `solution.event_time"
    with pytest.raises(ro.EvaluationError, match=told):
        ball.output({"q": ro.event_time("bounce", occurrence)})


def test_negative_occurrences_count_from_the_last_before_the_end(ball):
    """In this part of the box the third bounce comes after the end."""
    part = ball.restrict(h=(1.0, 1.2), e=(0.85, 0.9))
    assert np.isnan(part.event_times("bounce", h=1.0, e=0.85)[-1])
    made = part.output({"q": ro.event_time("bounce", -1)})
    assert made["q"](h=1.1, e=0.87) == pytest.approx((1 + 2 * 0.87) * np.sqrt(1.1), rel=1e-4)
    with pytest.raises(ro.OptionError, match="those before the end are from 0 to 1"):
        part.output({"q": ro.event_time("bounce", 2)})


def test_a_solution_without_events():
    problem = ro.Problem.from_strings({"x": "-k*x"}, {"x": 1}, {"k": (1, 2)}, (0, 1))
    solution = ro.solve(problem, 1e-4)
    with pytest.raises(ro.OptionError, match="the solution has no events"):
        solution.output({"q": ro.event_time("bounce")})
    falls = solution.output({"q": ro.first_crossing(x, sp.Rational(1, 2), "falling")})
    assert falls["q"](k=1.5) == pytest.approx(np.log(2) / 1.5, rel=1e-3)


def test_functions_of_time(ball):
    made = ball.output({"energy": v**2 / 2 + 2 * y, "fallen": "integral(y, 0, t)"})
    assert made.success, made.message
    assert made.error < 1e-4
    assert made.timeline == ball.timeline
    first, rise = np.sqrt(H), E * np.sqrt(H)
    times = np.array([0.3, 0.9, 1.2, 1.7])
    np.testing.assert_allclose(
        made["energy"](times, **AT), [2 * H, 2 * H, 2 * rise**2, 2 * rise**2], rtol=1e-4
    )
    since = times - first
    after = 2 / 3 * H * first + rise * since**2 - since**3 / 3
    fallen = np.where(times < first, H * times - times**3 / 3, after)
    np.testing.assert_allclose(made["fallen"](times, **AT), fallen, rtol=1e-4)
    np.testing.assert_allclose(made.event_times("bounce", **AT), ball.event_times("bounce", **AT))


def test_derivatives_by_time(ball):
    made = ball.output({"rate": y.diff(t), "again": v.diff(t)})
    np.testing.assert_allclose(made(0.4, **AT), [-0.8, -2.0], rtol=1e-4)
    np.testing.assert_allclose(made(1.5, **AT), [ball["v"](1.5, **AT), -2.0], rtol=1e-4)


def test_one_time(ball):
    falls, rises = ball.at(0.8), ball.restrict(h=(0.9, 1.1)).at(1.2)
    assert falls.success
    assert rises.success
    np.testing.assert_allclose(falls(**AT), [H - 0.64, -1.6], rtol=1e-4)
    since = 1.2 - np.sqrt(1.05)
    up = 2 * E * np.sqrt(1.05)
    exact = [up * since - since**2, up - 2 * since]
    np.testing.assert_allclose(rises(h=1.05, e=E), exact, rtol=1e-4)
    assert falls.metadata.fixed == (("t", 0.8),)
    with pytest.raises(ro.EvaluationError, match="`bounce` has happened for some parameters alone"):
        ball.at(1.0)


@pytest.mark.slow
def test_derivatives(ball):
    by_time, by_e, by_h = (ball.diff(name) for name in ("t", "e", "h"))
    at = {"h": H, "e": E}
    np.testing.assert_allclose(by_time(1.5, **at), [ball["v"](1.5, **at), -2.0], rtol=1e-4)
    for t_ in (0.5, 1.5, 2.0):
        gradient = ball.gradient(t_, **at)
        np.testing.assert_allclose(by_h(t_, **at), gradient[:, 0], rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(by_e(t_, **at), gradient[:, 1], rtol=1e-4, atol=1e-5)
    since, root = 1.5 - np.sqrt(H), np.sqrt(H)
    # y = 2 e sqrt(h) (t - sqrt(h)) - (t - sqrt(h))**2 after the first bounce
    exact = (E / root * since - E + since / root, 2 * root * since)
    assert by_h["y"](1.5, **at) == pytest.approx(exact[0], rel=1e-4)
    assert by_e["y"](1.5, **at) == pytest.approx(exact[1], rel=1e-4)
    assert by_e.status is ro.Status.UNCHECKED


def test_clock_time():
    rates = {"x": "-k*x + Heaviside(t - lag)*(t - lag)"}
    box = {"k": (0.5, 1), "lag": (1, 1.2)}
    marked = ro.Problem.from_strings(
        rates, {"x": 1}, box, (0, 2), events=[{"when": "x - 0.7", "name": "low"}]
    )
    solution = ro.solve(marked, 1e-4)
    plain = solution.in_clock_time(1e-3)
    assert plain.success
    assert plain.outcome.timeline is None
    times = np.linspace(0, 2, 9)
    np.testing.assert_allclose(plain(times, k=0.7, lag=1.1), solution(times, k=0.7, lag=1.1), 1e-3)
    assert plain.to_canonical()
    assert plain.in_clock_time() is plain


def test_clock_time_with_a_jump_at_a_fixed_time():
    problem = ro.Problem.from_strings(
        {"x": "-k*x"},
        {"x": 1},
        {"k": (0.5, 1)},
        (0, 4),
        jumps={2: {"x": "x + 1"}},
        events=[{"when": "x - 0.7", "name": "low"}],
    )
    plain = ro.solve(problem, 1e-4).in_clock_time()
    before, at, after = plain["x"]([1.999, 2.0, 2.001], k=0.7)
    decayed = np.exp(-1.4)
    np.testing.assert_allclose([before, at, after], [decayed, decayed + 1, decayed + 1], 2e-3)
    with pytest.raises(ro.OptionError, match="rtol"):
        ro.solve(problem, 1e-4).in_clock_time(2.0)


def test_one_time_after_the_end():
    shot = ro.Problem.from_strings(
        {"x": "u", "u": "0", "y": "v", "v": "-2"},
        {"x": 0, "u": "w", "y": 0, "v": "w"},
        {"w": (0.8, 1.2)},
        (0, 4),
        events=[{"when": "y", "direction": "falling", "terminal": True, "name": "ground"}],
    )
    solution = ro.solve(shot, 1e-4)  # lands at w
    assert solution.at(0.5)["y"](w=1) == pytest.approx(0.25, rel=1e-3)
    with pytest.raises(ro.EvaluationError, match="the solution has ended before t"):
        solution.at(3.9)


def test_reductions_in_a_function_of_time(ball):
    made = ball.restrict(h=(1.05, 1.15), e=(0.74, 0.76)).output({"share": y / ro.maximum(y)})
    assert made.success, made.message
    times = np.array([0.3, 0.8, 1.5, 3.0])
    share = made["share"](times, **AT)
    np.testing.assert_allclose(share, ball["y"](times, **AT) / H, atol=1e-4)


@pytest.mark.slow
def test_resets_at_moving_times_are_not_resolved_over_clock_time(ball):
    with pytest.raises(ro.ConvergenceError, match="since `bounce` may reset states at"):
        ball.restrict(e=(0.79, 0.8)).in_clock_time(1e-3)
