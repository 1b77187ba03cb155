"""Solved models of solutions in which the order of events changes inside the box."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import warnings
from functools import cache

import numpy as np
import pytest

import rankone as ro
from tests.share.export import node
from tests.share.export.node import needs_node
from tests.share.export.test_event_models import assert_close, points, without_time
from tests.share.export.test_models import (
    COMPILER,
    ROOT,
    SANITIZED,
    SANITIZED_COUNT,
    STRICT,
    compiled_driver,
    imported,
    needs_compiler,
    run_driver,
)
from tests.solution.test_changing_orders import DOSE, WASHED, text
from tests.solution.test_opened_events import DOWN, KICK, KICKED, UP

RTOL = 1e-3
FREE = {"x": "v", "v": "-x"}
LEVEL = {"when": "x - 1.395", "direction": "rising", "then": {"v": "-v"}, "name": "kick"}
END = {"when": "x - 0.3", "direction": "falling", "terminal": True, "name": "end"}
RUB = {"x": "v", "v": "-x - mu*sign(v)"}
SLOW = pytest.param("braked", marks=pytest.mark.slow)

PROBLEMS = {
    # the times of two events decide
    "washed": WASHED,
    # a guard at a turning point decides
    "rubbing": text(RUB, {"x": "a", "v": 0}, {"a": (1.5, 2.5), "mu": (0.3, 0.4)}, 9),
    # one branch is smooth over the root of a height that another one gives
    "kicked": KICKED,
    # four branches, one of them over two roots
    "braked": text(FREE, {"x": 0, "v": "a"}, {"a": (0.8, 1.5), "c": (0.9, 1.1)}, 5.5, UP, DOWN),
    # one branch, and an event that it grazes in a sliver
    "sliver": text(FREE, {"x": 0, "v": "a"}, {"a": (0.7, 1.4)}, 4, LEVEL),
    # an event that may be past at the start
    "late": text({"x": "-x/2"}, {"x": 1}, {"a": (-1, 1.5)}, 3, DOSE),
    # a terminal event
    "ended": text({"x": "-k*x"}, {"x": 1}, {"a": (1, 3), "k": (0.3, 0.9)}, 5, DOSE, END),
}
NAMES = [SLOW if name == "braked" else name for name in PROBLEMS]


@cache
def solved(name):
    solution = ro.solve(PROBLEMS[name], RTOL)
    assert solution.success
    return solution


def values(solution, where):
    """Values, without warnings of what is undecided."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ro.RankoneWarning)
        return solution(where)


def slopes(solution, where):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ro.RankoneWarning)
        return solution.gradient(where)


@pytest.mark.parametrize("name", NAMES)
def test_python(name, tmp_path):
    """To the last digits, and NaN at the same points."""
    solution = solved(name)
    model = imported(solution.export(tmp_path / "model.py"))
    where = points(solution)
    at = without_time(solution, where)
    wanted = values(solution, where)
    assert np.isnan(wanted).mean() < 0.5
    assert_close(model.value(where), wanted)
    gradient = model.gradient(where)
    assert_close(gradient[:, 1:], slopes(solution, where), 1e-8)
    for event in solution.timeline.events:
        ours, times = model.event_times(event, at), solution.event_times(event, at)
        assert ours.shape == times.shape
        if times.size:
            assert_close(ours, times)
    assert_close(model.end(at), solution.end(at))
    np.testing.assert_array_equal(model.branch(at), solution.branch(at))
    step = 1e-6 * solution.time[1]  # the derivative in time, away from the events
    inner = {**where, "t": np.clip(where["t"] + 2 * step, step, solution.time[1] - step)}
    ahead, behind = (model.value({**inner, "t": inner["t"] + by}) for by in (step, -step))
    rates, ours = (ahead - behind) / (2.0 * step), model.gradient(inner)[:, 0]
    size = np.nanmax(np.abs(ours), axis=1, keepdims=True)
    close = np.abs(rates - ours) <= 1e-4 * size
    assert (close | np.isnan(rates)).mean() >= 0.99


