"""Solutions with events that part of the box misses by grazing, against closed forms."""

import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import rankone as ro
from rankone.solution.outputs.output_check import CheckPoints
from rankone.solvers.attempts import Stages
from rankone.solvers.branches import order_search, solve_in_branches
from rankone.solvers.branching import branches_of
from rankone.solvers.request import SolveArguments, SolveRequest
from rankone.solvers.selection import ENGINES
from rankone.solvers.stretches_by_markers import timed_system
from rankone.support.budget import limited, work_done
from rankone.trajectories.events.forced import ContinuationError
from rankone.trajectories.events.openings import ContinuedOrder, opened_after
from rankone.trajectories.events.orders import OrderSearch
from rankone.trajectories.events.sides import OrderError
from rankone.trajectories.events.stretches import in_stretches
from rankone.trajectories.system.features import Beginning, ForcedOrder

pytestmark = pytest.mark.slow
RTOL = 1e-4
END = 4.0


def problem(rates, start, box, end, *events):
    return ro.Problem.from_strings(rates, start, box, (0, end), events=[*events])


KICK = {"when": "x - c", "direction": "rising", "then": {"v": "-v"}, "name": "kick"}
KICKED = problem(
    {"x": "v", "v": "-x"}, {"x": 0, "v": "a"}, {"a": (0.7, 1.4), "c": (0.9, 1.1)}, END, KICK
)


@cache
def kicked():
    return ro.solve(KICKED, RTOL)


def searched(problem):
    """The orders of the events of a problem."""
    compiled = ro.compile(problem)
    system = compiled._held or compiled.system
    request = SolveRequest.of(system, [], {}, SolveArguments(rtol=RTOL))
    timed, _ = timed_system(system, request.domain)
    return order_search(timed, request)


def exact(times, a, c):
    """The swing up to c, where it is thrown back once; below c it is never."""
    ratio = np.minimum(c / a, 1.0)
    at = np.where(c < a, np.arcsin(ratio), np.inf)
    back = np.sqrt(np.maximum(a**2 - c**2, 0.0))
    elapsed = np.where(times >= at, times - np.where(np.isfinite(at), at, 0.0), 0.0)
    return np.where(times >= at, c * np.cos(elapsed) - back * np.sin(elapsed), a * np.sin(times))


def sample(count, seed):
    rng = np.random.default_rng(seed)
    return {"a": rng.uniform(0.7, 1.4, count), "c": rng.uniform(0.9, 1.1, count)}


def quietly(solution, times, at):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ro.RankoneWarning)
        return solution["x"](times, **at)


def test_an_event_that_part_of_the_box_misses_is_opened_at_the_root_of_its_height():
    solution, at = kicked(), sample(4000, 1)
    assert solution.success
    assert len(solution.timeline.branches) == 2
    times = np.linspace(0.0, END, 15)[:, None]
    values = quietly(solution, times, at)
    undecided = np.isnan(values).any(axis=0)
    assert undecided.mean() <= 0.01
    assert np.abs(at["a"] - at["c"])[undecided].max(initial=0.0) < 0.01  # the sliver alone
    error = np.abs(values - exact(times, **at))[:, ~undecided]
    assert error.max() <= 3.0 * RTOL * 1.4
    held = solution.branch(**at)
    np.testing.assert_array_equal(held[held >= 0], (at["a"] > at["c"])[held >= 0])
    assert (held[undecided] == -1).all()
    assert (held == -1).mean() <= 0.01
    np.testing.assert_array_equal(solution.at(2.0).branch(**at), held)
    met = solution.event_times("kick", **at)[0]
    clear = np.abs(at["a"] - at["c"]) > 0.01
    assert (np.isfinite(met) == (at["a"] > at["c"]))[clear].all()
    late = met - np.arcsin(np.minimum(at["c"] / at["a"], 1.0))
    assert np.nanmax(np.abs(late)) <= 3.0 * RTOL * END


