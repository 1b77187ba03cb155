"""Solutions of problems with events, against single trajectories by SciPy."""

import pickle
import re
from functools import cache

import numpy as np
import pytest

import rankone as ro
from rankone.support.budget import limited
from rankone.trajectories.system.features import Ending

RTOL = 1e-4


def problem(rhs, initial, parameters, end, events, **further):
    return ro.Problem.from_strings(rhs, initial, parameters, (0, end), events=events, **further)


@cache
def solved(name):
    return ro.solve(PROBLEMS[name], RTOL)


BOUNCE = {"when": "y", "direction": "falling", "then": {"y": 0, "v": "-e*v"}, "name": "bounce"}
UP = {"when": "x - 0.5", "direction": "rising"}
PROBLEMS = {
    # two to three bounces before the end, as the height is
    "ball": problem(
        {"y": "v", "v": "-9.81 - c*v*abs(v)"},
        {"y": "h", "v": 0},
        {"h": (0.8, 1.2), "c": (0.04, 0.06), "e": (0.78, 0.82)},
        1.6,
        [BOUNCE],
    ),
    # to the ground on a slope, for some parameters after the end
    "projectile": problem(
        {"x": "p", "y": "q", "p": "-c*p", "q": "-9.81 - c*q"},
        {"x": 0, "y": 0, "p": "w*cos(a)", "q": "w*sin(a)"},
        {"w": (15, 25), "a": (0.6, 0.9), "c": (0.05, 0.1)},
        2.5,
        [{"when": "y - x/10", "direction": "falling", "terminal": True, "name": "ground"}],
    ),
    "relay": problem(
        {"x": "k*(s*m - x)", "s": "0"},
        {"x": 0, "s": 1},
        {"k": (0.9, 1.1), "m": (3.9, 4.1)},
        3,
        [
            {"when": "x - 2", "direction": "rising", "then": {"s": 0}, "name": "off"},
            {"when": "x - 1", "direction": "falling", "then": {"s": 1}, "name": "on"},
        ],
    ),
    # a dose after a lag, and a second one at a known time
    "dose": problem(
        {"A": "-k*A"},
        {"A": "0.1"},
        {"k": (0.2, 0.4), "lag": (1, 2), "D": (1, 2)},
        6,
        [],
        jumps={"lag": {"A": "A + D"}, 3: {"A": "A + 1"}},
    ),
    # one reset that lags, one that is withdrawn, and two at one instant
    "late": problem(
        {"x": "w*cos(w*t)", "y": "-k*y"},
        {"x": 0, "y": 1},
        {"w": (3, 3.1), "k": (0.1, 0.2)},
        1.8,
        [
            {**UP, "then": {"y": "y + x"}, "delay": "k + w/10", "name": "soon"},
            {**UP, "then": {"y": 9}, "delay": 1, "persistent": False, "name": "late"},
            {"when": "t - 1.2", "direction": "rising", "then": {"y": "y + w"}, "name": "add"},
            {"when": "t - 1.2", "then": {"y": "y/2"}, "priority": "w", "name": "halve"},
        ],
    ),
}
ENDINGS = {
    "ball": (Ending.EVENT, 6),
    "projectile": (Ending.EVENT, 1),
    "relay": (Ending.EVENT, 6),
    "dose": (Ending.HORIZON, 3),
    "late": (Ending.HORIZON, 5),
}


def points(solution, count=6, seed=3):
    box = np.array(list(solution.parameters.values()))
    shares = np.random.default_rng(seed).random((count, len(box)))
    shares[:2] = [[0.0], [1.0]]  # two corners as well
    for point in box[:, 0] + shares * (box[:, 1] - box[:, 0]):
        yield dict(zip(solution.parameters, point, strict=True))


