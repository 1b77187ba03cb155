"""Solutions in which the order of events changes inside the box, against closed forms."""

import importlib.util
import itertools
import warnings
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import quad, solve_ivp
from scipy.special import ndtr, ndtri

import rankone as ro
from rankone.share.commands.common import summary
from rankone.solution.statistics import composite_statistics
from rankone.solution.statistics.lines import Accuracy
from rankone.solvers.branches import box_of_branch, branch_evaluator, order_search
from rankone.solvers.request import Domain, SolveArguments, SolveRequest
from rankone.solvers.selection import ENGINES
from rankone.solvers.stretches_by_markers import timed_system
from rankone.solvers.verification.measure import points_with_other_events
from rankone.solvers.verification.points import Coverage
from rankone.support.budget import limited, work_done
from rankone.trajectories.system.features import SystemEvent
from rankone.trajectories.system.timeline import BranchedTimeline
from rankone.trajectories.system.verdict import Status

RTOL = 1e-4
END = 6.0
POINT = {"a": 2.0, "b": 2.5, "k": 0.4}
SWAPPED = {"a": 2.0, "b": 1.7, "k": 0.4}


def text(rates, initial, box, end, *events):
    return ro.Problem.from_strings(rates, initial, box, (0, end), events=[*events])


DOSE = {"when": "t - a", "direction": "rising", "then": {"x": "x + 1"}, "name": "dose"}
WASH = {"when": "t - b", "direction": "rising", "then": {"x": "x/2"}, "name": "wash"}
WASHED = text(
    {"x": "-k*x"},
    {"x": 1},
    {"a": (1, 3), "b": (1.5, 3.5), "k": (0.3, 0.5)},
    END,
    DOSE,
    WASH,
)


@cache
def washed():
    return ro.solve(WASHED, RTOL)


@pytest.fixture(scope="module")
def washed_in_pieces():
    """In one of the two pieces events come in one order alone."""
    return ro.solve_many(WASHED, WASHED.split(a=[1.4]), RTOL).join()


def exact(times, a, b, k):
    """The amount after a dose at a and a wash at b."""
    dose = np.where(times >= a, np.exp(-k * (times - a)), 0.0) * np.where(
        (b > a) & (times >= b), 0.5, 1.0
    )
    return np.exp(-k * times) * np.where(times >= b, 0.5, 1.0) + dose


def points(solution, count, seed):
    """Random points of the box."""
    box = np.array(list(solution.parameters.values()))
    shares = np.random.default_rng(seed).random((len(box), count))
    return dict(zip(solution.parameters, box[:, :1] + np.ptp(box, axis=1)[:, None] * shares))


