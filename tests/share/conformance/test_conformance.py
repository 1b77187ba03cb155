"""Models in all languages say what the solutions say that they were made from.

Every case of `cases.CASES` in every language: C and FMUs, which take a compiler, have a few of each
kind in every run and all of them in the slow ones.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.problems import EXAMPLES
from tests.share.conformance.cases import (
    CASES,
    RTOL,
    points,
    reference,
    solution_of,
    timeline,
    without_time,
)
from tests.share.conformance.languages import (
    FMI,
    FMU_POINTS,
    NAMES,
    OFFERED,
    SANITIZED,
    skip_without_tools,
)

ROOT = Path(__file__).parents[3]


def is_slow(language, name):
    case = CASES[name]
    return case.slow or language not in ("python", "javascript", *case.often.split())


ALIKE = {*EXAMPLES} - {"lotka_volterra"} | {n for n in CASES if ", " in n} | {"bar"}
"""For FMUs, sanitizers and plain JavaScript like others: the code is that of C, or with
WebAssembly, which has all cases."""


def in_version(language, name):
    """For FMUs: the versions share their C, so that they take cases by turns, and often ones."""
    unlike = [n for n in CASES if n not in ALIKE]
    if name in ALIKE or language in CASES[name].often.split():
        return name not in ALIKE
    return [*FMI][unlike.index(name) % 2] == language


def matrix(*attributes, kinds=None, languages=NAMES):
    """Languages that offer all attributes, times cases."""
    return pytest.mark.parametrize(
        ("language", "name"),
        [
            pytest.param(
                language, name, marks=[pytest.mark.slow] if is_slow(language, name) else []
            )
            for name, case in CASES.items()
            for language in languages
            if OFFERED[language].issuperset(attributes)
            and (kinds is None or case.kind in kinds)
            and (language != "page" or "page" in case.often)
            and (language not in FMI or in_version(language, name))
        ],
    )


def assert_close(values, wanted, tolerance=1e-12):
    """Within a tolerance of the largest value along the points, and NaN at the same."""
    assert np.shape(values) == np.shape(wanted)
    np.testing.assert_array_equal(np.isnan(values), np.isnan(wanted))
    if np.size(values) and not np.isnan(values).all():
        size = np.maximum(np.nanmax(np.abs(wanted), axis=-1, keepdims=True), 1e-6)
        assert np.nanmax(np.abs(values - wanted) / size) <= tolerance


def assert_slopes(slopes, wanted, values, width, tolerance=1e-8):
    """Where an unknown hardly depends on a coordinate, its derivative is rounding."""
    np.testing.assert_array_equal(np.isnan(slopes), np.isnan(wanted))
    size = np.nanmax(np.abs(values), axis=-1, keepdims=True) / width
    size = np.maximum(size, np.nanmax(np.abs(wanted), axis=-1, keepdims=True, initial=0.0))
    assert np.nanmax(np.abs(slopes - wanted) / np.maximum(size, 1e-6), initial=0.0) <= tolerance


# --- in every language -------------------------------------------------------------------------


@matrix("values")
def test_values(language, name, models):
    """To the last digits, and NaN at the same points."""
    ours, wanted = models.answers(language, name).values, reference(name).values
    count = ours.shape[1]
    if language in FMI:  # whose times are sums of steps: none is the time of an event
        apart = at_no_event(name)[:count]
        assert apart.mean() > 0.5
        assert_close(ours[:, apart], wanted[:, :count][:, apart], 1e-9)
    else:
        assert count == wanted.shape[1]
        assert_close(ours, wanted)


def at_no_event(name):
    """Points whose time is that of no event, nor of an end, but for rounding."""
    solution, clock = solution_of(name), points(name)[solution_of(name).metadata.time]
    apart = np.ones(clock.size, dtype=bool)
    wanted = reference(name)
    for times in (wanted.times or {}).values():
        apart &= ~(np.abs(times - clock) <= 1e-8).any(axis=0)
    if wanted.end is not None:
        apart &= ~(np.abs(wanted.end - clock) <= 1e-8) | (clock == solution.time[1])
    return apart


@matrix("batch")
def test_batches_have_the_same_bits(language, name, models):
    answers = models.answers(language, name)
    if language == "python":  # sums over points in another order
        assert_close(answers.batch, answers.values)
    else:
        np.testing.assert_array_equal(answers.batch, answers.values)


@matrix("gradient")
def test_derivatives(language, name, models):
    answers, wanted = models.answers(language, name), reference(name)
    count = FMU_POINTS if language in FMI else wanted.values.shape[1]
    apart = at_no_event(name)[:count]
    widths = np.diff(wanted.ranges[1:])
    assert_slopes(
        answers.gradient[..., apart],
        wanted.gradient[..., :count][..., apart],
        wanted.values[:, None],
        widths,
    )
    if language != "python":
        rates = models.answers("python", name).rates
        width = np.diff(wanted.ranges[0])
        assert_slopes(answers.rates[:, apart], rates[:, :count][:, apart], wanted.values, width)


@matrix("times", kinds=("events", "branches"))
def test_times_of_events(language, name, models):
    answers, wanted = models.answers(language, name), reference(name)
    assert answers.times.keys() == wanted.times.keys()
    for event, times in wanted.times.items():
        if times.size:
            assert_close(answers.times[event], times)
        else:
            assert answers.times[event].size == 0
    assert_close(answers.end, wanted.end)
    assert (answers.branch is None) == (wanted.branch is None)
    if wanted.branch is not None:
        np.testing.assert_array_equal(answers.branch, wanted.branch)


@matrix("unknowns", "parameters", "ranges")
def test_names_and_ranges(language, name, models):
    answers, wanted = models.answers(language, name), reference(name)
    assert tuple(answers.unknowns) == wanted.unknowns
    assert tuple(answers.parameters) == wanted.parameters
    np.testing.assert_array_equal(answers.ranges, wanted.ranges)
    if "units" in OFFERED[language]:
        assert answers.units == wanted.units


@matrix("refused")
def test_nothing_is_extrapolated(language, name, models):
    """Outside the box, and for what is not a number, there is an error and no value."""
    refused, parameters = models.answers(language, name).refused, reference(name).parameters
    if language in FMI:  # of parameters, and all with one status
        assert refused == ("range",) * 3 * len(parameters)
    else:
        assert refused == ("range", "range", "NaN") * (1 + len(parameters))


# --- derivatives in time, of which solutions with events have none ------------------------------


@matrix("rates", languages=["python"])
def test_rates_are_differences(language, name, models):
    """Away from events; Python's are what other languages are compared with."""
    model, where, solution = models.imported(name), points(name), solution_of(name)
    if solution.metadata.timeless:
        assert np.abs(models.answers(language, name).rates).max() < 1e-12
        return
    start, end = solution.time
    step = 1e-6 * (end - start)
    clock = solution.metadata.time
    inner = {**where, clock: np.clip(where[clock] + 2 * step, start + 2 * step, end - 2 * step)}
    ahead, behind = (model.value({**inner, clock: inner[clock] + by}) for by in (step, -step))
    rates, ours = (ahead - behind) / (2 * step), model.gradient(inner)[:, 0]
    size = np.nanmax(np.abs(ours), axis=1, keepdims=True)
    close = np.abs(rates - ours) <= 1e-4 * np.maximum(size, 1e-6)
    assert (close | np.isnan(rates)).mean() >= 0.98