def apart(times, events, solution):
    """Whether times are not near an event that resets."""
    near = 1.01 * RTOL * solution.time[1]
    happened = np.concatenate([*events.values(), [-1.0]])
    return np.abs(times[:, None] - happened).min(axis=1) > near


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[pytest.mark.slow] * (n in ("ball", "late"))) for n in PROBLEMS],
)
def test_values_and_times_of_events(name):
    solution = solved(name)
    assert solution.success
    assert (solution.timeline.ending, solution.timeline.stretches) == ENDINGS[name]
    end = solution.time[1]
    sizes, worst = np.zeros(len(solution.unknowns)), np.zeros(len(solution.unknowns))
    for point in points(solution):
        trajectory = PROBLEMS[name].trajectory(np.linspace(0.0, end, 60), point)
        events = trajectory.events
        kept = apart(trajectory.t, events, solution)
        times, exact = trajectory.t[kept], trajectory.values[:, kept]
        found = solution(times, point)
        np.testing.assert_array_equal(np.isnan(found), np.isnan(exact))
        sizes = np.maximum(sizes, np.nanmax(np.abs(exact), axis=1))
        worst = np.maximum(worst, np.nanmax(np.abs(found - exact), axis=1))
        for event, instants in events.items():
            ours = solution.event_times(event, point)
            ours = ours[np.isfinite(ours)]
            assert ours.size == instants.size
            np.testing.assert_allclose(ours, instants, atol=RTOL * end)
    assert (worst <= 1.5 * RTOL * sizes).all()


def test_the_end_is_that_of_a_terminal_event_or_of_the_horizon():
    solution = solved("projectile")
    ends = solution.end(w=[15, 25], a=0.7, c=0.07)
    assert ends.shape == (2,)
    assert ends[1] == 2.5
    exact = PROBLEMS["projectile"].trajectory(2.5, w=15, a=0.7, c=0.07).events["ground"]
    np.testing.assert_allclose(ends[0], exact[0], rtol=1e-4)
    assert np.isnan(solution(2.4, w=15, a=0.7, c=0.07)).all()
    assert np.isnan(solution.event_times("ground", w=25, a=0.7, c=0.07)).all()
    assert solved("dose").end(k=0.3, lag=1.5, D=1.0) == 6.0


def test_values_at_an_instant_are_those_after_it():
    solution = solved("ball")
    point = {"h": 1.0, "c": 0.05, "e": 0.8}
    (first, *_) = solution.event_times("bounce", point)
    before, after = solution([first - 1e-6, first + 1e-6], point).T
    np.testing.assert_allclose(after[1], -0.8 * before[1], rtol=1e-4)


def test_values_at_an_instant_do_not_depend_on_how_it_is_asked_for():
    solution = solved("ball")
    rng = np.random.default_rng(5)
    box = {name: rng.uniform(*ends, 200) for name, ends in solution.parameters.items()}
    points = [dict(zip(box, row, strict=True)) for row in zip(*box.values(), strict=True)]
    together = solution.event_times("bounce", box)[0]
    alone = np.array([solution.event_times("bounce", point)[0] for point in points])
    for times in (together, alone, np.array([float(f"{time:.14g}") for time in together])):
        assert (solution["v"](times, box) > 0).all()
        assert all(
            solution["v"](time, point) > 0 for time, point in zip(times, points, strict=True)
        )
        assert (solution.gradient(times, box)[0, 0] < 0).all()  # from higher, it bounces later
        assert (solution["v"](times - 5e-12, box) < 0).all()


@pytest.mark.slow
def test_times_of_doses_are_met_to_the_last_digit():
    """Also those at a number, and where a parameter of them is fixed."""
    dosed = ro.Problem.from_strings(
        {"A": "-k*A", "B": "0"},
        {"A": 1, "B": 0},
        {"k": (0.3, 0.5), "lag": (0.5, 1.5), "span": (1.0, 1.7)},
        (0, 6),
        jumps={"lag": {"B": "B + 1"}, "lag + 2*span": {"B": "B + 1"}, 5: {"B": "B + 1"}},
    )
    rng = np.random.default_rng(4)
    for method in ("cross", "train"):
        solution = ro.solve(dosed, 1e-3, method=method)
        k, lag, span = (rng.uniform(*ends, 500) for ends in solution.parameters.values())
        doses = [lag, lag + 2 * span, np.full(500, 5.0)]
        for count, times in enumerate(doses):
            after = solution["B"](times, k=k, lag=lag, span=span)
            before = solution["B"](np.nextafter(times, 0.0), k=k, lag=lag, span=span)
            np.testing.assert_allclose(before, count, atol=1e-3)
            np.testing.assert_allclose(after, count + 1, atol=1e-3)
        assert (solution.event_times("jump_0", k=k, lag=lag, span=span) == lag).all()
        fixed = solution.fix(lag=0.7)["B"]
        assert fixed(np.nextafter(0.7, 0.0), k=0.4, span=1.2) < 0.5 < fixed(0.7, k=0.4, span=1.2)
        slopes = solution.gradient(lag + 0.1, k=k, lag=lag, span=span)[0]
        exact = np.stack([-(lag + 0.1) * np.exp(-k * (lag + 0.1)), 0 * k, 0 * k])
        np.testing.assert_allclose(slopes, exact, atol=0.02)