def test_a_window_of_one_parameter_in_which_an_event_comes_a_swing_later():
    """Swings grow, and the first one misses the hill of the surface: no false times beside."""
    end, edge = 8.2, 0.05

    def slope(t):
        return 0.3 * np.sin(t) + (1 + 0.3 * t) * np.cos(t)

    start, top, low, last = 0.0, *(brentq(slope, t - 0.5, t + 0.5) for t in (1.8, 4.8, 7.9))
    height = float((1 + 0.3 * top) * np.sin(top))
    hill = f"{height!r} + 0.05*(2*exp(-log(2)*((a - 0.4)/{edge})**2) - 1)"
    hit = {"when": f"x - ({hill})", "direction": "rising", "then": {"y": "y + 1"}, "name": "hit"}
    rates = {"x": "0.3*sin(t) + (1 + 0.3*t)*cos(t)", "y": "-y/2"}
    solution = ro.solve(problem(rates, {"x": 0, "y": 1}, {"a": (0, 1)}, end, hit), RTOL)
    assert solution.success
    assert len(solution.timeline.branches) == 2

    def above(t, a):
        return (
            (1 + 0.3 * t) * np.sin(t) - height - 0.05 * (2 * 0.5 ** (((a - 0.4) / edge) ** 2) - 1)
        )

    def exact(a):
        swings = [(s, t) for s, t in ((start, top), (low, last)) if above(t, a) > 0.0]
        hits = [brentq(above, *swing, args=(a,)) for swing in swings]
        return np.exp(-end / 2) + sum(np.exp((hit - end) / 2) for hit in hits)

    distances = np.outer([-1, 1], [1e-7, 1e-6, 1e-5, 1e-4, 3e-3, 1e-2]).ravel()
    a = np.concatenate([0.4 - edge + distances, 0.4 + edge + distances, np.linspace(0, 1, 41)])
    with pytest.warns(ro.RankoneWarning, match="undecided"):
        values = solution["y"](end, a=a)
    decided = ~np.isnan(values)
    assert decided.mean() > 0.7
    expected = np.array([exact(each) for each in a[decided]])
    assert values[decided] == pytest.approx(expected, abs=3 * RTOL)


def test_an_opened_branch_is_stored_fixed_and_restricted(tmp_path):
    solution, at = kicked(), sample(200, 2)
    values = quietly(solution, 3.0, at)
    loaded = ro.load(solution.save(tmp_path / "kicked.npz"))
    assert np.array_equal(quietly(loaded, 3.0, at), values, equal_nan=True)
    assert loaded.timeline == solution.timeline
    a = {"a": at["a"]}
    there = quietly(solution, 3.0, {**a, "c": 1.0})
    assert quietly(solution.fix(c=1.0), 3.0, a) == pytest.approx(there, abs=1e-13, nan_ok=True)
    part = solution.restrict(a=(0.8, 1.3))
    inside = {"a": np.clip(at["a"], 0.8, 1.3), "c": at["c"]}
    assert quietly(part, 3.0, inside) == pytest.approx(
        quietly(solution, 3.0, inside), abs=1e-13, nan_ok=True
    )
    assert len(solution.nodes) == 2


def test_a_file_whose_openings_do_not_fit_is_refused(tmp_path):
    solution = kicked()
    timeline = solution.timeline
    (opening,) = timeline.openings
    for wrong in (
        replace(opening, parent=1),
        replace(opening, guard=3),
        replace(opening, upper=0.0),
    ):
        outcome = replace(solution.outcome, timeline=replace(timeline, openings=(wrong,)))
        other = type(solution)(outcome, solution.metadata)
        with pytest.raises(ro.StorageError):
            ro.load(other.save(tmp_path / "wrong.npz", overwrite=True))


def test_gradients_of_an_opened_branch_are_those_of_its_values():
    solution, step = kicked(), 1e-5
    for a, c in ((1.3, 1.0), (1.2, 0.95), (0.8, 1.05)):
        slopes = solution.gradient(3.0, a=a, c=c)[0]
        for j, (one, other) in enumerate(
            (((a - step, c), (a + step, c)), ((a, c - step), (a, c + step)))
        ):
            apart = [solution["x"](3.0, a=p, c=q) for p, q in (one, other)]
            assert slopes[j] == pytest.approx((apart[1] - apart[0]) / (2.0 * step), abs=1e-4)