@pytest.mark.parametrize("name", NAMES)
def test_smaller_models_are_within_the_tolerance(name, tmp_path):
    """At clock times further than rtol horizons from events, where both know the order."""
    solution, rtol = solved(name), 3e-3
    full, model = (
        imported(solution.export(tmp_path / f"{file}.py", rtol=tolerance))
        for file, tolerance in (("full", None), ("small", rtol))
    )
    where = points(solution, 6000)
    at = without_time(solution, where)
    wanted, ours = values(solution, where), model.value(where)
    horizon = solution.time[1]
    near = np.abs(solution.end(at) - where["t"]) <= rtol * horizon
    decision = model.MODEL._decision(np.array(list(at.values())))
    known = (decision.ahead >= model.WIDTH).all(axis=0)  # elsewhere times may be of another order
    for event in solution.timeline.events:
        times = solution.event_times(event, at)
        near |= (np.abs(times - where["t"]) <= rtol * horizon).any(axis=0)
        moved = np.abs(times - model.event_times(event, at))[:, known]
        assert np.nanmax(moved, initial=0.0) <= rtol * horizon
    size = np.nanmax(np.abs(wanted), axis=1, keepdims=True)
    assert np.nanmax(np.abs(ours - wanted)[:, ~near] / size) <= rtol
    further = np.isnan(ours).any(axis=0) & ~np.isnan(wanted).any(axis=0) & ~near
    assert further.mean() <= 5.0 * rtol  # known to rtol less: a width of the box in each of them
    assert model.COEFFICIENTS.size <= full.COEFFICIENTS.size
    if name in ("washed", "kicked", "ended"):
        assert model.COEFFICIENTS.size < 0.9 * full.COEFFICIENTS.size
    said = " ".join(model.__doc__.split())
    assert "where it is known which order of events holds; measured" in said


def test_where_the_order_is_undecided(tmp_path):
    """Values before the events and the times of these are known there, later values are not."""
    solution = solved("washed")
    model = imported(solution.export(tmp_path / "model.py"))
    at = {"a": 2.0, "b": [1.9, 2.0, 2.1], "k": 0.4}
    before, after = model.value({"t": [[1.0], [5.0]], **at})[0]
    assert np.isfinite(before).all()
    assert np.isnan(after).tolist() == [False, True, False]
    assert np.isfinite(model.event_times("dose", at)).all()
    assert model.event_times("wash", at).shape == (1, 3)
    assert model.branch(at).tolist() == [1, -1, 0]
    assert np.isnan(model.gradient({"t": 5.0, **at})[0]).any(axis=0).tolist() == [
        False,
        True,
        False,
    ]
    with pytest.raises(ValueError, match="no event does, only dose, wash"):
        model.event_times("does", at)
    with pytest.raises(ValueError, match="b is 9, not in"):
        model.value(t=1.0, a=2.0, b=9.0, k=0.4)
    assert "Next to a change" in model.__doc__


def test_values_without_parameters_and_with_states(tmp_path):
    """Branches of a smaller solution, and of all states."""
    solution = solved("rubbing")
    fixed = solution.fix(a=1.8, mu=0.33)
    model = imported(fixed.export(tmp_path / "fixed.py"))
    times = np.linspace(*fixed.time, 9)
    assert_close(model.value(t=times), fixed(times))
    every = imported(solution.export(tmp_path / "every.py", states="all"))
    wanted = solution.states
    where = points(solution, 50)
    assert wanted == every.UNKNOWNS
    ours = dict(zip(wanted, every.value(where), strict=True))
    for name in wanted:
        assert_close(ours[name][None], np.asarray(solution[name](where))[None])