def test_broadcasting_and_grids_are_as_without_events():
    solution = solved("ball")
    times, heights = np.linspace(0, 1.6, 7), np.array([0.9, 1.0, 1.1])
    on_grid = solution.grid(t=times, h=heights, c=0.05, e=0.8)
    paired = solution(t=times[:, None], h=heights, c=0.05, e=0.8)
    np.testing.assert_allclose(on_grid[:, :, :, 0, 0], paired, atol=1e-12)
    one = solution["v"](t=times[3], h=heights[1], c=0.05, e=0.8)
    np.testing.assert_allclose(one, paired[1, 3, 1], atol=1e-12)
    assert solution.event_times("bounce", h=heights, c=0.05, e=[[0.8], [0.79]]).shape == (3, 2, 3)


def test_gradients_know_that_events_move():
    solution, point = solved("ball"), {"h": 1.0, "c": 0.05, "e": 0.8}
    for time in (0.3, 0.7, 1.2):
        for j, name in enumerate(point):
            step = 1e-5
            up, down = ({**point, name: point[name] + sign * step} for sign in (1, -1))
            slope = (solution(time, up) - solution(time, down)) / (2 * step)
            np.testing.assert_allclose(
                solution.gradient(time, point)[:, j], slope, rtol=1e-5, atol=1e-6
            )


def test_smaller_solutions_and_files(tmp_path):
    solution, point = solved("ball"), {"c": 0.05, "e": 0.8}
    whole = solution(t=1.0, h=1.1, **point)
    fixed = solution.fix(h=1.1)
    np.testing.assert_allclose(fixed(t=1.0, **point), whole, rtol=1e-12)
    np.testing.assert_allclose(
        fixed.event_times("bounce", point), solution.event_times("bounce", h=1.1, **point)
    )
    part = solution.restrict(h=(1.05, 1.15))
    np.testing.assert_allclose(part(t=1.0, h=1.1, **point), whole, rtol=1e-9)
    for kept in (
        ro.load(solution.save(tmp_path / "ball.npz")),
        ro.load(solution.save(tmp_path / "ball.nc")),
        pickle.loads(pickle.dumps(solution)),
    ):
        np.testing.assert_array_equal(kept(t=1.0, h=1.1, **point), whole)
        assert kept.timeline == solution.timeline
        assert kept.time_error == solution.time_error


def test_a_fit_finds_a_lag():
    """A dose and its lag are seen together alone, as a dose at a known time: the dose is fixed."""
    solution = solved("dose")
    truth, times = {"k": 0.3, "lag": 1.4, "D": 1.5}, np.linspace(0.25, 5.75, 23)
    noise = 0.01 * np.random.default_rng(1).normal(size=times.size)
    data = solution["A"](times, truth) + noise
    fit = solution.fit(times, data, sigma=0.01, fixed={"D": 1.5})
    assert fit.success
    for name in ("k", "lag"):
        low, high = fit.interval()[name]
        assert low <= truth[name] <= high


def test_statistics_are_those_of_samples():
    solution = solved("dose")
    sample = solution["A"](t=4.0, **solution.sample(100_000, seed=5))
    np.testing.assert_allclose(solution.mean(4.0), sample.mean(), atol=5e-3 * sample.std())
    np.testing.assert_allclose(solution.std(4.0), sample.std(), rtol=1e-2)
    np.testing.assert_allclose(
        solution.quantile(0.3, 4.0), np.quantile(sample, 0.3), atol=1e-2 * sample.std()
    )
    indices = solution.sobol([4.0])
    assert indices.total.sum() >= 0.95