# --- one language ------------------------------------------------------------------------------

SMALLER = {"decay": 1e-4, "lotka_volterra": 1e-2, "ball": 1e-3, "rocket": 1e-3}
SMALLER |= dict.fromkeys(("washed", "rubbing", "kicked", "sliver", "late", "ended", "braked"), 3e-3)


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] * CASES[n].slow) for n in SMALLER]
)
def test_smaller_models_are_within_the_tolerance(name, models):
    """At clock times further than rtol horizons from events, where both know the order."""
    solution, rtol, wanted = solution_of(name), SMALLER[name], reference(name)
    full, model = models.imported(name), models.imported(name, rtol)
    where = points(name)
    at = without_time(name, where)
    ours, (start, end) = model.value(where), solution.time
    near = np.zeros(ours.shape[1], dtype=bool)
    known = ~near
    if hasattr(model, "branch"):  # elsewhere times may be of another order
        decision = model.MODEL._decision(np.array(list(at.values())))
        known = (decision.ahead >= model.WIDTH).all(axis=0)
    if timeline(name):
        clock = where[solution.metadata.time]
        near |= np.abs(wanted.end - clock) <= rtol * end
        for event, times in wanted.times.items():
            near |= (np.abs(times - clock) <= rtol * (end - start)).any(axis=0)
            moved = np.abs(times - model.event_times(event, at))[:, known]
            assert np.nanmax(moved, initial=0.0) <= rtol * (end - start)
    size = np.nanmax(np.abs(wanted.values), axis=1, keepdims=True)
    assert np.nanmax(np.abs(ours - wanted.values)[:, ~near] / size) <= rtol
    further = np.isnan(ours).any(axis=0) & ~np.isnan(wanted.values).any(axis=0) & ~near
    assert further.mean() <= 5.0 * rtol  # known to rtol less: a width of the box in each of them
    assert model.COEFFICIENTS.size <= full.COEFFICIENTS.size
    if name in ("lotka_volterra", "ball", "washed", "kicked", "ended"):
        assert model.COEFFICIENTS.size < 0.9 * full.COEFFICIENTS.size
    said = " ".join(model.__doc__.split())
    if CASES[name].kind == "branches" and hasattr(model, "branch"):
        assert "where it is known which order of events holds; measured" in said
    elif timeline(name):
        assert f"away from events by {rtol:g} of the horizon" in said