SMALLER = {
    "at": lambda solution: solution.at(3.0),
    "restrict": lambda solution: solution.restrict(a=(0.9, 1.2)),
    "fix": lambda solution: solution.fix(c=1.0),
    "output": lambda solution: solution.output({"area": "integral(x, 0, 4)", "twice": "2*x"}),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", [*SMALLER, "log"])
def test_further_solutions(name, tmp_path):
    """Smaller solutions, outputs, and a parameter with a scale, beside roots of heights."""
    if name == "log":
        box, end = {"a": (0.7, 1.4, "log"), "c": (0.9, 1.1)}, (0, 4)
        start = {"x": 0, "v": "a"}
        solution = ro.solve(ro.Problem.from_strings(FREE, start, box, end, events=[KICK]), RTOL)
    else:
        solution = SMALLER[name](solved("kicked"))
    assert solution.success
    model = imported(solution.export(tmp_path / "model.py"))
    where = points(solution)
    at = without_time(solution, where) if solution.metadata.timeless else where
    wanted = values(solution, at)
    assert_close(model.value(where), wanted)
    gradient = model.gradient(where)
    if COMPILER:
        solution.export(tmp_path / "model.c")
        ours, slopes_in_c, _ = run_driver(compiled_driver(tmp_path, "-O2"), solution, where)
        assert_close(ours, wanted)
        assert_close(slopes_in_c, gradient, 1e-8)
    if node.NODE:
        solution.export(tmp_path / "model.mjs")
        ours, _, slopes_in_js, _ = node.run_driver(tmp_path, solution, where)
        assert_close(ours, wanted)
        assert_close(slopes_in_js, gradient[:, 1:], 1e-8)


def test_the_file_needs_numpy_alone(tmp_path):
    solved("sliver").export(tmp_path / "model.py")
    script = (
        "import sys; sys.modules |= dict.fromkeys(['rankone', 'sympy', 'scipy'])\n"
        "import model; print(model.value(t=1, a=1)[0])"
    )
    run = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    assert float(run.stdout) == pytest.approx(np.sin(1.0), rel=RTOL)


def test_the_file_is_formatted(tmp_path):
    pytest.importorskip("ruff")
    for name in ("washed", "kicked", "sliver"):
        solved(name).export(tmp_path / f"{name}.py")
    config = ["--no-cache", "--config", str(ROOT / "pyproject.toml"), str(tmp_path)]
    for command in (["check"], ["format", "--check", "--diff"]):
        ruff = [sys.executable, "-m", "ruff", *command, *config]
        run = subprocess.run(ruff, capture_output=True, text=True)
        assert run.returncode == 0, run.stdout + run.stderr


TIMES = """
const points = {points};
const plain = (values) => [...values].map((value) => (Number.isNaN(value) ? null : value));
console.log(JSON.stringify({
  times: Object.fromEntries(
    m.events.map((event) => [event, points.map((p) => plain(m.eventTimes(event, p)))]),
  ),
  ends: points.map((p) => plain([m.end(p)])[0]),
  borders: points.map((p) => plain(m.borders(p))),
  branches: points.map((p) => m.branch(p)),
  curves: points.map((p) => plain(m.curve(p, {times}))),
  instants: m.instants,
}));
"""


@needs_node
@pytest.mark.parametrize("name", NAMES)
def test_javascript(name, tmp_path):
    solution = solved(name)
    solution.export(tmp_path / "model.mjs")
    model = imported(solution.export(tmp_path / "model.py"))
    where = points(solution)
    ours, batch, gradient, rates = node.run_driver(tmp_path, solution, where)
    assert_close(ours, values(solution, where))
    np.testing.assert_array_equal(batch, ours)
    assert_close(gradient, slopes(solution, where), 1e-8)
    assert_close(rates, model.gradient(where)[:, 0], 1e-8)
    plain = node.run_driver(tmp_path, solution, where, "plain")
    for one, other in zip((ours, batch, gradient, rates), plain):
        np.testing.assert_array_equal(one, other)


@needs_node
@pytest.mark.parametrize("name", NAMES)
def test_times_of_events_in_javascript(name, tmp_path):
    """Also curves, whose values are those of single points, and which order holds."""
    solution = solved(name)
    solution.export(tmp_path / "model.mjs")
    model = imported(solution.export(tmp_path / "model.py"))
    at = without_time(solution, points(solution, 400))
    times = np.linspace(*solution.time, 7)
    fields = {
        "points": json.dumps([dict(zip(at, map(float, row))) for row in zip(*at.values())]),
        "times": json.dumps(times.tolist()),
    }
    script = re.sub(r"{(points|times)}", lambda match: fields[match[1]], TIMES)
    said = node.script(tmp_path, script)
    assert said["times"].keys() == set(solution.timeline.events)
    for event, rows in said["times"].items():
        wanted = solution.event_times(event, at)
        assert np.shape(rows) == wanted.T.shape
        if wanted.size:
            assert_close(np.array(rows, dtype=float).T, wanted)
    assert_close(np.array(said["ends"], dtype=float), solution.end(at))
    assert_close(np.array(said["borders"], dtype=float).T, solution._borders((at,), {})[0])
    assert said["branches"] == model.branch(at).tolist() == solution.branch(at).tolist()
    curves = np.array(said["curves"], dtype=float).reshape(400, len(solution.unknowns), -1)
    singly = model.value({"t": times[:, None], **at})
    assert_close(
        curves.transpose(1, 2, 0).reshape(len(singly), -1), singly.reshape(len(singly), -1)
    )
    wanted = [[list(names) for names in branch.met] for branch in solution.timeline.branches]
    assert said["instants"] == wanted


TIMES_DRIVER = r"""
#include <stdio.h>
#include "model.h"

/* parameters of points from standard input: for each one times of events, the end, the order */
int main(void)
{
    double p[MODEL_PARAMETERS], times[MODEL_INSTANTS + 1], end;
    int k, order;

    for (k = 0; k < MODEL_INSTANTS; k++)
        printf("%s ", model_instant_names[k]);
    printf("\n");
    for (;;) {
        for (k = 0; k < MODEL_PARAMETERS; k++)
            if (scanf("%lf", &p[k]) != 1)
                return 0;
        if (model_event_times(p, times) || model_end(p, &end) || model_branch(p, &order))
            return 1;
        for (k = 0; k < MODEL_INSTANTS; k++)
            printf("%.17g ", times[k]);
        printf("%.17g %d\n", end, order);
    }
}
"""


@needs_compiler
@pytest.mark.parametrize("name", NAMES)
def test_c(name, tmp_path):
    solution = solved(name)
    solution.export(tmp_path / "model.c")
    model = imported(solution.export(tmp_path / "model.py"))
    where = points(solution)
    wanted, derivatives = values(solution, where), model.gradient(where)
    for flags, count in (["-O2"], None), ([*SANITIZED, "-DMODEL_PORTABLE"], SANITIZED_COUNT):
        first = {key: row[:count] for key, row in where.items()}
        ours, gradients, batch = run_driver(compiled_driver(tmp_path, *flags), solution, first)
        assert_close(ours, wanted[:, :count])
        assert_close(gradients, derivatives[..., :count], 1e-8)
        np.testing.assert_array_equal(batch, ours)


@needs_compiler
@pytest.mark.parametrize("name", NAMES)
def test_times_of_events_in_c(name, tmp_path):
    solution = solved(name)
    solution.export(tmp_path / "model.c")
    source, program = tmp_path / "times.c", tmp_path / "times"
    source.write_text(TIMES_DRIVER)
    files = [str(source), str(tmp_path / "model.c"), "-lm"]
    subprocess.run([COMPILER, *STRICT, "-o", str(program), *files], check=True)
    at = without_time(solution, points(solution, 400))
    text = "\n".join(" ".join(map(repr, map(float, row))) for row in zip(*at.values()))
    run = subprocess.run([str(program)], input=text, capture_output=True, text=True)
    assert run.returncode == 0
    head, *lines = run.stdout.splitlines()
    columns = np.array([line.split() for line in lines], dtype=float).T
    *times, end, order = columns
    assert set(head.split()) <= set(solution.timeline.events)
    for event in solution.timeline.events:
        ours = [row for row, own in zip(times, head.split(), strict=True) if own == event]
        wanted = solution.event_times(event, at)
        assert len(ours) == len(wanted)
        if ours:
            assert_close(np.array(ours), wanted)
    assert_close(end, solution.end(at))
    np.testing.assert_array_equal(order, solution.branch(at))


@needs_compiler
@pytest.mark.parametrize("name", ["washed", "kicked", "sliver"])
@pytest.mark.parametrize("flags", [("-DMODEL_FLOAT",), ("-O3", "-ffast-math")])
def test_c_in_other_arithmetics(name, flags, tmp_path):
    """In single precision, and where the compiler takes it that there is no NaN."""
    solution = solved(name)
    solution.export(tmp_path / "model.c")
    program = compiled_driver(tmp_path, *flags)
    where = points(solution, 500)
    ours, wanted = run_driver(program, solution, where)[0], values(solution, where)
    both = ~np.isnan(ours) & ~np.isnan(wanted)
    assert (np.isnan(ours) == np.isnan(wanted)).mean() >= 0.99
    size = np.nanmax(np.abs(wanted), axis=1, keepdims=True)
    assert ((np.abs(ours - wanted) <= 1e-4 * size) | ~both).mean() >= 0.99