@pytest.mark.slow
def test_statistics_are_those_without_events():
    """A marker changes nothing; statistics are from points then."""
    rhs = {"x": "p", "y": "q", "p": "-c*p", "q": "-9.81 - c*q"}
    initial = {"x": 0, "y": 0, "p": "w*cos(a)", "q": "w*sin(a)"}
    box = {"w": (15, 25), "a": (0.6, 0.9), "c": (0.05, 0.1)}
    marker = {"when": "t - 0.5", "direction": "rising", "name": "marker"}
    exact, marked = (
        ro.solve(problem(rhs, initial, box, 1.2, events), 1e-6) for events in ([], [marker])
    )
    spread = exact.std(1.0)
    np.testing.assert_allclose(marked.mean(1.0), exact.mean(1.0), atol=2e-3 * spread.min())
    np.testing.assert_allclose(marked.std(1.0), spread, rtol=2e-3)
    for order in ("skewness", "kurtosis"):
        theirs, ours = (getattr(solution, order)(1.0) for solution in (exact, marked))
        np.testing.assert_allclose(ours, theirs, atol=2e-2)
    theirs, ours = exact.sobol([1.0]), marked.sobol([1.0])
    for order in ("first", "total", "second"):
        np.testing.assert_allclose(getattr(ours, order), getattr(theirs, order), atol=2e-2)


def test_statistics_are_over_what_still_runs():
    with pytest.warns(ro.RankoneWarning, match="still running: .* % of the box"):
        mean = solved("projectile").mean(2.2)
    assert np.isfinite(mean).all()


@pytest.mark.filterwarnings("ignore::rankone.RankoneWarning")
def test_sobol_indices_are_there_while_all_run():
    """Parameters of those that still run are not independent."""
    indices = solved("projectile").sobol([1.0, 2.2])
    assert indices.total[..., 0].sum(axis=1).min() >= 0.95
    assert np.isnan(indices.total[..., 1]).all()


def test_what_does_not_take_events_says_so():
    with pytest.raises(ro.EvaluationError, match="to_canonical does not take solutions over"):
        solved("ball").to_canonical()


def test_events_of_another_name():
    with pytest.raises(ro.EvaluationError, match=r"no event `bounc` \(did you mean `bounce`"):
        solved("ball").event_times("bounc", h=1.0, c=0.05, e=0.8)
    for call in (lambda s: s.end(0.5, h=1.0), lambda s: s.end(t=0.5, h=1.0, c=0.05, e=0.8)):
        with pytest.raises(ro.EvaluationError, match="depend on the parameters alone"):
            call(solved("ball"))
    decay = ro.Problem.from_strings({"x": "-k*x"}, {"x": 1}, {"k": (1, 2)}, (0, 1))
    with pytest.raises(ro.EvaluationError, match="no events"):
        ro.solve(decay, 1e-3).event_times("bounce", k=1)


@pytest.mark.slow
def test_orders_that_differ_are_refused_where_an_event_is_put_off():
    events = [
        {"when": "t - a", "direction": "rising", "then": {"x": 1}, "name": "first", "delay": 0.1},
        {"when": "t - 1", "direction": "rising", "then": {"x": "x + k"}, "name": "second"},
    ]
    crossing = problem({"x": "-k*x"}, {"x": 1}, {"k": (1, 2), "a": (0.5, 1.5)}, 2, events)
    with pytest.raises(ro.ConvergenceError, match=r"same order everywhere: .*`the start of first`"):
        ro.solve(crossing, 1e-3)


@pytest.mark.slow
def test_events_that_accumulate_are_refused():
    ball = problem({"y": "v", "v": "-9.81"}, {"y": 1, "v": 0}, {"e": (0.4, 0.5)}, 2, [BOUNCE])
    with pytest.raises(ro.ConvergenceError, match="events accumulate"):
        ro.solve(ball, 1e-3)


@pytest.mark.slow
def test_accumulation_is_told_of_where_it_comes_first():
    """Behind the horizon bounces of the other trajectories accumulate as well."""
    bounce = {**BOUNCE, "then": {"y": 0, "v": "-0.7*v"}}
    ball = problem({"y": "v", "v": "-9.81"}, {"y": "h", "v": 0}, {"h": (0.3, 1.5)}, 2, [bounce])
    with pytest.raises(ro.ConvergenceError, match="events accumulate") as caught:
        ro.solve(ball, 1e-3, effort=0.2)
    time = float(str(caught.value).split("t = ")[1].split(" ")[0])
    assert time < 2