def test_shapes_and_names_of_event_times(models):
    solution, model = solution_of("ball"), models.imported("ball")
    at = {"h": [0.9, 1.0, 1.1], "c": 0.05, "e": [[0.79], [0.8]]}
    assert model.event_times("bounce", at).shape == solution.event_times("bounce", at).shape
    first = model.event_times("bounce", h=1.0, c=0.05, e=0.8)[0]
    after = model.value(t=first, h=1.0, c=0.05, e=0.8)
    assert after[1] > 0.0  # it flies up again
    with pytest.raises(ValueError, match="no event bonce"):
        model.event_times("bonce", at)
    with pytest.raises(ValueError, match="were given, not h, c, e"):
        model.event_times("bounce", {**at, "t": 1.0})


def test_where_the_order_is_undecided(models):
    """Values before the events and the times of these are known there, later values are not."""
    model = models.imported("washed")
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
    assert "Next to a change" in model.__doc__


def test_all_states_of_branches(models):
    solution = solution_of("rubbing")
    model = models.exported("rubbing", ".py", states="all")
    names = {}
    exec(model.read_text(), names)
    where = {key: row[:50] for key, row in points("rubbing").items()}
    assert names["UNKNOWNS"] == solution.states
    for name, row in zip(solution.states, names["value"](where), strict=True):
        assert_close(row[None], np.asarray(solution[name](where))[None])


@pytest.mark.parametrize("name", ["unequal", "sliver"])
def test_python_needs_numpy_alone(name, models):
    path = models.exported(name, ".py")
    at = {key: float(row[5]) for key, row in points(name).items()}
    script = (
        "import sys; sys.modules |= dict.fromkeys(['rankone', 'sympy', 'scipy'])\n"
        f"import model; print(*model.value({at!r}))"
    )
    command = [sys.executable, "-c", script]
    run = subprocess.run(command, cwd=path.parent, env={}, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    values = np.array(run.stdout.split(), dtype=float)
    np.testing.assert_allclose(values, reference(name).values[:, 5], rtol=1e-9)


def test_python_is_formatted(models):
    pytest.importorskip("ruff")
    names = ("decay", "kirchhoff", "synthetic", "unequal", "rocket", "washed", "kicked", "sliver")
    paths = [str(models.exported(name, ".py")) for name in names]
    config = ["--no-cache", "--config", str(ROOT / "pyproject.toml"), *paths]
    for command in (["check"], ["format", "--check", "--diff"]):
        ruff = [sys.executable, "-m", "ruff", *command, *config]
        run = subprocess.run(ruff, capture_output=True, text=True)
        assert run.returncode == 0, run.stdout + run.stderr


ONE_OF_A_KIND = ("unequal", "rocket", "washed")


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(n, marks=[pytest.mark.slow] * (n not in ONE_OF_A_KIND))
        for n in CASES
        if n not in ALIKE
    ],
)
def test_plain_c_under_sanitizers(name, models):
    """Also the same bits as with the instructions of this machine."""
    skip_without_tools("c")
    count = 100
    ours = models.c(name, *SANITIZED, "-DMODEL_PORTABLE", count=count)
    wanted = models.answers("c", name)
    assert_close(ours.values, wanted.values[:, :count])
    np.testing.assert_array_equal(ours.batch, ours.values)
    assert_slopes(ours.rates, wanted.rates[:, :count], wanted.values, 1.0, 1e-12)
    assert_slopes(ours.gradient, wanted.gradient[..., :count], wanted.values[:, None], 1.0, 1e-12)
    assert ours.refused == wanted.refused