def values(solution, *at, **named):
    """Values, without warnings of what is undecided."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ro.RankoneWarning)
        return solution(*at, **named)


@pytest.mark.slow
def test_two_doses_that_swap():
    solution = washed()
    assert solution.success
    assert solution.error <= RTOL
    assert isinstance(solution.timeline, BranchedTimeline)
    assert len(solution.timeline.branches) == 2
    at = points(solution, 2000, 5)
    times = np.linspace(0.0, END, 25)
    states = values(solution, times[:, None], at)[0]
    wanted = exact(times[:, None], **at)
    beside = np.minimum(abs(times[:, None] - at["a"]), abs(times[:, None] - at["b"])) < RTOL * END
    decided = ~np.isnan(states)
    assert decided.mean() > 1.0 - 2.0 * solution.timeline.undecided - 1e-3
    assert np.abs(states - wanted)[decided & ~beside].max() < 2.0 * RTOL * wanted.max()


@cache
def cornered(rate, **further):
    """Doses of 1 and 2 of which the second comes first in a corner of the box.

    Over the whole box that order grows by exp(7 rate) back in time.
    """
    after = {"when": "t - b", "direction": "rising", "then": {"x": "x + 2"}, "name": "second"}
    box = {"a": (4, 9), "b": (6, 11), **further}
    return ro.solve(text({"x": f"-{rate}*x"}, {"x": 0}, box, 24, DOSE, after), RTOL)


def cornered_exact(times, a, b, k=2.0):
    elapsed = enumerate((times - a, times - b), 1)
    return sum(n * (e >= 0) * np.exp(-k * np.maximum(e, 0)) for n, e in elapsed)


@pytest.mark.parametrize(
    "solve",
    [
        pytest.param(partial(cornered, 2.0), marks=pytest.mark.slow),
        pytest.param(partial(cornered, "k", k=(0.5, 2)), marks=pytest.mark.slow),
    ],
)
def test_doses_that_swap_in_a_corner_of_the_box(solve):
    solution = solve()
    assert solution.success, solution.message
    own = [box_of_branch(solution.timeline, k, solution.metadata.box)[:2] for k in (0, 1)]
    assert own[0] == ((4, 9), (6, 11))
    assert own[1] == (pytest.approx((5.52, 9)), pytest.approx((6, 9.48)))
    at, times = points(solution, 2000, 7), np.linspace(0, 24, 25)[:, None]
    beside = np.minimum(abs(times - at["a"]), abs(times - at["b"])) < RTOL * 24
    wrong = np.abs(values(solution, times, at)[0] - cornered_exact(times, **at))[~beside]
    assert np.nanmax(wrong) < 6 * RTOL
    assert np.isnan(wrong).mean() < 1e-3
    decided = (branch := solution.branch(at)) >= 0
    np.testing.assert_array_equal(branch[decided], (at["a"] > at["b"])[decided])
    corner, inside = solution.restrict(a=(8, 8.5), b=(6.5, 7)), {**at, "a": 8.2, "b": 6.8}
    np.testing.assert_allclose(corner["x"](9.0, inside), solution["x"](9.0, inside), rtol=1e-9)


@pytest.mark.slow
def test_an_output_of_doses_that_swap_in_a_corner_of_the_box():
    solution = cornered("k", k=(0.5, 2))
    total = solution.output({"total": "integral(x, 0, 12)"})
    assert total.success, total.message
    at = points(solution, 300, 8)
    doses = (n * -np.expm1(-at["k"] * (12 - at[name])) / at["k"] for n, name in enumerate("ab", 1))
    np.testing.assert_allclose(total["total"](at), sum(doses), atol=5e-3)


def test_times_of_events_swap_with_them():
    solution = washed()
    assert solution.event_times("dose", **POINT) == pytest.approx([2.0])
    assert solution.event_times("wash", b=[2.5, 1.7], a=2, k=0.4) == pytest.approx(
        np.array([[2.5, 1.7]])
    )
    assert solution.end(**POINT) == END
    with pytest.raises(ro.EvaluationError, match="did you mean `dose`"):
        solution.event_times("does", **POINT)


def test_what_is_undecided_is_nan_with_a_warning():
    solution = washed()
    with pytest.warns(ro.RankoneWarning, match="undecided in which order"):
        before, after = solution([1.0, 5.0], a=2.0, b=2.0, k=0.4)[0]
    assert before == pytest.approx(np.exp(-0.4), rel=RTOL)
    assert np.isnan(after)
    assert 0.0 < solution.timeline.undecided < 0.01
    assert "undecided" in str(solution.timeline)
    assert "undecided" in solution.message


def test_every_success_says_which_share_is_undecided(washed_in_pieces):
    """In its message, its summary and the JSON of the command line."""
    whole, joined = washed(), washed_in_pieces
    output = whole.output({"twice": "2*x"})
    for solution in (whole, joined, whole.restrict(k=(0.3, 0.4)), whole.fix(k=0.4), output):
        assert solution.success
        share = solution.outcome.verdict.undecided
        assert 1e-5 < share < 0.01
        told = f"in {100 * share:.2g} % of the box it is undecided in which order events come"
        assert told in solution.message
        assert told in " ".join(repr(solution).split())
        assert summary(solution)["undecided"] == share
    one_order, both = (piece.outcome.verdict.undecided for piece in joined.pieces)
    assert one_order == 0.0
    assert joined.outcome.verdict.undecided == pytest.approx(0.8 * both)


@pytest.mark.slow
def test_where_branches_agree_nothing_is_undecided():
    second = {**WASH, "then": {"x": "x + 2"}}
    box = {"a": (1, 3), "b": (1, 3)}
    solution = ro.solve(text({"x": "-x/2"}, {"x": 1}, box, 4, DOSE, second), 1e-3)
    assert solution.success
    assert solution.timeline.undecided == 0.0
    wanted = np.exp(-2.0) + 3.0 * np.exp(-1.0)
    assert solution(4.0, a=2.0, b=2.0)[0] == pytest.approx(wanted, rel=1e-3)


@pytest.mark.parametrize("suffix", ["npz", "nc"])
def test_files_keep_branches(tmp_path, suffix):
    if suffix == "nc":
        pytest.importorskip("h5netcdf")
    solution = washed()
    again = ro.load(solution.save(tmp_path / f"washed.{suffix}"))
    assert again.timeline == solution.timeline
    for point in (POINT, SWAPPED):
        np.testing.assert_array_equal(again([1.0, 5.0], point), solution([1.0, 5.0], point))


def test_derivatives_and_smaller_solutions():
    solution = washed()
    for point in (POINT, SWAPPED):
        step = 1e-4
        for j, name in enumerate(point):
            up, down = ({**point, name: point[name] + sign * step} for sign in (1, -1))
            slope = (exact(5.0, **up) - exact(5.0, **down)) / (2 * step)
            assert solution.gradient(5.0, point)[0, j] == pytest.approx(slope, abs=2e-3)
    fixed = solution.fix(k=0.4)
    assert fixed(5.0, a=2.0, b=1.7)[0] == pytest.approx(exact(5.0, **SWAPPED), rel=RTOL)
    smaller = solution.restrict(a=(1.5, 2.5))
    assert smaller(5.0, SWAPPED)[0] == pytest.approx(exact(5.0, **SWAPPED), rel=RTOL)


def test_parts_of_the_box_know_their_own_share_that_is_undecided():
    solution = washed()
    assert 0.0 < solution.timeline.undecided < 0.01
    one_order = solution.restrict(a=(1, 1.4))
    assert one_order.success
    assert one_order.timeline.undecided == 0.0
    assert "undecided" not in one_order.message
    along = solution.restrict(a=(1.999, 2.001)).fix(b=2.0)
    assert not along.success
    assert along.timeline.undecided > 0.1
    assert "it is undecided in which order events come" in along.message
    assert not solution.fix(a=2.0, b=2.0, k=0.4).success
    assert solution.fix(a=2.0, b=1.7, k=0.4).success


def integral(function, time, k=0.4, density=lambda a, b: 0.25):
    """The integral over a and b of a function of the amount at a time, by SciPy."""

    def over_a(b):
        def at(a):
            return density(a, b) * function(exact(time, a, b, k))

        return quad(at, 1.0, 3.0, points=sorted({x for x in (b, time) if 1 < x < 3}))[0]

    ends = sorted({x for x in (3.0, time) if 1.5 < x < 3.5})
    return quad(over_a, 1.5, 3.5, points=ends, epsrel=1e-7)[0]


@pytest.mark.parametrize("time", [pytest.param(2.2, marks=pytest.mark.slow), 5.0])
def test_statistics_go_across_branches(time):
    solution = washed().fix(k=0.4)
    mean = integral(lambda x: x, time)
    spread = np.sqrt(integral(lambda x: (x - mean) ** 2, time))
    assert solution.mean(time)[0] == pytest.approx(mean, abs=1e-4 * spread)
    assert solution.std(time)[0] == pytest.approx(spread, rel=1e-4)
    assert solution.cov(time)[0, 0] == pytest.approx(spread**2, rel=2e-4)
    third = integral(lambda x: (x - mean) ** 3, time) / spread**3
    assert solution.skewness(time)[0] == pytest.approx(third, abs=1e-3)


@pytest.mark.slow
def test_sobol_indices_go_across_branches():
    solution, time = washed().fix(k=0.4), 5.0
    a, b = np.meshgrid(1 + (np.arange(2000) + 0.5) / 1000, 1.5 + (np.arange(2000) + 0.5) / 1000)
    states = exact(time, a, b, 0.4)
    of_a, of_b = states.mean(axis=0).var(), states.mean(axis=1).var()
    first = np.array([of_a, of_b]) / states.var()
    indices = solution.sobol([time])
    assert indices.first[0, :, 0] == pytest.approx(first, abs=5e-3)
    assert indices.total[0, :, 0] == pytest.approx(1.0 - first[::-1], abs=5e-3)
    assert indices.second[0, 0, 1, 0] == pytest.approx(1.0 - first.sum(), abs=1e-2)


def test_main_effects_follow_correlated_parameters():
    solution, time, correlation = washed().fix(k=0.4), 5.0, 0.8
    effects = solution.main_effects(time, count=3, correlation={("a", "b"): correlation})

    def of_a(a):
        middle = correlation * ndtri((a - 1.0) / 2.0)

        def at(z):
            b = 1.5 + 2.0 * ndtr(middle + np.sqrt(1.0 - correlation**2) * z)
            return exact(time, a, b, 0.4) * np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)

        swap = (ndtri((a - 1.5) / 2.0) - middle) / np.sqrt(1.0 - correlation**2)
        return quad(at, -8.0, swap)[0] + quad(at, swap, 8.0)[0]

    assert effects.means["a"][0, 1] == pytest.approx(of_a(2.0), rel=1e-3)


def test_statistics_that_do_not_settle_say_so(monkeypatch):
    monkeypatch.setattr(composite_statistics, "MOMENTS", Accuracy(1e-9, 1e-8, 32))
    with pytest.warns(ro.RankoneWarning, match="have settled to"):
        washed().restrict(k=(0.35, 0.45)).mean(2.2)


@pytest.mark.slow
def test_fits_go_across_branches():
    times = np.linspace(0.5, END, 12)
    fit = washed().fit(times, exact(times, **SWAPPED), observe=["x"], sigma=1e-2)
    assert fit.x["a"] == pytest.approx(2.0, abs=0.05)
    assert fit.x["k"] == pytest.approx(0.4, abs=0.01)


@pytest.mark.slow
def test_outputs_go_across_branches(tmp_path):
    solution = washed()
    dose = solution.output({"area": "integral(x, 0, 6)", "when": "event_time(dose, 0)"})
    assert dose.success
    for point in (POINT, SWAPPED):
        breaks = [0.0, *sorted((point["a"], point["b"])), END]
        amount = partial(exact, **point)
        area = sum(quad(amount, *ends)[0] for ends in itertools.pairwise(breaks))
        assert dose(point) == pytest.approx([area, point["a"]], rel=dose.rtol)
    again = ro.load(dose.save(tmp_path / "dose.npz"))
    np.testing.assert_array_equal(again(SWAPPED), dose(SWAPPED))
    assert 0.0 < dose.timeline.undecided < 0.01
    with pytest.warns(ro.RankoneWarning, match="undecided in which order"):
        assert np.isnan(dose["area"](a=2.0, b=2.0, k=0.4))
    assert dose.fix(k=0.4).mean()[1] == pytest.approx(2.0, rel=1e-4)


@pytest.mark.slow
def test_outputs_over_time_go_across_branches():
    square = washed().output({"y": "x**2"})
    assert square.success
    times = np.array([0.5, 1.8, 2.2, 5.0])
    for point in (POINT, SWAPPED):
        assert square(times, point)[0] == pytest.approx(exact(times, **point) ** 2, abs=1e-3)


def test_one_time_across_branches():
    solution = washed()
    late = solution.at(5.0)
    assert late.success
    for point in (POINT, SWAPPED):
        assert late(point)[0] == pytest.approx(exact(5.0, **point), rel=1e-3)
    with pytest.raises(ro.EvaluationError, match="`dose` has happened for some parameters alone"):
        solution.at(2.2)


@pytest.mark.slow
def test_outputs_where_guards_decide():
    """The dissipated work, by the closed form of each swing."""
    output = rubbing().output({"work": "mu*integral(v**2, 0, 6)"})
    assert output.success
    for start in (1.52, 1.8, 2.3):  # two swings end after 2 pi, or the mass sticks after one
        amplitudes = [start - 0.35, start - 3 * 0.35]
        squares = amplitudes[0] ** 2 * np.pi / 2
        if start > 3 * 0.35:
            rest = 6.0 - np.pi
            squares += amplitudes[1] ** 2 * (rest / 2 - np.sin(2 * rest) / 4)
        assert output(mu=0.35, start=start)[0] == pytest.approx(0.35 * squares, rel=5e-4)


@pytest.mark.parametrize(
    "use",
    [
        lambda s: s.diff("a"),
        lambda s: s.output({"rate": sp.Function("x")(sp.Symbol("t")).diff()}),
        lambda s: s.in_clock_time(),
        lambda s: s.to_canonical(),
    ],
)
def test_what_takes_one_order_alone_says_so(use):
    with pytest.raises(ro.EvaluationError, match="order of events changes inside the box"):
        use(washed())


def swings(times, start, mu):
    """Positions of x'' = -x - mu sign(x') from rest at ``start``: half swings of length pi."""
    positions = np.empty_like(times)
    for i, time in enumerate(times):
        x, rest = start, time
        while abs(x) > mu and rest > np.pi:
            x, rest = 2.0 * mu * np.sign(x) - x, rest - np.pi
        middle = mu * np.sign(x)
        positions[i] = x if abs(x) <= mu else middle + (x - middle) * np.cos(rest)
    return positions


@cache
def rubbing():
    rates = {"x": "v", "v": "-x - mu*sign(v)"}
    box = {"start": (1.5, 2.5), "mu": (0.3, 0.4)}
    return ro.solve(text(rates, {"x": "start", "v": 0}, box, 9), RTOL)


def test_a_mass_that_sticks_at_a_turning_point_or_slips_on():
    solution = rubbing()
    assert solution.success
    assert len(solution.timeline.branches) == 2
    at, times = points(solution, 60, 3), np.linspace(0.0, 9.0, 30)
    states = values(solution, times[:, None], at)[0]
    wanted = np.array([swings(times, *pair) for pair in zip(*at.values(), strict=True)]).T
    assert np.isnan(states).mean() < 0.02
    assert np.nanmax(np.abs(states - wanted)) < 2.0 * RTOL * 2.5


@pytest.mark.slow
def test_an_order_at_a_corner_alone_is_met_by_the_check():
    """There it sticks at the second turn, and some branches end their stretches after the end."""
    rates = {"x": "v", "v": "-a*x - b*sign(v)"}
    box = {"a": (0.84, 1.16), "b": (0.27, 0.307), "c": (1.815, 2.2)}
    solution = ro.solve(text(rates, {"x": "c", "v": 0}, box, 9.745), RTOL)
    assert solution.success
    assert len(solution.timeline.branches) == 3
    corner = {"a": 0.8401, "b": 0.3069, "c": 1.8151}
    stuck = corner["c"] - 4.0 * corner["b"] / corner["a"]
    assert 0.84 * stuck < corner["b"]
    assert solution["x"](9.7, **corner) == pytest.approx(stuck, abs=2.0 * RTOL * 2.2)


@pytest.mark.slow
def test_an_order_between_three_times_that_nearly_coincide_is_right_or_undecided():
    """Six orders of three doses: one of them holds in a quarter of a percent of the box."""
    first = {"when": "t - a", "direction": "rising", "then": {"x": "x + 0.76*c"}, "name": "first"}
    second = {"when": "t - 1.542", "direction": "rising", "then": {"x": "0.3175"}, "name": "second"}
    third = {"when": "t - b", "direction": "rising", "then": {"x": "0.54"}, "name": "third"}
    box = {"a": (1.457684, 2.174277), "b": (1.482795, 2.485899), "c": (0.5, 1.0)}
    rates = {"x": "-0.279*x", "y": "-c*y + 0.4774*x"}
    doses = text(rates, {"x": 1, "y": 0}, box, 5.632851442869548, first, second, third)
    solution = ro.solve(doses, RTOL)
    assert solution.success
    assert len(solution.timeline.branches) >= 5
    at = {"a": 1.53, "b": 1.49, "c": 0.8}
    wanted = 0.3175 * np.exp(-0.279 * (4.0 - 1.542)) if solution.branch(**at) >= 0 else np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ro.RankoneWarning)
        value = solution["x"](4.0, **at)
    assert value == pytest.approx(wanted, abs=2.0 * RTOL, nan_ok=True)