def test_methods_that_need_separated_terms_say_that_they_take_no_events_of_states():
    compiled = ro.compile(PROBLEMS["relay"])
    assert compiled.methods["cross"] is None
    with pytest.raises(ro.OptionError, match="'train' takes events at known times only"):
        compiled.solve(1e-3, method="train")


def test_a_budget_ends_a_solve_with_events():
    with limited(1e6):
        solution = ro.solve(PROBLEMS["relay"], 1e-6)
    assert not solution.success
    with pytest.raises(ro.EvaluationError, match="nothing was solved"):
        solution.event_times("on", k=1, m=4)
    with pytest.raises(ro.EvaluationError, match="nothing was solved"):
        solution.end(k=1, m=4)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["stack", "single"])
def test_integrators_agree(integrator):
    solution = ro.solve(PROBLEMS["relay"], RTOL, integrator=integrator)
    assert solution.success
    point = {"k": 1.05, "m": 4.03}
    np.testing.assert_allclose(solution(2.9, point), solved("relay")(2.9, point), atol=4 * RTOL)


def test_another_box_and_another_end():
    compiled = ro.compile(PROBLEMS["dose"])
    solution = compiled.solve(RTOL, parameters={"lag": (1.2, 1.4)}, t_final=2.5)
    assert solution.success
    point = {"k": 0.3, "lag": 1.3, "D": 1.5}
    np.testing.assert_allclose(
        solution(2.4, point), PROBLEMS["dose"].trajectory(2.4, point).values, rtol=2 * RTOL
    )


@pytest.mark.slow
def test_an_event_that_few_trajectories_meet_before_the_end():
    """The third spike comes before the end in a part of the box that no first trajectory sees."""
    rate = "2.5 - ((p - 0.37)/0.63)**2/2 - ((q - 0.59)/0.59)**2/2 - ((r - 0.41)/0.59)**2/2"
    spike = {"when": "x - 1", "direction": "rising", "then": {"x": 0}, "name": "spike"}
    box = dict.fromkeys("pqr", (0, 1))
    solution = ro.solve(problem({"x": rate}, {"x": 0}, box, 1.2121, [spike]), 1e-3)
    assert solution.success
    point = {"p": 0.37, "q": 0.59, "r": 0.41}
    times = solution.event_times("spike", point)
    np.testing.assert_allclose(times[np.isfinite(times)], [0.4, 0.8, 1.2], atol=1e-3)
    np.testing.assert_allclose(solution(1.21, point), 0.025, atol=2e-3)


def test_a_jump_that_triggers_a_marker():
    mark = {"when": "x - 0.8", "direction": "rising", "name": "mark"}
    dosed = problem({"x": "-p*x"}, {"x": 1}, {"p": (0.5, 1)}, 2, [mark], jumps={1: {"x": "x + 1"}})
    solution = ro.solve(dosed, RTOL)
    assert solution.success
    np.testing.assert_allclose(solution.event_times("mark", p=[0.6, 0.9]), [[1.0, 1.0]], rtol=1e-6)


def test_the_first_order_system_prints_its_events():
    text = repr(ro.compile(PROBLEMS["ball"]).first_order)
    assert text.splitlines()[-1] == "  bounce: where y falls through 0: y -> 0, v -> -e*v"


@pytest.mark.slow
def test_a_trajectory_that_blows_up_after_its_last_event_is_refused():
    start = {"when": "t - 0.5", "direction": "rising", "then": {"s": 1}, "name": "start"}
    runaway = problem({"x": "s*x**2", "s": "0"}, {"x": "k", "s": 0}, {"k": (0.5, 2)}, 1.2, [start])
    with pytest.raises(ro.ConvergenceError, match=r"a trajectory ends at t = .* at k = 2"):
        ro.solve(runaway, 1e-3)


