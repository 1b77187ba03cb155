"""Solved models of solutions with events agree with the solutions."""

from __future__ import annotations

import json
import re
import subprocess
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import rankone as ro
from rankone.tensors.trains.train import Train
from tests.share.export import node
from tests.share.export.node import needs_node
from tests.share.export.test_models import (
    COMPILER,
    SANITIZED,
    SANITIZED_COUNT,
    STRICT,
    compiled_driver,
    imported,
    needs_compiler,
    run_driver,
)

RTOL = 1e-3


def problem(rhs, initial, box, end, events):
    return ro.Problem.from_strings(rhs, initial, box, (0, end), events=events)


def event(when, direction, name, then=None, **further):
    return {"when": when, "direction": direction, "name": name, **further} | (
        {"then": then} if then else {}
    )


PROBLEMS = {
    "ball": problem(
        {"y": "v", "v": "-9.81 - c*v*abs(v)"},
        {"y": "h", "v": 0},
        {"h": (0.8, 1.2), "c": (0.04, 0.06), "e": (0.78, 0.82)},
        1.6,
        [event("y", "falling", "bounce", {"y": 0, "v": "-e*v"})],
    ),
    "dose": problem(
        {"A": "r - k*A", "r": "0"},
        {"A": 0, "r": 0},
        {"k": (0.2, 0.5), "lag": (0.5, 2), "span": (1.5, 2.5)},
        8,
        [
            event("t - lag", "rising", "start", {"r": 1}),
            event("t - lag - span", "rising", "stop", {"r": 0}),
        ],
    ),
    # drops a stage, and for most parameters comes back before the horizon ends
    "rocket": problem(
        {"h": "v", "v": "f*(1 - s)/m - 9.81", "m": "-9*(1 - s)", "s": "0"},
        {"h": 0, "v": 0, "m": "2*d", "s": 0},
        {"f": (3000, 3400), "d": (95, 105)},
        13.5,
        [
            event("m - 1.7*d", "falling", "drop", {"m": "1.2*d", "s": 1}),
            event("h", "falling", "ground", terminal=True),
        ],
    ),
}