FLAGS = ("-DMODEL_FLOAT",), ("-O3", "-ffast-math")
ROUNDED = {FLAGS[0]: ("unequal", "scaled", "washed", "kicked"), FLAGS[1]: ("unequal", "sliver")}


@pytest.mark.parametrize(("flags", "name"), [(f, n) for f in FLAGS for n in ROUNDED[f]])
def test_c_in_other_arithmetics(name, flags, models):
    """In single precision, and where the compiler takes it that there is no NaN."""
    skip_without_tools("c")
    ours, wanted = models.c(name, *flags), reference(name)
    both = ~np.isnan(ours.values) & ~np.isnan(wanted.values)
    assert (np.isnan(ours.values) == np.isnan(wanted.values)).mean() >= 0.97
    size = np.nanmax(np.abs(wanted.values), axis=1, keepdims=True)
    close = np.abs(ours.values - wanted.values) <= 2e-4 * size
    # the rounded time is on either side of the end of a slab
    assert (close | ~both).mean() >= 0.97
    assert ours.refused == models.answers("c", name).refused


def test_positions_of_instants_in_c(models):
    models.exported("two runs", ".c")
    header = (models.exported("two runs", ".c").with_suffix(".h")).read_text()
    for event, times in reference("two runs").times.items():
        assert f"#define MODEL_T_{event}_{len(times) - 1} " in header
        assert f"#define MODEL_T_{event}_{len(times)} " not in header


PLAIN = ("kirchhoff", "scaled", "two runs", "washed")


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(n, marks=[pytest.mark.slow] * (n not in PLAIN))
        for n in CASES
        if n in PLAIN or n not in ALIKE
    ],
)
def test_javascript_without_webassembly(name, models):
    """The same bits."""
    skip_without_tools("javascript")
    plain = models.javascript("javascript", name, ("plain",))["plain"]
    assert plain == models.javascript("javascript", name)["fast"]


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] * CASES[n].slow) for n in CASES]
)
def test_curves_in_javascript(name, models):
    """They have the values of single points."""
    skip_without_tools("javascript")
    said = models.javascript("javascript", name)["fast"]
    curve = np.array(said["curve"], dtype=float).reshape(len(said["unknowns"]), -1)
    assert_close(curve, np.array(said["singly"], dtype=float).T)


@pytest.mark.parametrize("name", [n for n in CASES if "page" in CASES[n].often])
def test_a_page_has_the_model_of_javascript(name, models):
    skip_without_tools("page")
    page, module = (models.javascript(kind, name)["fast"] for kind in ("page", "javascript"))
    assert page == module


@pytest.mark.parametrize("name", [n for n in CASES if CASES[n].often])
def test_what_javascript_declares(name, models):
    """Types have every export, by name, and the names of events."""
    skip_without_tools("javascript")
    said = models.javascript("javascript", name)["fast"]
    types = models.exported(name, ".mjs").with_suffix(".d.mts").read_text()
    declared = re.findall(r"^export (?:const|class|function) (\w+)", types, re.M)
    assert set(declared) == set(said["exports"])
    if timeline(name) is None:
        return
    solution = solution_of(name)
    assert f"EventName = {' | '.join(json.dumps(e) for e in timeline(name).events)};" in types
    at = without_time(name, points(name))
    assert_close(np.array(said["borders"], dtype=float).T, solution._borders((at,), {})[0])
    branches = getattr(timeline(name), "branches", None)
    met = [branch.met for branch in branches or [timeline(name)]]
    instants = [[list(names) for names in each] for each in met]
    assert said["instants"] == (instants if branches else instants[0])
    assert said["written"]
    assert said["unknownEvent"] == "UnknownEventError"
    assert said["missing"] == ("MissingParameterError" if solution.parameters else "ShapeError")


def test_every_kind_has_cases_in_every_run():
    kinds = {case.kind for case in CASES.values() if not case.slow}
    assert kinds == {"plain", "events", "branches", "many states"}
    for language in NAMES[:4]:
        often = {CASES[name].kind for name in CASES if not is_slow(language, name)}
        assert often >= {"plain", "events", "branches"}
    assert RTOL == 1e-3
