"""Five systems with events through all that takes a solution, against single trajectories.

A bouncing ball; an infusion after a lag, of unknown duration; a rocket that drops a stage and may
be back on the ground before the horizon ends. In two of them the order changes inside the box: a
dose and a wash that swap, and a mass that sticks or slips on. The
trajectories are SciPy's, of the equations as they are written, or with sticking as an event. A
public method of a solution that no test here names is a failure.
"""

from __future__ import annotations

import copy
import json
import pickle
from dataclasses import dataclass
from functools import cache

import matplotlib.pyplot
import numpy as np
import pytest
import scipy.stats
import sympy as sp

import rankone as ro
from rankone import plotting
from tests.share.conformance.cases import PROBLEMS, RTOL
from tests.share.conformance.cases import solution_of as solved
from tests.share.export.alone import PythonAlone
from tests.share.export.test_models import imported

pytestmark = pytest.mark.slow

t = sp.Symbol("t")
NEAR = 2.0 * RTOL  # Part of the horizon around an event that resets: values jump there
SPREAD = 512  # Points whose values statistics are compared with


@dataclass(frozen=True)
class Case:
    """A system, and times and events that suit it.

    ``same`` is a time by which the same events have happened everywhere, ``event`` one that always
    happens, at which ``moves`` is not zero, and ``fixed`` values of some of the parameters.
    """

    name: str
    unknown: str
    same: float
    event: str
    moves: str
    fixed: dict

    @property
    def problem(self):
        return {**PROBLEMS, **CHANGING}[self.name]

    @property
    def solution(self):
        return solved(self.name) if self.name in PROBLEMS else solved_changing(self.name)

    def trajectory(self, times, point):
        if self.name != "mass":
            return self.problem.trajectory(times, point)
        run = STICKING.trajectory(times, point)
        return Swings(run.values[:2], {"switch_0": run.events["turn"]})

    @property
    def size(self):
        return sizes(self.name)

    def points(self, count=6, seed=11):
        """Points inside of the box, at least one of them near a corner."""
        rng = np.random.default_rng(seed)
        intervals = self.solution.parameters
        shares = rng.uniform(0.0, 1.0, (count, len(intervals)))
        shares[0] = np.round(shares[0]) * 0.98 + 0.01
        for row in shares:
            pairs = zip(intervals.items(), row, strict=True)
            yield {name: lower + share * (upper - lower) for (name, (lower, upper)), share in pairs}

    def away(self, point, count=25):
        """Times that are not near an event of the trajectory at a point."""
        start, end = self.solution.time
        happened = self.trajectory(np.array([end]), point).events.values()
        instants = np.concatenate([*happened, [-end]])
        times = np.linspace(start, end, count)
        return times[np.abs(times[:, None] - instants).min(axis=1) > NEAR * end]

    def agrees(self, evaluate, tolerance=2.0 * RTOL):
        """Whether values (unknowns, T) at times and a point are those of trajectories."""
        for point, times, wanted in references(self.name):
            assert_close(evaluate(times, point), wanted, tolerance * self.size)


@dataclass(frozen=True)
class Swings:
    """A trajectory of the mass: position and velocity, and the times at which it turns back."""

    values: np.ndarray
    events: dict

    def __getitem__(self, name):
        return self.values["xv".index(name)]


def text(rates, initial, box, end, *events):
    return ro.Problem.from_strings(rates, initial, box, (0, end), events=[*events])


CHANGING = {
    "wash": text(
        {"x": "-0.4*x"},
        {"x": 1},
        {"a": (1, 3), "b": (1.6, 3.5)},
        6,
        {"when": "t - a", "direction": "rising", "then": {"x": "x + 1"}, "name": "dose"},
        {"when": "t - b", "direction": "rising", "then": {"x": "x*b/6"}, "name": "wash"},
    ),
    "mass": text(
        {"x": "v", "v": "-x - mu*sign(v)"},
        {"x": "a", "v": 0},
        {"a": (1.5, 2.5), "mu": (0.3, 0.4)},
        9,
    ),
}
turn = {"s": "-s", "n": "Heaviside(Abs(x) - mu)", "v": 0}
STICKING = text(
    {"x": "v", "v": "-n*(x + mu*s)", "s": "0*s", "n": "0*n"},
    {"x": "a", "v": 0, "s": -1, "n": 1},
    {"a": (1.5, 2.5), "mu": (0.3, 0.4)},
    9,
    {"when": "v", "then": turn, "name": "turn"},
)