def test_statistics_and_outputs_go_across_an_opened_branch():
    solution = kicked()
    rng = np.random.default_rng(3)
    at = {"a": rng.uniform(0.7, 1.4, 200_000), "c": rng.uniform(0.9, 1.1, 200_000)}
    values = exact(3.0, **at)
    near = 5.0 * values.std() / np.sqrt(values.size)
    assert solution.mean(3.0)[0] == pytest.approx(values.mean(), abs=near)
    assert solution.std(3.0)[0] == pytest.approx(values.std(), abs=near)
    area = solution.output({"area": "integral(x, 0, 4)"})
    assert area.success
    few = sample(300, 4)
    times = np.linspace(0.0, END, 4001)
    there = np.trapezoid(exact(times[:, None], **few), times, axis=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ro.RankoneWarning)
        ours = area(**few)[0]
    assert np.isnan(ours).mean() <= 0.02
    assert np.nanmax(np.abs(ours - there)) <= 3.0 * area.rtol * np.abs(there).max()


def test_a_switch_that_part_of_the_box_does_not_reach():
    """A rate that jumps while a given swing is above a level."""
    rates = {"z": "1", "x": "a*cos(z)", "y": "-y + Heaviside(x - c)"}
    switched = problem(rates, {"z": 0, "x": 0, "y": 0}, {"a": (0.7, 1.4), "c": (0.9, 1.1)}, END)
    solution, at = ro.solve(switched, RTOL), sample(2000, 5)
    assert solution.success
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ro.RankoneWarning)
        values = solution["y"](END, **at)
    first = np.arcsin(np.minimum(at["c"] / at["a"], 1.0))
    above = np.exp(-(END - (np.pi - first))) - np.exp(-(END - first))
    there = np.where(at["a"] > at["c"], above, 0.0)
    assert np.isnan(values).mean() <= 0.01
    assert np.nanmax(np.abs(values - there)) <= 5.0 * RTOL * 0.7


BELT = problem(
    {"x": "v", "v": "-x - mu*sign(v - 0.5) - 0.1*v"},
    {"x": "a", "v": 0},
    {"a": (0.6, 1.4), "mu": (0.3, 0.5)},
    5.0,
)


VALVE = problem(
    {"h": "(0.04*Max(0, Min(1, K*(r - h))) - 0.02*sqrt(h))/0.5"},
    {"h": 0.2},
    {"K": (2.0, 8.0), "r": (0.5, 1.2)},
    60.0,
)


def test_a_start_beyond_a_limit_is_left_wherever_it_is_moved_to():
    """At a corner the tank would have been empty when the valve left its limit."""
    parted = branches_of(searched(VALVE), RTOL)
    (beyond,) = [branch for branch in parted.branches if branch.opened.turns]
    assert isinstance(beyond.opened.turns[0], Beginning)
    lower, upper = beyond.opened.root_bounds[0]
    ends = np.array([[2.0, 0.5, upper], [2.0, 0.5, lower], [8.0, 1.2, upper], [8.0, 1.2, lower]])
    times = searched(VALVE).forced(beyond.order, beyond.forced, ends).borders[:, 1]
    assert (times[::2] > 0.0).all()
    np.testing.assert_array_equal(times[1::2], 0.0)


@pytest.mark.slow
def test_a_valve_that_starts_beyond_its_limit_in_a_part_of_the_box():
    solution = ro.solve(VALVE, RTOL)
    assert solution.success
    times = np.linspace(0.0, 60.0, 40)
    rng = np.random.default_rng(9)
    for gain, goal in zip(rng.uniform(2.0, 8.0, 6), rng.uniform(0.5, 1.2, 6), strict=True):
        run = solve_ivp(
            lambda t, h, K=gain, r=goal: 0.08 * np.clip(K * (r - h), 0, 1) - 0.04 * np.sqrt(h),
            (0, 60),
            [0.2],
            "Radau",
            times,
            rtol=1e-9,
            atol=1e-11,
        )
        np.testing.assert_allclose(solution["h"](t=times, K=gain, r=goal), run.y[0], atol=3 * RTOL)


WOUND_BACK = ro.Problem.from_strings(
    {"w": "(10*u - w)/0.2", "q": "r - w + (u - v)/Kp"},
    {"w": 0, "q": 0},
    {"Kp": (0.1, 0.3), "r": (60, 100)},
    (0, 2),
    definitions={"v": "Kp*(r - w) + 1.5*q", "u": "Max(-12, Min(12, v))"},
)