@pytest.mark.slow
def test_a_blow_up_after_a_dose_is_named_with_its_own_time():
    """Others of the stack end there too, at times of their own."""
    start = {"k": (0.5, 1), "lag": (1, 2)}
    dose = {"lag": {"x": "x + k"}}
    runaway = ro.Problem.from_strings({"x": "x**2"}, {"x": 0.1}, start, (0, 6), jumps=dose)
    with pytest.raises(ro.ConvergenceError) as caught:
        ro.solve(runaway, 1e-3)
    said = re.search(r"ends at t = (\S+) at k = (\S+), lag = (\S+): it cannot", str(caught.value))
    when, k, lag = map(float, said.groups())
    assert when == pytest.approx(lag + 1 / (0.1 / (1 - 0.1 * lag) + k), rel=1e-3)


@pytest.mark.slow
def test_a_blow_up_behind_the_horizon_is_said_to_be_there():
    """Trajectories go on to events that others meet inside."""
    mark = {"when": "x - a", "direction": "rising", "then": {"y": "y"}, "name": "mark"}
    late = {"when": "y - 3*a", "direction": "rising", "name": "late"}
    rest = {"x": 0, "y": "b"}, {"a": (0.5, 3), "b": (0.3, 0.31)}, 2
    with pytest.raises(ro.ConvergenceError, match="a trajectory ends behind the horizon at a = "):
        ro.solve(problem({"x": "1", "y": "y**2"}, *rest, [mark, late]), 1e-3)


def test_a_dose_may_be_at_the_start():
    problem = ro.Problem.from_strings(
        {"A": "r - k*A", "r": "0"},
        {"A": 0, "r": 0},
        {"k": (0.5, 1), "lag": (0, 2)},
        (0, 5),
        jumps={"lag": {"A": "A + 1"}},
        events=[{"when": "t - lag", "direction": "rising", "then": {"r": 1}, "name": "start"}],
    )
    solution = ro.solve(problem, 1e-4)
    assert solution.success, solution.message
    for lag in (0.0, 1e-9, 0.7):
        times = np.array([lag, 2.5, 5.0])
        k, since = 0.8, times - lag
        exact = np.exp(-k * since) + (1 - np.exp(-k * since)) / k
        np.testing.assert_allclose(solution["A"](times, k=k, lag=lag), exact, rtol=1e-3)
        trajectory = problem.trajectory(times, k=k, lag=lag)
        np.testing.assert_allclose(trajectory["A"], exact, rtol=1e-6)
        assert trajectory.events["start"] == pytest.approx([lag])
    np.testing.assert_allclose(
        solution.event_times("start", k=0.8, lag=[0, 1]), [[0, 1]], atol=1e-4
    )


@pytest.mark.slow
def test_the_error_at_equal_shares_of_a_stretch():
    solution, worst = solved("ball"), 0.0
    for point in points(solution):
        instants = PROBLEMS["ball"].trajectory(1.6, point).events["bounce"][:2]
        ours = solution.event_times("bounce", point)[:2]
        shares = np.linspace(0.05, 0.95, 10)
        times, at = (a + shares * (b - a) for a, b in (instants, ours))
        exact = PROBLEMS["ball"].trajectory(times, point).values
        missed = np.abs(solution(at, point) - exact).max(axis=1)
        worst = max(worst, (missed / np.abs(exact).max(axis=1)).max())
    assert worst <= 3.0 * solution.share_error < 3.0 * RTOL
    assert np.isnan(solution.at(0.3).share_error)


def test_an_event_where_a_rate_of_first_order_crosses_zero():
    driven = ro.Problem.from_strings(
        {"x": "-k*x + cos(t)"},
        {"x": 2},
        {"k": (0.5, 1)},
        (0, 6),
    )
    t = driven.time[0]
    (x,) = driven.unknowns
    marked = type(driven)(**{**driven.written, "events": [ro.Event(x.diff(t), name="turn")]})
    solution = ro.solve(marked, 1e-5)
    assert solution.success
    for k in (0.55, 0.9):
        turns = solution.event_times("turn", k=k)
        turns = turns[np.isfinite(turns)]
        np.testing.assert_allclose(k * solution[x](t=turns, k=k), np.cos(turns), atol=1e-4)
        np.testing.assert_allclose(marked.trajectory(6.0, k=k).events["turn"], turns, atol=1e-4)