PUSHED = text(
    {"x": "v", "v": "a*cos(0.455*t) - b*sign(v) - x"},
    {"x": 0, "v": 0.6},
    {"a": (1.26, 1.84), "b": (0.38, 0.69)},
    6.4,
)


@cache
def pushed():
    return ro.solve(PUSHED, RTOL)


@pytest.mark.slow
def test_a_stick_that_is_too_short_to_be_continued_is_opened_where_it_begins():
    """Where friction is weak the mass would have stuck at no time before, however hard it was."""
    solution = pushed()
    assert solution.success
    assert len(solution.timeline.openings) == 1
    assert solution.timeline.undecided < 0.001
    at, times = points(solution, 40, 3), np.linspace(0.0, 6.4, 17)
    assert set(solution.branch(**at)) >= {0, 1}
    for k in range(12):
        a, b = at["a"][k], at["b"][k]
        run = solve_ivp(
            lambda t, u, a=a, b=b: [
                u[1],
                a * np.cos(0.455 * t) - b * np.tanh(u[1] / 1e-7) - u[0],
            ],
            (0, 6.4),
            [0, 0.6],
            "Radau",
            times,
            rtol=1e-8,
            atol=1e-10,
        )
        ours = solution(times, a=a, b=b)
        assert np.nanmax(np.abs(ours - run.y)) <= 3.0 * RTOL * 2.0