def test_what_fails_inside_the_box_is_not_tried_again_without_its_corners(monkeypatch):
    search, tried, continued = searched(WOUND_BACK), [], OrderSearch.continued

    def recorded(search, order, places, opened=None):
        tried.append((order, opened is None))
        return continued(search, order, places, opened)

    monkeypatch.setattr(OrderSearch, "continued", recorded)
    with pytest.raises(OrderError):
        branches_of(search, RTOL)
    assert len(tried) == len(set(tried))


def test_what_fails_at_corners_alone_is_continued_without_them(monkeypatch):
    search, forced = searched(KICKED), OrderSearch.forced
    corners = search.to_corners.further

    def failing(search, order, forced_order, points):
        error = ContinuationError("a corner")
        error.fails = (points[:, None, :2] == corners).all(axis=2).any(axis=1)
        if error.fails.any():
            raise error
        return forced(search, order, forced_order, points)

    monkeypatch.setattr(OrderSearch, "forced", failing)
    assert len(branches_of(search, RTOL).branches) == 2


def test_a_slip_that_has_just_begun_is_no_further_stick():
    """One of the slips begins two thousandths before the end."""
    instants = [instant for order in searched(BELT).orders for instant in order.met]
    assert {len(instant) for instant in instants} == {1}


def test_orders_behind_one_turn_are_all_opened_there():
    """On a belt a mass sticks, or overtakes it first: in 2 % of the box, or never reaches it."""
    solution = ro.solve(BELT, RTOL)
    assert solution.success
    assert len(solution.timeline.branches) == 4
    assert len({(o.parent, o.guard) for o in solution.timeline.openings}) == 1
    rng = np.random.default_rng(12)
    at = {"a": rng.uniform(0.6, 1.4, 300), "mu": rng.uniform(0.3, 0.5, 300)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ro.RankoneWarning)
        values, held = solution(5.0, **at), solution.branch(**at)
    assert set(held) >= {0, 1, 2, 3}
    for k in [*np.flatnonzero(held == 3), *range(8)]:
        if np.isnan(values[:, k]).any():
            continue
        a, mu = at["a"][k], at["mu"][k]
        run = solve_ivp(
            lambda t, u, mu=mu: [u[1], -u[0] - mu * np.tanh((u[1] - 0.5) / 1e-7) - 0.1 * u[1]],
            (0, 5),
            [a, 0],
            "Radau",
            rtol=1e-8,
            atol=1e-10,
        )
        assert np.abs(values[:, k] - run.y[:, -1]).max() <= 3 * RTOL


def test_opened_trajectories_are_true_where_the_root_is_that_of_the_height():
    """Where it is not, the surface is moved: both crossings depend smoothly on the root."""
    compiled = ro.compile(KICKED)
    request = SolveRequest.of(compiled.system, [], {}, SolveArguments(rtol=RTOL))
    timed, _ = timed_system(compiled.system, request.domain)
    search = order_search(timed, request)
    (kick, places), (free, elsewhere) = search.groups().items()
    parent = ContinuedOrder(free, search.continued(free, elsewhere), search.unopened)
    opened = opened_after(search, parent, kick, places, 0)
    assert opened is not None
    forced = search.continued(kick, places, opened)
    assert isinstance(forced, ForcedOrder)
    names = in_stretches(kick.clock(timed, search.horizon, forced)).parameters
    assert names == ("a", "c", "turn past kick")
    a, c = 1.2, 1.0
    for moved in (0.0, 0.05, -0.15):  # the height is a - c, of a rise by a, and that is moved
        root = np.sqrt((a - c + moved) / a)
        times = search.forced(kick, forced, np.array([[a, c, root]])).borders[0, 1]
        assert times == pytest.approx(np.arcsin((c - moved) / a), abs=1e-6)


def test_an_event_next_to_no_turn_of_the_others_is_refused():
    """Trajectories that start beyond the level never turn next to it."""
    event = {"when": "x - c", "direction": "falling", "then": {"x": "x - 1"}, "name": "drop"}
    box = {"c": (0.8, 1.2), "k": (0.1, 0.3)}
    with pytest.raises(ro.ConvergenceError, match="`drop`"):
        ro.solve(problem({"x": "-k*t*x"}, {"x": 1}, box, 3, event), RTOL, effort=0.3)