@cache
def solved_changing(name):
    return ro.solve(CHANGING[name], RTOL)


CASES = {
    "ball": Case("ball", "y", 0.8, "bounce", "v", {"c": 0.05}),
    "dose": Case("dose", "A", 6.0, "stop", "A", {"k": 0.3}),
    "rocket": Case("rocket", "h", 8.0, "drop", "v", {"d": 100.0}),
    "wash": Case("wash", "x", 5.0, "dose", "x", {"b": 2.4}),
    "mass": Case("mass", "x", 7.0, "switch_0", "x", {"mu": 0.36}),
}


@cache
def sizes(name):
    """The largest value of each unknown (unknowns, 1) along some trajectories."""
    case = CASES[name]
    times = np.linspace(*case.solution.time, 60)
    values = [np.abs(case.trajectory(times, point).values) for point in case.points()]
    return np.nanmax(values, axis=(0, 2))[:, None]


@cache
def references(name):
    """Points, times and unknowns (unknowns, T) of trajectories there."""
    case = CASES[name]
    pairs = [(point, case.away(point)) for point in case.points()]
    return [(*pair, case.trajectory(pair[1], pair[0]).values) for pair in pairs]


@cache
def sampled(name):
    """Values (unknowns, SPREAD) of the solution at spread points and the time ``same``.

    They are near those of trajectories, as `test_values` sees; undecided ones are left out.
    """
    case, box = CASES[name], CASES[name].solution.parameters
    shares = scipy.stats.qmc.Sobol(len(box), seed=5).random(SPREAD)
    points = {n: a + x * (b - a) for (n, (a, b)), x in zip(box.items(), shares.T)}
    values = case.solution(case.same, points)
    decided = np.isfinite(values).all(axis=0)
    assert decided.mean() > 0.99
    return values[:, decided]


@pytest.fixture(params=CASES)
def case(request):
    return CASES[request.param]


@pytest.fixture(params=[name for name in CASES if name not in CHANGING])
def one_order(request):
    return CASES[request.param]


@pytest.fixture(params=["rocket", "wash"])
def either(request):
    """With one order of events, and with two: where the way does not depend on what they do."""
    return CASES[request.param]


NAMED = set()


def takes(*names):
    """The public names of a solution that a test uses."""
    NAMED.update(names)
    return lambda test: test


def assert_close(found, wanted, tolerance):
    np.testing.assert_array_equal(np.isnan(found), np.isnan(wanted))
    assert (np.nan_to_num(np.abs(found - wanted)) <= tolerance).all()


# --- values --------------------------------------------------------------------------------------


@takes(
    "success",
    "error",
    "errors",
    "corner_error",
    "rtol",
    "status",
    "message",
    "time_error",
    "share_error",
)
@takes("unknowns", "states", "parameters", "time", "method", "history", "work", "timings")
@takes("rank", "ranks", "nodes", "nbytes")
def test_what_is_said_of_it(case):
    solution = case.solution
    assert solution.success
    assert solution.error <= solution.rtol == RTOL
    assert max(solution.errors.values()) <= RTOL
    assert solution.corner_error < 10 * RTOL
    assert 0.0 <= solution.time_error <= RTOL
    assert case.name in CHANGING or 0.0 < solution.share_error <= 3.0 * RTOL
    assert solution.status.value in solution.message or solution.message
    assert solution.method == "cross"
    assert solution.unknowns == tuple(str(u.func) for u in case.problem.unknowns)
    assert set(solution.unknowns) <= set(solution.states)
    assert max(solution.ranks[0]) <= solution.rank
    assert len(solution.nodes) == len(solution.parameters)
    assert solution.nbytes > 0
    assert solution.work
    assert solution.history
    assert solution.timings
    assert str(solution)