@pytest.mark.slow
def test_a_stick_opened_where_it_begins_is_stored_and_exported(tmp_path):
    solution = pushed()
    at, times = points(solution, 30, 5), np.linspace(0.0, 6.4, 9)[:, None]
    solution.save(tmp_path / "pushed.npz")
    model = solution.export(tmp_path / "pushed.py")
    loaded = ro.load(tmp_path / "pushed.npz")
    ours = values(solution, times, at)
    np.testing.assert_array_equal(values(loaded, times, at), ours)
    spec = importlib.util.spec_from_file_location("pushed", model)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    np.testing.assert_allclose(module.value(t=times, **at), ours, atol=1e-12)


@pytest.mark.slow
def test_a_force_that_saturates_at_the_start_or_not():
    rates = {"x": "v", "v": "Max(-1, Min(1, -2*x - 3*v))"}
    solution = ro.solve(text(rates, {"x": "a", "v": 0}, {"a": (0.2, 1.5)}, 6), RTOL)
    assert solution.success
    for start in (0.3, 0.49, 0.52, 1.3):
        run = _saturated(start)
        assert solution(6.0, a=start)[0] == pytest.approx(run, abs=2.0 * RTOL * 1.5)


@pytest.mark.slow
def test_an_order_that_grazes_in_a_sliver_is_declared(tmp_path):
    """Few trajectories overshoot so far that they saturate on the other side as well."""
    box = {"u": (0.6, 2), "x0": (0.4, 1), "v0": (-0.5, 0.5)}
    rates = {"x": "v", "v": "-Max(-u, Min(u, 3*x + 2*v))"}
    problem = text(rates, {"x": "x0", "v": "v0"}, box, 4)
    solution = ro.solve(problem, RTOL)
    assert solution.success
    assert len(solution.timeline.branches) == 2
    assert 0.004 < solution.timeline.undecided < 0.01
    assert ro.load(solution.save(tmp_path / "sliver.npz")).timeline == solution.timeline
    at, times = points(solution, 4000, 3), np.linspace(0.0, 4.0, 5)
    states = values(solution, times[:, None], at)
    wanted, both = _controlled(times, **at)
    undecided = np.isnan(states).any(axis=(0, 1))
    assert undecided[both].all()
    assert (undecided & ~both).mean() < 1e-3  # next to the border
    assert np.nanmax(np.abs(states - wanted)) < 2.0 * RTOL