def test_the_surface_is_moved_no_further_than_to_where_trajectories_start():
    """A latch of three parameters: with one interval of heights for all, some are out of reach."""
    latch = {"when": "x - c", "direction": "rising", "then": {"s": "1"}, "name": "latch"}
    rates, start = {"x": "1 + a*sin(t) - k*x", "y": "s - y", "s": "0"}, {"x": 0.5, "y": 0, "s": 0}
    box = {"a": (0.5, 1.5), "c": (1.4, 1.9), "k": (0.8, 1.2)}
    solution = ro.solve(problem(rates, start, box, 6, latch), RTOL)
    assert solution.success
    rng = np.random.default_rng(6)
    at = {name: rng.uniform(*ends, 1000) for name, ends in box.items()}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ro.RankoneWarning)
        values = solution["y"](6.0, **at)
    a, c, k = at.values()
    times = np.linspace(0.0, 6.0, 12001)[:, None]
    swing = a * (k * np.sin(times) - np.cos(times)) / (1.0 + k**2)
    level = 1.0 / k + swing + (0.5 - 1.0 / k + a / (1.0 + k**2)) * np.exp(-k * times) - c
    met, columns = (level > 0.0).argmax(axis=0), np.arange(c.size)
    before, after = level[met - 1, columns], level[met, columns]
    latched = times[met, 0] - (times[1, 0]) * after / (after - before)
    there = np.where(met > 0, 1.0 - np.exp(latched - 6.0), 0.0)
    undecided = np.isnan(values)
    assert undecided.mean() <= 0.01
    assert np.abs(values - there)[~undecided].max() <= 5.0 * RTOL


D = 1.0
UP = {"when": "x - c", "direction": "rising", "then": {"v": "0.8*v"}, "name": "up"}
DOWN = {"when": "x + 1", "direction": "falling", "then": {"v": "0.8*v"}, "name": "down"}


@cache
def braked():
    box = {"a": (0.8, 1.5), "c": (0.9, 1.1)}
    return ro.solve(problem({"x": "v", "v": "-x"}, {"x": 0, "v": "a"}, box, 5.5, UP, DOWN), RTOL)


def exact_swing(times, a, c):
    """A swing that is braked at c and at -D where it comes there, and the times of both."""

    def behind(size, level, begin, shift):
        """Size and shift of the swing behind a level, and when that is."""
        back = np.sqrt(np.maximum(size**2 - level**2, 0.0))
        time = begin + np.arcsin(np.minimum(level / size, 1.0)) - shift
        other = begin + np.arctan2(level, 0.8 * back) - time
        met = size > level
        return (
            np.where(met, np.hypot(level, 0.8 * back), size),
            np.where(met, other, shift),
            np.where(met, time, np.inf),
        )

    size, shift, up = behind(a, c, 0.0, 0.0)
    last_size, last_shift, down = behind(size, D, np.pi, shift)
    swing = np.where(times >= up, size * np.sin(times + shift), a * np.sin(times))
    swing = np.where(times >= down, last_size * np.sin(times + last_shift), swing)
    return swing, up, down


def test_an_event_behind_an_opened_one_is_opened_too():
    """The brake at the left is missed behind the one at the right, or without it."""
    solution = braked()
    assert solution.success
    assert {branch.instants for branch in solution.timeline.branches} == {
        (),
        (("up",),),
        (("down",),),
        (("up",), ("down",)),
    }
    rng = np.random.default_rng(7)
    at = {"a": rng.uniform(0.8, 1.5, 2000), "c": rng.uniform(0.9, 1.1, 2000)}
    times = np.linspace(0.0, 5.5, 12)[:, None]
    values, (there, up, down) = quietly(solution, times, at), exact_swing(times, **at)
    undecided = np.isnan(values).any(axis=0)
    assert undecided.mean() <= 0.01
    assert np.abs(values - there)[:, ~undecided].max() <= 3.0 * RTOL * 1.5
    for name, exactly in (("up", up), ("down", down)):
        met = solution.event_times(name, **at)[0]
        assert (np.isfinite(met) == np.isfinite(exactly))[~undecided].mean() >= 0.99
        both = np.isfinite(met) & np.isfinite(exactly)
        assert np.abs(met - exactly)[both].max() <= 3.0 * RTOL * 5.5