@takes("grid", "to_xarray", "to_dataframe")
def test_values(case):
    solution = case.solution
    case.agrees(solution)
    case.agrees(lambda times, point: [solution[name](times, point) for name in solution.unknowns])
    case.agrees(
        lambda times, point: solution.grid({"t": times, **point}).reshape(len(case.size), -1)
    )
    for point in case.points(2):
        times = case.away(point)
        wanted = solution(times, point)
        table = solution.to_xarray({"t": times, **point})
        np.testing.assert_allclose(
            np.stack([table[name].values.ravel() for name in solution.unknowns]), wanted
        )
        frame = solution.to_dataframe({"t": times, **point})
        np.testing.assert_allclose(frame[list(solution.unknowns)].to_numpy().T, wanted)


@takes("event_times", "end", "timeline", "branch")
def test_times_of_events(case):
    solution, (_, end) = case.solution, case.solution.time
    for point in case.points():
        trajectory = case.trajectory(np.array([end]), point)
        switches = {name for name in solution.timeline.events if name.startswith("switch_")}
        assert set(solution.timeline.events) - switches == set(trajectory.events) - switches
        for event, instants in trajectory.events.items():
            times = solution.event_times(event, point)
            times = times[np.isfinite(times)]
            assert times.size == instants.size
            np.testing.assert_allclose(times, instants, atol=RTOL * end)
        order = getattr(solution.timeline, "branches", [solution.timeline])[solution.branch(point)]
        names = [name for instant in order.met for name in instant]
        assert set(trajectory.events) - switches <= set(names)
        last = trajectory.events.get("ground", np.empty(0))
        assert abs(solution.end(point) - (last[0] if last.size else end)) <= RTOL * end


@takes("gradient", "diff")
def test_derivatives(case):
    """By parameters and time, from differences of trajectories."""
    solution, derivatives, rate = case.solution, {}, None
    if case.name not in CHANGING:
        derivatives = {name: solution.diff(name) for name in solution.parameters}
        rate = solution.diff("t")
    for point in case.points(3):
        times = case.away(point)[1:-1]
        times = times[times < solution.end(point) * (1.0 - NEAR)]
        gradient = solution.gradient(times, point)
        for j, (name, (lower, upper)) in enumerate(solution.parameters.items()):
            step = 1e-3 * (upper - lower)
            ahead, behind = (
                case.trajectory(times, {**point, name: point[name] + sign * step}).values
                for sign in (1, -1)
            )
            wanted = (ahead - behind) / (2.0 * step)
            tolerance = 0.03 * np.maximum(np.abs(wanted).max(axis=1, keepdims=True), case.size)
            assert_close(gradient[:, j], wanted, tolerance)
            if derivatives:
                assert_close(derivatives[name](times, point), wanted, tolerance)
        if rate is None:
            continue
        step = 1e-4 * solution.time[1]
        ahead, behind = (case.trajectory(times + sign * step, point).values for sign in (1, -1))
        wanted = (ahead - behind) / (2.0 * step)
        tolerance = 0.03 * np.maximum(np.abs(wanted).max(axis=1, keepdims=True), case.size)
        assert_close(rate(times, point), wanted, tolerance)


# --- other solutions -----------------------------------------------------------------------------


@takes("fix", "restrict")
def test_smaller_boxes(case):
    free = [name for name in case.solution.parameters if name not in case.fixed]
    fixed = case.solution.fix(case.fixed)
    narrow = {
        name: (0.7 * lower + 0.3 * upper, 0.3 * lower + 0.7 * upper)
        for name, (lower, upper) in case.solution.parameters.items()
    }
    restricted = case.solution.restrict(narrow)
    for point in case.points(3):
        here = {**point, **case.fixed}
        times = case.away(here)
        wanted = case.trajectory(times, here).values
        given = {name: here[name] for name in free}
        assert_close(fixed(times, given), wanted, 2.0 * RTOL * case.size)
        inside = {name: np.clip(point[name], *narrow[name]) for name in point}
        times = case.away(inside)
        wanted = case.trajectory(times, inside).values
        assert_close(restricted(times, inside), wanted, 2.0 * RTOL * case.size)