def _controlled(times, u, x0, v0):
    """States under a force of at most u, and where that ends with both signs: Runge-Kutta."""
    y, most, steps, states = np.array([x0, v0]), np.full(u.shape, -np.inf), 500, []

    def rates(y):
        return np.array([y[1], -np.clip(3.0 * y[0] + 2.0 * y[1], -u, u)])

    h = (times[1] - times[0]) / steps
    for k in range(steps * (times.size - 1) + 1):
        if k % steps == 0:
            states.append(y)
        most = np.maximum(most, -(3.0 * y[0] + 2.0 * y[1]) - u)
        a = rates(y)
        b = rates(y + 0.5 * h * a)
        c = rates(y + 0.5 * h * b)
        d = rates(y + h * c)
        y = y + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
    return np.stack(states, axis=1), most > 0.0


def _saturated(start):
    """The position at the end, in closed form on either side of the limit."""
    x, v, time = start, 0.0, 0.0
    if 2.0 * start > 1.0:  # -1 until 2 x + 3 v = 1
        time = (-3.0 + np.sqrt(9.0 + 4.0 * (2.0 * start - 1.0))) / 2.0
        x, v = start - time**2 / 2.0, -time
    rest = 6.0 - time
    return (2.0 * x + v) * np.exp(-rest) - (x + v) * np.exp(-2.0 * rest)