def test_a_branch_of_two_opened_events_is_used_everywhere(tmp_path):
    solution, step = braked(), 1e-5
    rng = np.random.default_rng(8)
    at = {"a": rng.uniform(0.8, 1.5, 200), "c": rng.uniform(0.9, 1.1, 200)}
    values = quietly(solution, 5.0, at)
    loaded = ro.load(solution.save(tmp_path / "braked.npz"))
    assert np.array_equal(quietly(loaded, 5.0, at), values, equal_nan=True)
    assert loaded.timeline == solution.timeline
    a = {"a": at["a"]}
    fixed = quietly(solution.fix(c=1.0), 5.0, a)
    there = quietly(solution, 5.0, {**a, "c": 1.0})
    assert fixed == pytest.approx(there, abs=1e-13, nan_ok=True)
    for here in ({"a": 1.35, "c": 1.0}, {"a": 1.05, "c": 1.098}, {"a": 0.9, "c": 1.0}):
        slopes = solution.gradient(5.0, **here)[0]
        for j, name in enumerate(here):
            apart = [solution["x"](5.0, **{**here, name: here[name] + e}) for e in (-step, step)]
            assert slopes[j] == pytest.approx((apart[1] - apart[0]) / (2.0 * step), abs=1e-3)
    many = {"a": rng.uniform(0.8, 1.5, 200_000), "c": rng.uniform(0.9, 1.1, 200_000)}
    exactly = exact_swing(5.0, **many)[0]
    near = 5.0 * exactly.std() / np.sqrt(exactly.size)
    assert solution.mean(5.0)[0] == pytest.approx(exactly.mean(), abs=near)
    at_once = solution.at(5.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ro.RankoneWarning)
        assert np.nanmax(np.abs(at_once["x"](**at) - exact_swing(5.0, **at)[0])) <= 5.0 * RTOL * 1.5
    area = solution.output({"area": "integral(x, 0, 5.5)"})
    assert area.success
    times = np.linspace(0.0, 5.5, 5501)
    there = np.trapezoid(exact_swing(times[:, None], **at)[0], times, axis=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ro.RankoneWarning)
        ours = area(**at)[0]
    assert np.isnan(ours).mean() <= 0.02
    assert np.nanmax(np.abs(ours - there)) <= 3.0 * area.rtol * np.abs(there).max()


def test_checks_of_a_branch_that_holds_nowhere_are_everywhere():
    """Such a branch only leads to another one, with one more event."""
    whole = CheckPoints(1, np.zeros((3, 2)), np.ones((2, 2)))
    nowhere = whole.where(lambda points: np.zeros(len(points), dtype=bool))
    assert nowhere is whole
    zeros = whole.where(lambda points: points[:, 0] == 0.0)
    assert zeros is whole  # no further points would be left
    held = whole.where(lambda points: np.arange(len(points)) > 0)
    assert (held.corners, len(held.aimed), len(held.further)) == (0, 2, 1)


def struck(force, start, back, wall, end):
    """x at the end, and the times of hits at a wall that throws it back."""
    now, state, hits = 0.0, start, []

    def at_wall(_, z):
        return z[0] - wall

    at_wall.terminal, at_wall.direction = True, 1.0
    while now < end:
        path = solve_ivp(
            lambda t, z: (z[1], force(t) - 0.3 * z[1] - z[0]),
            (now, end),
            state,
            "DOP853",
            events=at_wall,
            rtol=1e-9,
            atol=1e-11,
            max_step=0.05,
        )
        now, state = path.t[-1], path.y[:, -1]
        if path.status == 1:
            hits.append(now)
            state = np.array([wall, -back * state[1]])
    return state[0], hits


def missed_by(solution, exactly, at, end):
    """Largest error of x at the end, the share without value, and whether hits are as many."""
    values, met = quietly(solution, end, at), solution.event_times("hit", **at)
    errors = values - np.array([x for x, _ in exactly])
    counts = np.isfinite(met).sum(axis=0) == [len(hits) for _, hits in exactly]
    return np.nanmax(np.abs(errors)), np.isnan(errors).mean(), counts.mean()


