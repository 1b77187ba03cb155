"""Pages of solutions with events: sliders move the events and change their order, curves break."""

from __future__ import annotations

import csv
import io
import json
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import rankone as ro
from rankone.tensors.coordinates import round_off
from tests.share.conformance.cases import solution_of
from tests.share.conformance.test_conformance import assert_close
from tests.share.export.browser import NoBrowserError, browser, settle
from tests.share.export.node import needs_node, script
from tests.share.export.test_explorer import ACCENT, STROKES

VALUES = Path(ro.__file__).parent / "share" / "export" / "explorer" / "values.js"
FIXED = {"ball": {"c": 0.05, "e": 0.8}, "dose": {"k": 0.3, "span": 2.0}, "rocket": {"d": 100.0}}
BRANCHED = {"washed": {"a": 2.0, "k": 0.4}, "kicked": {"c": 1.0}}


@cache
def shown(name):
    """A solution with one parameter, which has no Sobol indices: they take long."""
    return solution_of(name).fix((FIXED | BRANCHED)[name])


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pages")
    return cache(lambda name: shown(name).explore(folder / f"{name}.html"))


@pytest.fixture(scope="module")
def chromium():
    try:
        with browser() as found:
            yield found
    except NoBrowserError as reason:
        pytest.skip(str(reason))


def moved(name):
    """A value of the only parameter, away from the middle."""
    ((parameter, (lower, upper)),) = shown(name).parameters.items()
    return {parameter: lower + 0.8 * (upper - lower)}


def data_of(page):
    return json.loads(re.search(r'id="data">(.*?)</script>', page.read_text())[1])


# --- without a browser -------------------------------------------------------------------------


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n == "ball" else ()) for n in FIXED]
)
def test_what_is_written(name, pages):
    solution, data = shown(name), data_of(pages(name))
    (stretches,) = data["stretches"]
    assert len(stretches) == solution.timeline.stretches
    assert all(shares[0] == 0.0 for shares in stretches)
    assert all(0.0 <= share < 1.0 for shares in stretches for share in shares)
    ends = np.array(list(solution.parameters.values())).reshape(-1)
    for unknown in data["unknowns"]:
        lower, upper = unknown["extent"]
        curves = solution[unknown["name"]](
            np.array(data["times"]), {next(iter(solution.parameters)): ends[:, None]}
        )
        room = 1e-2 * (upper - lower)
        assert lower - room <= np.nanmin(curves) <= np.nanmax(curves) <= upper + room
    assert data["terminal"] == solution.timeline.terminal
    text = pages(name).read_text()
    assert "Times of events are met to" in text
    assert "Sobol indices are from points" not in text
    assert ("bands are those of the others" in text) == solution.timeline.terminal
    assert ("what still runs" in text) == solution.timeline.terminal


def test_bands_end_when_nothing_runs(pages):
    data = data_of(pages("rocket"))
    solution = shown("rocket")
    last = solution.end(f=np.linspace(*solution.parameters["f"], 101)).max()
    for unknown in data["unknowns"]:
        for time, low in zip(data["times"], unknown["low"], strict=True):
            if time > last + 1e-6:
                assert low is None
            elif time < 0.99 * last:
                assert low is not None