@takes("at")
def test_one_time(one_order):
    then = one_order.solution.at(one_order.same)
    assert then.success
    for point in one_order.points():
        wanted = one_order.trajectory(one_order.same, point).values
        assert_close(then(point), wanted, 2.0 * RTOL * one_order.size[:, 0])


def test_another_box_and_another_end(either):
    """Given to ``solve``."""
    name, (lower, upper) = next(iter(either.solution.parameters.items()))
    box = {name: (lower, 0.5 * (lower + upper))}
    solution = ro.solve(either.problem, RTOL, parameters=box, t_final=either.same)
    assert solution.success
    for point in either.points(3):
        inside = {**point, name: 0.5 * (lower + point[name])}
        times = either.away(inside)
        times = times[times <= either.same]
        wanted = either.trajectory(times, inside).values
        assert_close(solution(times, inside), wanted, 2.0 * RTOL * either.size)


@takes("save")
@pytest.mark.parametrize("suffix", [".npz", ".nc"])
def test_files(case, suffix, tmp_path):
    path = case.solution.save(tmp_path / f"solution{suffix}")
    loaded = ro.load(path)
    assert loaded.timeline == case.solution.timeline
    for point in case.points(2):
        times = np.linspace(*case.solution.time, 30)
        np.testing.assert_array_equal(loaded(times, point), case.solution(times, point))
    for same in (copy.deepcopy(case.solution), pickle.loads(pickle.dumps(case.solution))):
        np.testing.assert_array_equal(same(times, point), loaded(times, point))


@takes("to_canonical", "modes", "in_clock_time")
def test_the_form_without_stretches(one_order):
    """Resets at times that move are not resolved in clock time; what says so names itself."""
    with pytest.raises(ro.EvaluationError, match="to_canonical does not take"):
        one_order.solution.to_canonical()
    with pytest.raises(ro.EvaluationError, match=r"remedy: give solution.in_clock_time\(\)"):
        _ = one_order.solution.modes
    short = one_order.solution.restrict(
        {name: (lower, lower + 0.01 * (upper - lower)) for name, (lower, upper) in
         one_order.solution.parameters.items()}
    )  # fmt: skip
    if one_order.name == "rocket":
        with pytest.raises(ro.EvaluationError, match="the solution ends with `ground`"):
            short.in_clock_time()
        return
    with pytest.raises(ro.ConvergenceError, match=rf"since .*`{one_order.event}` may reset states"):
        short.in_clock_time(1e-3)


# --- statistics ----------------------------------------------------------------------------------


@takes("mean", "std", "var", "cov", "moment", "skewness", "kurtosis", "quantile")
def test_moments(either):
    """At one time, against values at spread points."""
    solution, values, at = either.solution, sampled(either.name), either.same
    spread = values.std(axis=1)
    apart = 4.0 / np.sqrt(SPREAD)  # of evenly spread points, and so generous
    assert (np.abs(solution.mean(at) - values.mean(axis=1)) <= apart * spread + RTOL).all()
    assert (np.abs(solution.std(at) - spread) <= apart * spread + RTOL).all()
    np.testing.assert_allclose(solution.var(at), solution.std(at) ** 2, rtol=1e-9)
    np.testing.assert_allclose(solution.moment(2, at), solution.var(at), rtol=1e-3)
    row = solution.unknowns.index(either.unknown)
    covariance = solution.cov(at)
    # each settles on its own where events end solutions: within 1e-3 of the spread
    np.testing.assert_allclose(np.diag(covariance), solution.var(at), rtol=1e-4, atol=1e-12)
    assert covariance[row, row] == pytest.approx(
        np.atleast_2d(np.cov(values))[row, row], rel=2.0 * apart
    )
    for method, wanted in (("skewness", scipy.stats.skew), ("kurtosis", scipy.stats.kurtosis)):
        found = getattr(solution, method)(at)[row]
        found = found - 3.0 if method == "kurtosis" and found > 1.5 else found
        assert found == pytest.approx(wanted(values[row]), abs=0.5)
    middle = solution.quantile([0.25, 0.75], at)[:, row]
    wanted = np.quantile(values[row], [0.25, 0.75])
    assert (np.abs(middle - wanted) <= 2.0 * apart * spread[row]).all()