def test_a_second_hit_that_is_missed_starts_at_the_wall_itself():
    """Its height is relative to the rise from the lowest place behind the first hit."""
    hit = {"when": "x - w", "direction": "rising", "then": {"v": "-0.9*v"}, "name": "hit"}
    box = {"a": (0.9, 1.5), "w": (0.42, 0.55)}
    wall = problem({"x": "v", "v": "-0.3*v - x"}, {"x": 0, "v": "a"}, box, 6, hit)
    solution = ro.solve(wall, RTOL)
    assert solution.success
    assert [len(branch.instants) for branch in solution.timeline.branches] == [1, 2]
    rng = np.random.default_rng(9)
    at = {name: rng.uniform(*ends, 50) for name, ends in box.items()}
    exactly = [struck(lambda _: 0.0, (0, a), 0.9, w, 6) for a, w in zip(*at.values(), strict=True)]
    assert {len(hits) for _, hits in exactly} == {1, 2}
    error, undecided, alike = missed_by(solution, exactly, at, 6.0)
    assert error <= 3.0 * RTOL
    assert undecided <= 0.02
    assert alike >= 0.98


def test_a_wall_that_is_missed_at_first_is_met_a_swing_later():
    """All hit the wall, so that the first hit alone does not tell who missed it before."""
    hit = {"when": "x - w", "direction": "rising", "then": {"v": "-0.7*v"}, "name": "hit"}
    box = {"d": (0.5, 1.0), "w": (0.4, 0.7)}
    wall = problem({"x": "v", "v": "d*cos(1.3*t) - 0.3*v - x"}, {"x": 0, "v": 0}, box, 9, hit)
    solution = ro.solve(wall, RTOL)
    assert solution.success
    rng = np.random.default_rng(10)
    at = {name: rng.uniform(*ends, 50) for name, ends in box.items()}
    exactly = [
        struck(lambda t, d=d: d * np.cos(1.3 * t), (0, 0), 0.7, w, 9)
        for d, w in zip(*at.values(), strict=True)
    ]
    first = np.array([hits[0] for _, hits in exactly])
    assert (first < 2.0).any()
    assert (first > 5.0).any()
    error, undecided, alike = missed_by(solution, exactly, at, 9.0)
    assert error <= 3.0 * RTOL * 1.5
    assert undecided <= 0.02
    assert alike >= 0.98
    compiled = ro.compile(wall)
    request = SolveRequest.of(compiled.system, [], {}, SolveArguments(rtol=RTOL))
    search = order_search(timed_system(compiled.system, request.domain)[0], request)
    search = search.telling_roots
    roots = {order.roots[0] for order in search.orders}
    assert roots == {0, 1}
    for order, places in search.groups().items():
        length = search.lengths(order, places)[:, 0]
        assert (length > 5.0).all() if order.roots[0] else (length < 2.0).all()


def test_a_budget_that_ends_before_branches_are_solved_is_said_to():
    """And not that a parameter is steep: the event is named, and that more effort helps."""
    hit = {"when": "x - w", "direction": "rising", "then": {"v": "-0.7*v"}, "name": "hit"}
    box = {"d": (0.5, 1.0), "w": (0.4, 0.7)}
    wall = problem({"x": "v", "v": "d*cos(1.3*t) - 0.3*v - x"}, {"x": 0, "v": 0}, box, 9, hit)
    solution = ro.solve(wall, RTOL, effort=0.07)
    assert solution.status is ro.Status.WORK_LIMIT
    assert "`hit`" in solution.message
    assert "raise effort, or narrow " in solution.message
    assert solution.message.count(ro.Status.WORK_LIMIT.value) == 1
    assert "4.0e-05" not in solution.message  # the tolerance of branches is not that of the user


def test_a_search_for_orders_that_ends_without_success_counts():
    """Trajectories that start beyond the level never turn next to it."""
    event = {"when": "x - c", "direction": "falling", "then": {"x": "x - 1"}, "name": "drop"}
    drop = problem({"x": "-k*t*x"}, {"x": 1}, {"c": (0.8, 1.2), "k": (0.1, 0.3)}, 3, event)
    system, engine, stages = ro.compile(drop).system, ENGINES["cross"], Stages()
    request = SolveRequest.of(system, [], {}, SolveArguments(rtol=RTOL))
    with limited(1e12):
        with pytest.raises(OrderError, match="`drop`"):
            solve_in_branches(engine.run, system, request, "orders differ", stages)
        spent = work_done()
    assert sum(stages.work.values()) == pytest.approx(spent, rel=0.05)
