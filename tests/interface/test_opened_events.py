"""Solutions with events that part of the box misses by grazing, against closed forms."""

import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import rankone as ro
from rankone.ir.events import ForcedOrder
from rankone.ir.request import SolveRequest
from rankone.solvers.attempts import Stages
from rankone.solvers.branches import order_search, solve_in_branches
from rankone.solvers.registry import ENGINES
from rankone.solvers.stretches import timed_system
from rankone.support.budget import limited, work_done
from rankone.trajectories.events.event_order import OrderError
from rankone.trajectories.events.openings import ContinuedOrder, opened_after

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
    met = solution.event_times("kick", **at)[0]
    clear = np.abs(at["a"] - at["c"]) > 0.01
    assert (np.isfinite(met) == (at["a"] > at["c"]))[clear].all()
    late = met - np.arcsin(np.minimum(at["c"] / at["a"], 1.0))
    assert np.nanmax(np.abs(late)) <= 3.0 * RTOL * END


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


def test_opened_trajectories_are_true_where_the_root_is_that_of_the_height():
    """Where it is not, the surface is moved: both crossings depend smoothly on the root."""
    compiled = ro.compile(KICKED)
    request = SolveRequest.of(compiled.system, [], {}, rtol=RTOL)
    timed, _ = timed_system(compiled.system, request.domain)
    search = order_search(timed, request)
    (kick, places), (free, elsewhere) = search.groups().items()
    parent = ContinuedOrder(free, search.continued(free, elsewhere), search.unopened)
    opened = opened_after(search, parent, kick, places, 0)
    assert opened is not None
    forced = search.continued(kick, places, opened)
    assert isinstance(forced, ForcedOrder)
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


def test_a_search_for_orders_that_ends_without_success_counts():
    """The second hit starts at the wall, so that no order with it is opened."""
    rates = {"x": "v", "v": "d*cos(1.3*t) - 0.3*v - x"}
    hit = {"when": "x - w", "direction": "rising", "then": {"v": "-0.7*v"}, "name": "hit"}
    wall = problem(rates, {"x": 0, "v": 0}, {"d": (0.5, 1), "w": (0.4, 0.7)}, 9, hit)
    system, engine, stages = ro.compile(wall).system, ENGINES["cross"], Stages()
    request = SolveRequest.of(system, [], {}, rtol=RTOL)
    with limited(1e12):
        with pytest.raises(OrderError, match="`hit`"):
            solve_in_branches(engine.run, system, request, OrderError("orders differ"), stages)
        spent = work_done()
    assert sum(stages.work.values()) == pytest.approx(spent, rel=0.05)