@pytest.mark.slow
def test_a_sliver_is_undecided_in_whichever_stretch_it_falls():
    """The kick comes before, between or after two doses that swap."""

    def event(name, when, then):
        return {"when": when, "direction": "rising", "then": {"y": then}, "name": name}

    kick, doses = event("kick", "x - 1.395", "y + 1"), [("D", "t-a", "y/2"), ("E", "t-b", "y+0.7")]
    rates = {"z": "1", "x": "-A*(z-p)/2", "y": "-y/3"}  # x = A*(1 - (z-p)**2/4)
    box = {"A": (0.7, 1.4), "p": (1, 2), "a": (1.2, 1.8), "b": (1.2, 1.8)}
    start = {"z": 0, "x": "A*(1-p**2/4)", "y": 1}
    solution = ro.solve(text(rates, start, box, 5, kick, *(event(*each) for each in doses)), RTOL)
    assert solution.success
    at = points(solution, 4000, 7)
    undecided = np.isnan(values(solution, 5.0, at)).any(axis=0)
    assert undecided[at["A"] > 1.395].all()
    assert undecided[at["A"] < 1.39].mean() < 0.01  # at the times at which the doses swap


@pytest.mark.slow
def test_an_event_that_was_met_may_be_grazed_again():
    """The first kick comes everywhere, and a second one in a sliver, before or after the doses."""

    def event(name, when, then):
        return {"when": when, "direction": "rising", "then": {"y": then}, "name": name}

    kick = event("kick", "2*exp(-8*(z-1/2)**2) + A*exp(-(z-p)**2) - 1.395", "y + 1")
    doses = event("D", "t-a", "y/2"), event("E", "t-b", "y+0.7")
    box = {"A": (0.7, 1.4), "p": (2.5, 3.5), "a": (2.7, 3.3), "b": (2.7, 3.3)}
    problem = text({"z": "1", "y": "-y/3"}, {"z": 0, "y": 1}, box, 5, kick, *doses)
    solution = ro.solve(problem, RTOL)
    assert solution.success
    at = points(solution, 4000, 7)
    undecided = np.isnan(values(solution, 5.0, at)).any(axis=0)
    assert undecided[at["A"] > 1.395].all()
    assert undecided[at["A"] < 1.39].mean() < 0.01