@cache
def solved(name):
    """A solution; with two runs that of the ball whose later slabs have other cores."""
    if name != "two runs":
        return ro.solve(PROBLEMS[name], RTOL)
    ball = solved("ball")
    slabs = list(ball.outcome.slabs)
    for k in range(len(slabs) // 2, len(slabs)):
        first, second, *cores = slabs[k].cores
        slabs[k] = replace(slabs[k], train=Train((0.5 * first, 2.0 * second, *cores)))
    return ro.Solution(replace(ball.outcome, slabs=tuple(slabs)), ball.metadata)


NAMES = [*PROBLEMS, "two runs"]


def points(solution, count=2000):
    """Random points by name, some at corners of the box, at the very times of doses and events."""
    rng = np.random.default_rng(2)
    box = {solution.metadata.time: solution.time, **solution.parameters}
    where = {name: rng.uniform(a, b, count) for name, (a, b) in box.items()}
    for name, ends in solution.parameters.items():
        where[name][::3] = rng.choice(ends, len(where[name][::3]))
    where[solution.metadata.time][:2] = solution.time
    if "lag" in box:
        where["t"][2::5] = where["lag"][2::5]
        where["t"][3::5] = where["lag"][3::5] + where["span"][3::5]
    at = {name: where[name][4::20] for name in solution.parameters}
    for times in solution.event_times(solution.timeline.events[0], at)[:1]:
        where["t"][4::20] = np.where(np.isfinite(times), times, where["t"][4::20])
    return where


def without_time(solution, where):
    return {name: where[name] for name in solution.parameters}


def assert_close(values, wanted, tolerance=1e-12):
    """Within a tolerance of the largest value along the points, and NaN at the same."""
    np.testing.assert_array_equal(np.isnan(values), np.isnan(wanted))
    size = np.maximum(np.nanmax(np.abs(wanted), axis=-1, keepdims=True), 1e-6)
    assert np.nanmax(np.abs(values - wanted) / size) <= tolerance


@pytest.mark.parametrize("name", NAMES)
def test_python(name, tmp_path):
    solution = solved(name)
    assert solution.success
    model = imported(solution.export(tmp_path / "model.py"))
    where = points(solution)
    at = without_time(solution, where)
    assert_close(model.value(where), solution(where))
    slopes = model.gradient(where)
    assert_close(slopes[:, 1:], solution.gradient(where), 1e-8)
    for event in solution.timeline.events:
        assert_close(model.event_times(event, at), solution.event_times(event, at))
    assert_close(model.end(at), solution.end(at))
    # the derivative in time, away from the events
    step = 1e-6 * solution.time[1]
    later = where["t"] + 2 * step
    inner = {**where, "t": np.clip(later, 2 * step, solution.time[1] - 2 * step)}
    ahead, behind = (model.value({**inner, "t": inner["t"] + sign * step}) for sign in (1, -1))
    rates = (ahead - behind) / (2 * step)
    size = np.nanmax(np.abs(model.gradient(inner)[:, 0]), axis=1, keepdims=True)
    close = np.abs(rates - model.gradient(inner)[:, 0]) <= 1e-4 * np.maximum(size, 1e-6)
    assert (close | np.isnan(rates)).mean() >= 0.99


def test_shapes_and_names_of_event_times(tmp_path):
    solution = solved("ball")
    model = imported(solution.export(tmp_path / "model.py"))
    at = {"h": [0.9, 1.0, 1.1], "c": 0.05, "e": [[0.79], [0.8]]}
    assert model.event_times("bounce", at).shape == solution.event_times("bounce", at).shape
    first = model.event_times("bounce", h=1.0, c=0.05, e=0.8)[0]
    after = model.value(t=first, h=1.0, c=0.05, e=0.8)
    assert after[1] > 0.0  # it flies up again
    with pytest.raises(ValueError, match="no event bonce"):
        model.event_times("bonce", at)
    with pytest.raises(ValueError, match="were given, not h, c, e"):
        model.event_times("bounce", {**at, "t": 1.0})


@pytest.mark.parametrize("name", NAMES)
def test_smaller_models_are_within_the_tolerance(name, tmp_path):
    """At clock times further than rtol horizons from events."""
    solution, rtol = solved(name), 1e-3
    full, model = (
        imported(solution.export(tmp_path / f"{file}.py", rtol=tolerance))
        for file, tolerance in (("full", None), ("small", rtol))
    )
    where = points(solution)
    at = without_time(solution, where)
    wanted, values = solution(where), model.value(where)
    horizon = solution.time[1]
    near = np.abs(solution.end(at) - where["t"]) <= rtol * horizon
    for event in solution.timeline.events:
        times = solution.event_times(event, at)
        near |= (np.abs(times - where["t"]) <= rtol * horizon).any(axis=0)
        moved = np.abs(times - model.event_times(event, at))
        assert np.nanmax(moved, initial=0.0) <= rtol * horizon
    size = np.nanmax(np.abs(wanted), axis=1, keepdims=True)
    assert_close(values[:, ~near] / size, wanted[:, ~near] / size, rtol)
    assert 0.5 < 1.0 - near.mean() < 1.0
    assert model.COEFFICIENTS.size < full.COEFFICIENTS.size
    assert f"away from events by {rtol:g} of the horizon" in " ".join(model.__doc__.split())


TIMES_DRIVER = r"""
#include <stdio.h>
#include "model.h"

/* parameters of one point from standard input: times of events, then the end */
int main(void)
{
    double p[MODEL_PARAMETERS], times[MODEL_INSTANTS], end;
    int k;

    for (k = 0; k < MODEL_PARAMETERS; k++)
        if (scanf("%lf", &p[k]) != 1)
            return 1;
    if (model_event_times(p, times) || model_end(p, &end))
        return 2;
    for (k = 0; k < MODEL_INSTANTS; k++)
        printf("%s %.17g\n", model_instant_names[k], times[k]);
    printf("end %.17g\n", end);
    p[0] = model_upper[0] + 1.0;
    return model_event_times(p, times) == MODEL_OUT_OF_RANGE ? 0 : 3;
}
"""


@needs_compiler
@pytest.mark.parametrize("name", NAMES)
def test_c(name, tmp_path):
    solution = solved(name)
    solution.export(tmp_path / "model.c")
    where = points(solution)
    wanted, slopes = solution(where), solution.gradient(where)
    model = imported(solution.export(tmp_path / "model.py"))
    rates = model.gradient(where)[:, 0]
    for flags, count in (["-O2"], None), ([*SANITIZED, "-DMODEL_PORTABLE"], SANITIZED_COUNT):
        first = {key: row[:count] for key, row in where.items()}
        values, gradients, batch = run_driver(compiled_driver(tmp_path, *flags), solution, first)
        assert_close(values, wanted[:, :count])
        assert_close(gradients[:, 1:], slopes[..., :count], 1e-8)
        assert_close(gradients[:, 0], rates[:, :count], 1e-8)
        np.testing.assert_array_equal(batch, values)
    source, program = tmp_path / "times.c", tmp_path / "times"
    source.write_text(TIMES_DRIVER)
    files = [str(source), str(tmp_path / "model.c")]
    subprocess.run([COMPILER, *STRICT, "-o", str(program), *files], check=True)
    point = {key: float(values[7]) for key, values in without_time(solution, where).items()}
    text = " ".join(map(repr, point.values()))
    run = subprocess.run([str(program)], input=text, capture_output=True, text=True)
    assert run.returncode == 0
    times = {}
    for line in run.stdout.splitlines():
        names, _, time = line.rpartition(" ")
        for event in names.split(" and "):
            times.setdefault(event, []).append(float(time))
    np.testing.assert_allclose(times.pop("end"), [solution.end(point)], rtol=1e-12)
    assert times.keys() == set(solution.timeline.events)
    for event, instants in times.items():
        np.testing.assert_allclose(instants, solution.event_times(event, point), rtol=1e-12)
    header = (tmp_path / "model.h").read_text()
    for event, instants in times.items():
        assert f"#define MODEL_T_{event}_{len(instants) - 1} " in header


JAVASCRIPT = """
const p = {point};
const instants = m.events.flatMap((event) => [...m.eventTimes(event, p)]);
const times = [{start}, ...instants.filter((t) => t <= {end}), {end}, m.end(p), {middle}];
const attempt = (call) => {
  try { return call(); } catch (error) { return [error.name, error.message]; }
};
const out = new Float64Array(9).fill(7);
const plain = (values) => [...values].map((value) => (Number.isNaN(value) ? null : value));
console.log(JSON.stringify({
  exports: Object.keys(m),
  times: Object.fromEntries(m.events.map((event) => [event, plain(m.eventTimes(event, p))])),
  end: m.end(Object.values(p)),
  borders: plain(m.borders(p)),
  instants: m.instants,
  curveTimes: times,
  curve: plain(m.curve(p, times)),
  singly: m.names.flatMap((_, i) => plain(times.map((t) => m.evaluate(t, p)[i]))),
  same: m.eventTimes(m.events[0], p, out) === out && out[8] === 7,
  event: attempt(() => m.eventTimes("bonce", p)),
  missing: attempt(() => m.end({})),
}));
"""


@needs_node
@pytest.mark.parametrize("name", NAMES)
def test_javascript(name, tmp_path):
    solution = solved(name)
    solution.export(tmp_path / "model.mjs")
    where = points(solution)
    values, batch, slopes, rates = node.run_driver(tmp_path, solution, where)
    assert_close(values, solution(where))
    np.testing.assert_array_equal(batch, values)
    assert_close(slopes, solution.gradient(where), 1e-8)
    model = imported(solution.export(tmp_path / "model.py"))
    assert_close(rates, model.gradient(where)[:, 0], 1e-8)
    plain = node.run_driver(tmp_path, solution, where, "plain")
    for ours, theirs in zip((values, batch, slopes, rates), plain):
        np.testing.assert_array_equal(ours, theirs)


@needs_node
@pytest.mark.parametrize("name", NAMES)
def test_times_of_events_in_javascript(name, tmp_path):
    """Also values at the very instants, in one curve and singly."""
    solution = solved(name)
    solution.export(tmp_path / "model.mjs")
    at = without_time(solution, points(solution))
    point = {key: float(values[7]) for key, values in at.items()}
    start, end = solution.time
    fields = {"point": json.dumps(point), "start": start, "end": end, "middle": 0.4 * end}
    text = re.sub(r"{(point|start|end|middle)}", lambda match: str(fields[match[1]]), JAVASCRIPT)
    said = node.script(tmp_path, text)
    types = (tmp_path / "model.d.mts").read_text()
    declared = re.findall(r"^export (?:const|class|function) (\w+)", types, re.M)
    assert set(declared) == set(said["exports"])
    assert f"EventName = {' | '.join(json.dumps(e) for e in solution.timeline.events)};" in types
    assert said["times"].keys() == set(solution.timeline.events)
    for event, times in said["times"].items():
        wanted = solution.event_times(event, point)
        np.testing.assert_allclose(np.array(times, dtype=float), wanted, rtol=1e-12)
    np.testing.assert_allclose(said["end"], solution.end(point), rtol=1e-12)
    np.testing.assert_allclose(
        said["borders"], solution._borders((point,), {})[0][:, 0], rtol=1e-12
    )
    assert said["instants"] == [list(names) for names in solution.timeline.met]
    shape = len(solution.unknowns), len(said["curveTimes"])
    curve, singly = (np.reshape(np.array(said[kind], float), shape) for kind in ("curve", "singly"))
    assert_close(curve, singly)
    # an instant that differs by rounding has the value before the event: ask a little later
    python = imported(solution.export(tmp_path / "model.py"))
    times, last = np.array(said["curveTimes"]), said["end"]
    later = np.where(times <= last, np.minimum(times + 1e-9, last - 1e-9), times)
    assert_close(curve, python.value({"t": later, **point}), 1e-6)
    assert said["same"]
    assert said["event"][0] == "UnknownEventError"
    assert said["event"][1].startswith('no event "bonce"; the events are ')
    assert said["missing"][0] == "MissingParameterError"