@takes("probability", "density", "sample", "main_effects", "sobol")
def test_distributions(either):
    solution, at = either.solution, either.same
    values = sampled(either.name)[solution.unknowns.index(either.unknown)]
    level = float(np.median(values))
    above = solution.probability(at, unknown=either.unknown, above=level)
    assert float(above.value) == pytest.approx(0.5, abs=0.1)
    density = solution.density(at, unknown=either.unknown)
    assert np.trapezoid(density.density, density.values) == pytest.approx(1.0, abs=0.05)
    points = solution.sample(50, seed=3)
    drawn = solution[either.unknown](at, {name: points[name] for name in solution.parameters})
    assert np.ptp(drawn) <= 1.2 * np.ptp(values)
    effects = solution.main_effects(at, count=3)
    assert set(effects.means) == set(solution.parameters)
    indices = solution.sobol(at)
    row = solution.unknowns.index(either.unknown)
    assert (indices.total[row] >= indices.first[row] - 0.05).all()
    assert indices.total[row].sum() >= 0.95


# --- outputs, fits -------------------------------------------------------------------------------


@takes("output")
def test_outputs(one_order):
    """The time of an event, a value there, and the integral up to it."""
    x, event = sp.Function(one_order.moves)(t), ro.event_time(one_order.event, 0)
    start, end = one_order.solution.time
    outputs = one_order.solution.output(
        {
            "time": event,
            "value": ro.at_event(x, one_order.event, 0),
            "integral": sp.Integral(x, (t, start, event)),
        }
    )
    assert outputs.success, outputs.message
    for point in one_order.points(3):
        (instant, *_) = one_order.trajectory(np.array([end]), point).events[one_order.event]
        times = np.linspace(start, instant, 4001)
        values = one_order.trajectory(times, point)[one_order.moves]
        before = one_order.trajectory(instant - 1e-7 * end, point)[one_order.moves]
        wanted = [instant, float(before), float(np.trapezoid(values, times))]
        scale = np.maximum(np.abs(wanted), [end, np.ptp(values), np.ptp(values) * end])
        np.testing.assert_array_less(np.abs(outputs(point) - wanted), 4.0 * RTOL * scale)