def test_an_order_that_holds_in_a_sliver_alone_is_declared():
    """A kick at a level that few oscillations reach, and from which they come back elsewhere."""
    kick = {"when": "x - 1.395", "direction": "rising", "then": {"v": "-v"}, "name": "kick"}
    problem = text({"x": "v", "v": "-x"}, {"x": 0, "v": "a"}, {"a": (0.7, 1.4)}, 4, kick)
    solution = ro.solve(problem, RTOL)
    assert solution.success
    assert solution.timeline.undecided == pytest.approx(0.005 / 0.7, rel=0.1)
    with pytest.warns(ro.RankoneWarning, match="undecided in which order"):
        assert np.isnan(solution(3.0, a=1.397)).all()
    at = np.array([0.8, 1.3, 1.394])
    np.testing.assert_allclose(solution(3.0, a=at)[0], at * np.sin(3.0), atol=RTOL)


def test_an_event_that_comes_before_the_start_in_a_part_of_the_box():
    """It does not come there."""
    problem = text({"x": "-x/2"}, {"x": 1}, {"a": (-1, 1.5)}, 3, DOSE)
    solution = ro.solve(problem, RTOL)
    assert solution.success
    at = np.array([-0.9, -0.1, 0.1, 1.4])
    wanted = np.exp(-1.5) + np.where(at > 0.0, np.exp(-0.5 * (3.0 - at)), 0.0)
    np.testing.assert_allclose(solution(3.0, a=at)[0], wanted, rtol=2.0 * RTOL)
    assert np.isnan(solution.event_times("dose", a=at)[0]).tolist() == [True, True, False, False]
    with pytest.raises(
        ro.OptionError, match="no occurrence 0 before the end in `order 1` of the 2"
    ):
        solution.output({"when": "event_time(dose, 0)"})
    with pytest.raises(ro.OptionError, match="no occurrence 5 before the end") as raised:
        solution.output({"when": "event_time(dose, 5)"})
    assert raised.value.remedy == (
        "in order 0: those before the end are from 0 to 0; "
        "in order 1: those before the end are none"
    )