def test_events_at_one_time_have_both_sides_in_the_bands(tmp_path):
    event = {"when": "t - 1", "direction": "rising", "then": {"u": "u + 1"}, "name": "push"}
    problem = ro.Problem.from_strings(
        {"u": "-k*u"}, {"u": 1}, {"k": (0.5, 1)}, (0, 2), events=[event]
    )
    data = data_of(ro.solve(problem, rtol=1e-4).explore(tmp_path / "page.html"))
    low = np.array(data["unknowns"][0]["low"])
    (jump,) = np.flatnonzero(np.diff(low) > 0.5)
    np.testing.assert_allclose(data["times"][jump : jump + 2], 1.0, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.filterwarnings("error", "ignore:statistics have settled")
def test_sobol_indices_are_there_while_all_run(tmp_path):
    solution = solution_of("rocket")
    page = solution.explore(tmp_path / "page.html")
    assert "Sobol indices are from points" in page.read_text()
    sobol = data_of(page)["sobol"]
    first = solution.end(
        {name: np.linspace(*ends, 9) for name, ends in solution.parameters.items()}
    )
    runs = np.array(sobol["times"]) < first.min() - 0.5
    mass = np.array(sobol["total"][2], dtype=float)  # known at all times, and never the same
    assert np.isfinite(mass[:, runs]).all()
    assert np.isnan(mass[:, -1]).all()


@needs_node
def test_times_of_curves(tmp_path):
    """Even times, those of stretches up to the end, and both sides of each border."""
    (tmp_path / "model.mjs").write_text(VALUES.read_text())
    text = """
    const shares = [[0, 0.5], [0, 0.25, 0.5, 0.75], [0]];
    const borders = Float64Array.of(0, 0.3, 1.3, 2.5);
    const times = m.timesWithEvents([0, 1, 2], shares, borders, [0, 2]);
    const jumps = [...m.jumpsAt(times)].flatMap((is, i) => (is ? [times[i]] : []));
    console.log(JSON.stringify([[...times], jumps]));"""
    times, jumps = script(tmp_path, text)
    np.testing.assert_allclose(
        times, [0, 0.15, 0.3, 0.3, 0.55, 0.8, 1, 1.05, 1.3, 1.3, 2], atol=5e-12
    )
    assert jumps == [0.3, 1.3]
    assert (np.diff(times) > 0.0).all()


# --- in a browser ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FIXED)
def test_sliders_move_the_events(name, pages, chromium):
    """Curves, values, times of events and the end are those of the solution."""
    solution, at = shown(name), moved(name)
    with chromium.open(pages(name)) as page:
        first = page.evaluate("rankone.values()")
        page.evaluate("(at) => rankone.set(at)", {**at, "t": 0.4 * solution.time[1]})
        settle(page)
        found = page.evaluate("rankone.values()")
    assert [event["names"] for event in found["events"]] == [
        event["names"] for event in first["events"]
    ]
    assert found["end"] == pytest.approx(float(solution.end(at)), rel=1e-12)
    for event in solution.timeline.events:
        times = [one["time"] for one in found["events"] if event in one["names"]]
        wanted = solution.event_times(event, at)
        np.testing.assert_allclose(times, wanted[np.isfinite(wanted)], rtol=1e-12)
    instants = np.array([event["time"] for event in found["events"]])
    assert np.abs(instants - [event["time"] for event in first["events"]]).max() > 1e-3
    times = np.array(found["times"])
    assert (np.diff(times) > 0.0).all()
    rounding = round_off(*solution.time)
    for instant in instants[instants < found["end"]]:  # both sides of each are drawn
        assert instant in times
        assert instant - times[times < instant - rounding][-1] < 5.0 * rounding
    curves = np.array([found["curves"][unknown] for unknown in solution.unknowns], dtype=float)
    assert_close(curves, solution(times, at), 1e-6)
    now = np.array([found["values"][unknown] for unknown in solution.unknowns])
    assert_close(now[:, None], solution([found["time"]], at))


LINES = """async () => {
  const paths = new WeakMap();
  const lines = [];
  const [{ moveTo, lineTo }, { stroke }] = [Path2D.prototype, CanvasRenderingContext2D.prototype];
  Path2D.prototype.moveTo = function (x, y) {
    const path = paths.get(this) ?? { pieces: 0, steepest: 0, right: 0 };
    if (Number.isFinite(x + y)) Object.assign(path, { pieces: path.pieces + 1, last: [x, y] });
    paths.set(this, path);
    moveTo.call(this, x, y);
  };
  Path2D.prototype.lineTo = function (x, y) {
    const path = paths.get(this);
    if (path && Number.isFinite(x + y)) {
      const height = Math.abs(y - path.last[1]);
      if (x - path.last[0] < 0.01) path.steepest = Math.max(path.steepest, height);
      Object.assign(path, { last: [x, y], right: Math.max(path.right, x) });
    }
    lineTo.call(this, x, y);
  };
  CanvasRenderingContext2D.prototype.stroke = function (path) {
    if (path && this.lineWidth > 2 && paths.has(path)) {
      lines.push({ ...paths.get(path), place: this.canvas.getBoundingClientRect().left });
    }
    stroke.apply(this, arguments);
  };
  rankone.set({});
  await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
  Object.assign(Path2D.prototype, { moveTo, lineTo });
  CanvasRenderingContext2D.prototype.stroke = stroke;
  return lines;
}"""


@pytest.mark.parametrize(
    ("name", "pieces"),
    [("ball", {"y": 1, "v": 3}), ("dose", {"A": 1, "r": 3}), ("rocket", {"m": 2, "h": 1})],
)
def test_lines_break_where_values_jump_and_end_where_time_does(name, pieces, pages, chromium):
    unknowns = shown(name).unknowns
    with chromium.open(pages(name)) as page:
        page.locator("[data-together=false]").click()
        settle(page)
        lines = page.evaluate(LINES)
        ticks = page.locator(".u-over").first.locator(".tick")
        last = ticks.last.evaluate("(e) => e.getBoundingClientRect()")
    assert len(lines) == len(unknowns)
    for unknown, line in zip(unknowns, lines, strict=True):
        assert line["steepest"] < 1.0
        assert line["pieces"] == pieces.get(unknown, line["pieces"])
    if shown(name).timeline.terminal:
        end = lines[0]["place"] + lines[0]["right"]
        assert end == pytest.approx(0.5 * (last["left"] + last["right"]), abs=1.5)


def test_ticks_and_times_of_events(pages, chromium):
    solution = shown("ball")
    with chromium.open(pages("ball")) as page:
        for at in ({"h": 0.8}, {"h": 1.2}):
            page.evaluate("(at) => rankone.set(at)", at)
            settle(page)
            events = page.evaluate("rankone.values()")["events"]
            times = [event["time"] for event in events]
            written = page.locator("#events .when").all_inner_texts()
            shown_times = {}
            for name, text in zip(solution.timeline.events, written, strict=True):
                wanted = solution.event_times(name, at)
                ours = [event["time"] for event in events if name in event["names"]]
                assert len(ours) == np.isfinite(wanted).sum()
                texts = text.split(", ")
                np.testing.assert_allclose(list(map(float, texts)), ours, atol=6e-5)
                shown_times |= {time: f"{name} {t}" for time, t in zip(ours, texts, strict=True)}
            titles = page.evaluate(
                "[...document.querySelectorAll('.u-over .tick:not([hidden])')].map((e) => e.title)"
            )
            assert titles == [shown_times[time] for time in times]
            lefts = page.evaluate(
                "[...document.querySelectorAll('.u-over .tick:not([hidden])')].map("
                "(e) => parseFloat(e.style.left) / e.parentElement.clientWidth)"
            )
            np.testing.assert_allclose(lefts, np.array(times) / solution.time[1], atol=2e-3)


def test_after_the_end_there_is_nothing(pages, chromium):
    solution = shown("rocket")
    end = float(solution.end(f=3200.0))
    with chromium.open(pages("rocket")) as page:
        page.evaluate("(t) => rankone.set({ f: 3200, t })", end + 0.1)
        settle(page)
        found = page.evaluate("rankone.values()")
        assert page.locator("#legend .value").all_inner_texts() == ["–"] * len(solution.unknowns)
        table = list(csv.DictReader(io.StringIO(page.evaluate("rankone.table()"))))
    assert all(np.isnan(value) for value in found["values"].values())
    assert float(table[-1]["t"]) == pytest.approx(end, rel=1e-12)
    assert all(np.isfinite(float(row["h"])) for row in table)
    after = np.array(found["times"]) > end + 1e-9
    for curve in found["curves"].values():
        np.testing.assert_array_equal(np.isnan(np.array(curve, dtype=float)), after)


def test_jumps_are_dashed_in_the_phase_plot(pages, chromium):
    with chromium.open(pages("ball")) as page:
        page.evaluate("rankone.set({ t: 1.4 })")
        settle(page)
        strokes = page.evaluate(STROKES)
    strokes = [stroke for stroke in strokes if re.match(ACCENT, stroke["colour"])]
    solid = [stroke for stroke in strokes if not stroke["dashed"]]
    assert max(stroke["longest"] for stroke in solid) < 40
    assert sum(stroke["dashed"] for stroke in strokes) == 4  # two bounces, drawn weak and strong


# --- orders that change ------------------------------------------------------------------------


@pytest.mark.filterwarnings("error")
def test_what_is_written_of_branches(pages):
    for name in BRANCHED:
        data, timeline = data_of(pages(name)), shown(name).timeline
        assert [len(each) for each in data["stretches"]] == [b.stretches for b in timeline.branches]
        assert all(np.isfinite(np.array(u["low"], dtype=float)).all() for u in data["unknowns"])
        assert "curves that depend on it have a gap" in " ".join(pages(name).read_text().split())


@pytest.mark.slow
@pytest.mark.filterwarnings("error", "ignore:statistics have settled")
def test_sobol_indices_go_across_orders(tmp_path):
    data = data_of(solution_of("kicked").explore(tmp_path / "page.html", rtol=1e-2))
    shares = np.array(data["sobol"]["first"], dtype=float)
    assert np.nanmax(np.abs(shares)) <= 1.05


def test_curves_on_both_sides_of_a_change(pages, chromium):
    """Curves, values and times of events are those of the solution."""
    solution = shown("washed")
    rounding = round_off(*solution.time)
    with chromium.open(pages("washed")) as page:
        for b in (1.7, 2.4):
            page.evaluate("(b) => rankone.set({ b, t: 5 })", b)
            settle(page)
            said = page.evaluate("rankone.values()")
            wanted = {name: float(solution.event_times(name, b=b)[0]) for name in ("dose", "wash")}
            order = sorted(wanted, key=wanted.get)
            assert [event["names"] for event in said["events"]] == [[name] for name in order]
            times = [event["time"] for event in said["events"]]
            np.testing.assert_allclose(times, sorted(wanted.values()), rtol=1e-12)
            assert said["values"]["x"] == pytest.approx(float(solution["x"](5.0, b=b)), rel=1e-12)
            at = np.array(said["times"])
            apart = np.abs(at[:, None] - times).min(axis=1) > 1e-9
            curve = np.array(said["curves"]["x"], dtype=float)[apart]
            assert_close(curve, solution["x"](at[apart], b=b))
            for time in times:  # both sides of a jump are drawn
                before = time - at[at < time].max()
                assert time in at
                assert rounding < before < 5.0 * rounding


def test_a_curve_has_a_gap_where_the_order_is_undecided(pages, chromium):
    solution = shown("washed")
    with chromium.open(pages("washed")) as page:
        page.evaluate("rankone.set({ b: 2, t: 5 })")
        settle(page)
        said = page.evaluate("rankone.values()")
        assert page.locator("#legend .value").all_inner_texts() == ["–"]
        table = list(csv.DictReader(io.StringIO(page.evaluate("rankone.table()"))))
    times, curve = np.array(said["times"]), np.array(said["curves"]["x"], dtype=float)
    with pytest.warns(ro.RankoneWarning):
        wanted = solution({"t": times, "b": 2.0})[0]
    inside = np.abs(times - 2.0) > 1e-9
    assert_close(curve[inside], wanted[inside])
    assert np.isnan(curve[times > 2.01]).all()
    assert np.isfinite(curve[times < 1.99]).all()
    assert len(table) == np.isfinite(curve).sum()
    assert all(np.isfinite(float(row["x"])) for row in table)


def test_an_event_that_is_just_missed_has_no_time(pages, chromium):
    with chromium.open(pages("kicked")) as page:
        texts = []
        for a in (0.9, 1.0001, 1.2):
            page.evaluate("(a) => rankone.set({ a, t: 1 })", a)
            settle(page)
            texts += page.locator("#events .when").all_inner_texts()
            said = page.evaluate("rankone.values()")
            assert np.isfinite(said["curves"]["x"][1])  # before the event it is known
    missed, unknown, met = texts
    assert (missed, unknown) == ("does not happen", "not known here")
    assert float(met) == pytest.approx(np.arcsin(1.0 / 1.2), abs=1e-3)