@takes("fit", "posterior", "minimize")
@pytest.mark.parametrize("name", [name for name in CASES if name != "wash"])
def test_parameters_from_data(name):
    """Data of a trajectory lead back to its parameters. (Doses that swap: test_changing_orders.)"""
    case = CASES[name]
    (true,) = case.points(1, seed=4)
    times = case.away(true, 40)
    data = case.trajectory(times, true)[case.unknown]
    times, data = times[np.isfinite(data)], data[np.isfinite(data)]
    scale = float(np.ptp(data))
    fixed = {name: true[name] for name in case.fixed}
    fit = case.solution.fit(times, data, observe=case.unknown, sigma=0.01 * scale, fixed=fixed)
    widths = {name: upper - lower for name, (lower, upper) in case.solution.parameters.items()}
    for name, value in fit.x.items():
        assert abs(value - true[name]) <= 0.02 * widths[name]
    known = {name: true[name] for name in list(true)[1:]}
    (free,) = set(true) - set(known)
    posterior = case.solution.posterior(
        times, data, observe=case.unknown, sigma=0.01 * scale, fixed=known
    )
    assert abs(posterior.mean[free] - true[free]) <= 0.05 * widths[free]
    at, target = times[len(times) // 2], data[len(times) // 2]

    def missed(values, _):
        return ((values[case.unknown] - target) / scale) ** 2

    optimum = case.solution.minimize(missed, at, fixed=known)
    assert optimum.fun <= 1e-4


# --- pictures, exports ---------------------------------------------------------------------------


def test_plots(either, monkeypatch):
    monkeypatch.setattr(
        "rankone.share.plotting.sensitivity_plots._EFFECT_POINTS", 5
    )  # to save time
    pyplot = pytest.importorskip("matplotlib.pyplot")
    (point,) = either.points(1)
    axes = plotting.plot_trajectories(either.solution, point, unknowns=either.unknown)
    (line, *_) = axes.lines
    times, drawn = line.get_data()
    wanted = either.solution[either.unknown](times, point)
    np.testing.assert_allclose(drawn, wanted)
    for event in either.solution.timeline.events:  # both sides of each event
        for instant in either.solution.event_times(event, point):
            assert np.isnan(instant) or np.abs(times - instant).min() < 1e-9
    few = np.linspace(0.0, either.same, 3)
    plotting.plot_bands(either.solution, unknowns=either.unknown, t=few)
    plotting.plot_main_effects(either.solution, either.unknown, either.same)
    plotting.plot_sobol(either.solution, either.unknown, few[1:])
    x, *others = point
    fixed = {name: point[name] for name in others}
    plotting.plot_surface(either.solution, either.unknown, fixed, x="t", y=x, points=11)
    plotting.plot_history(either.solution)
    with pytest.raises(ro.EvaluationError, match="does not take solutions"):
        plotting.plot_modes(either.solution, either.unknown)
    pyplot.close("all")


@takes("export")
def test_python_models(case, tmp_path):
    model = imported(case.solution.export(tmp_path / "model.py"))
    case.agrees(lambda times, point: model.value({"t": times, **point}))


@takes("explore")
def test_pages(either, tmp_path):
    page = either.solution.fix(either.fixed).explore(tmp_path / "page.html")
    text = page.read_text()
    assert all(event in text for event in either.solution.timeline.events)


@pytest.fixture(scope="module")
def alone():
    python = PythonAlone()
    yield python.runs
    python.close()


def test_standalone_solvers(either, alone, tmp_path):
    ro.compile(either.problem).export(tmp_path / "solver.py")
    (point,) = either.points(1)
    times = either.away(point)
    script = (
        "import json\n"
        f"solution = solver.solve({RTOL})\n"
        f"point = {point!r}\n"
        f"values = solution(np.array({times.tolist()!r}), point)\n"
        f"times = solution.event_times({either.event!r}, point)\n"
        "print(json.dumps([values.tolist(), times.tolist(), solution.success]))\n"
    )
    (run,) = alone(tmp_path, script)
    assert run.returncode == 0, run.stderr
    values, instants, success = json.loads(run.stdout)
    assert success
    wanted = either.trajectory(times, point).values
    assert_close(np.array(values, dtype=float), wanted, 2.0 * RTOL * either.size)
    np.testing.assert_allclose(
        instants, either.solution.event_times(either.event, point), rtol=1e-12
    )


@takes("plot", "design")
def test_pictures_and_designs(case):
    point, *_ = case.points(1)
    ax = case.solution.plot(point, unknowns=case.unknown, t=np.linspace(0.0, case.same, 9))
    assert ax.lines
    matplotlib.pyplot.close(ax.figure)
    names = [*case.solution.parameters]
    fixed = {name: point[name] for name in names[1:]}
    candidates = np.linspace(0.1, 0.9, 5) * case.same
    times = {"times": 1, "candidates": candidates, "observe": case.unknown, "sigma": 0.1}
    design = case.solution.design(at={names[0]: point[names[0]]}, fixed=fixed, **times)
    assert set(np.ravel(design.times)) <= set(candidates)


@pytest.mark.parametrize("name", CHANGING)
def test_what_takes_one_order_alone_says_so(name):
    solution = CASES[name].solution
    uses = [lambda: solution.diff("t"), solution.in_clock_time, solution.to_canonical]
    for use in uses:
        with pytest.raises(ro.EvaluationError, match="order of events changes inside the box"):
            use()


@takes("blocks", "join", "pieces")
def test_blocks_and_joined_solutions(case):
    solution, (point, *_) = case.solution, case.points(1)
    times = np.linspace(*solution.time, 7)
    whole = solution(times, point)
    joined = ro.Solution.join([solution])
    for one in (solution, joined, *joined.pieces):
        blocks = np.full_like(whole, np.inf)
        for index, values in one.blocks(times, point):
            blocks[(slice(None), *index)] = values
        assert_close(blocks, whole, 1e-12 * sizes(case.name))


def test_all_that_a_solution_has_is_tried():
    """But for populations, which have a few more parameters than these cases."""
    public = {name for name in dir(ro.Solution) if not name.startswith("_")}
    assert public - NAMED == {"fit_population"}