def test_events_that_coincide_at_a_corner_alone():
    solution = ro.solve(
        text({"x": "-x/2"}, {"x": 1}, {"a": (1, 2), "b": (2, 3)}, 5, DOSE, WASH), RTOL
    )
    assert solution.success
    assert solution(5.0, a=1.5, b=2.5)[0] == pytest.approx(exact(5.0, 1.5, 2.5, 0.5), rel=RTOL)


def test_an_end_that_comes_before_or_after_a_dose():
    end = {"when": "x - 0.3", "direction": "falling", "terminal": True, "name": "end"}
    box = {"a": (1, 3), "k": (0.3, 0.9)}
    solution = ro.solve(text({"x": "-k*x"}, {"x": 1}, box, 5, DOSE, end), RTOL)
    assert solution.success
    assert solution.end(a=2.5, k=0.8) == pytest.approx(np.log(1 / 0.3) / 0.8, rel=RTOL)
    assert np.isnan(solution(2.0, a=2.5, k=0.8)[0])
    later = np.exp(-0.4 * 4.0) + np.exp(-0.4 * 1.5)
    assert solution(4.0, a=2.5, k=0.4)[0] == pytest.approx(later, rel=2.0 * RTOL)


def test_points_at_which_a_branch_passes_an_event_that_its_order_lacks():
    """An event that is added afterwards: where x falls through a level after the dose."""
    compiled, solution = ro.compile(WASHED), washed()
    domain = Domain.of(compiled.system)
    timed, _ = timed_system(compiled.system, domain)
    request = SolveRequest.of(compiled.system, [], {}, SolveArguments(rtol=RTOL))
    orders = [*order_search(timed, request).groups()]
    evaluator = branch_evaluator(solution.outcome.slabs, solution.outcome.timeline)

    def suspicious(*levels):
        further = [
            SystemEvent(lambda t, u, p, level=level: u[0] - level, direction=-1, terminal=True)
            for level in levels
        ]
        system = replace(timed, events=(*timed.events, *further))
        return points_with_other_events(evaluator, system, orders, Coverage.of_domain(domain))

    assert not len(suspicious())
    assert not len(suspicious(2.0))
    others = suspicious(1.55)
    assert len(others)
    for a, b, k in others:
        assert exact(np.array([a]), a, b, k)[0] > 1.55


@pytest.mark.slow
def test_stages_count_the_search_for_orders():
    system, rtol = ro.compile(WASHED).system, 1e-3
    with limited(1e12):
        outcome = ENGINES["cross"].run(system, rtol)
        spent = work_done()
    assert outcome.status is Status.CONVERGED
    assert sum(outcome.work.values()) == pytest.approx(spent, rel=0.05)


def test_the_limit_in_a_search_for_orders_names_an_event():
    solution = ro.solve(WASHED, RTOL, effort=0.003)
    assert solution.status is Status.WORK_LIMIT
    assert "while the orders of events over the box were looked for: " in solution.message
    assert "`wash`" in solution.message
    assert "raise effort, or narrow the box" in solution.message
    assert "reference" not in solution.message


@pytest.mark.slow
def test_two_events_at_one_instant_far_from_zero():
    """Times near 30000 are rounded to 4e-12: both events count as one all the same."""
    events = [
        {"when": "x - 0.5", "direction": "rising", "then": {"x": "0"}, "name": "a"},
        {"when": "y**3 - 0.125", "direction": "rising", "then": {"y": "0"}, "name": "b"},
    ]
    rates, start = {"x": "k", "y": "k"}, {"x": 0, "y": 0}
    box, time = {"k": (1.3, 1.4)}, (30000, 30001)
    problem = ro.Problem.from_strings(rates, start, box, time, events=events)
    solution = ro.solve(problem, 1e-4, effort="low")
    assert solution.success, solution.message
    k = np.linspace(1.3, 1.4, 5)
    np.testing.assert_allclose(solution(t=30000.9, k=k), [0.9 * k % 0.5] * 2, atol=1e-4)
