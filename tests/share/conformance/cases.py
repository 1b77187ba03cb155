"""Solutions of every kind that can be exported, each solved once.

`CASES` is the one list: names, kinds, and which languages take the case in every run.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import scipy.sparse
import sympy as sp

import rankone as ro
from rankone.solvers.outcome import SolutionMetadata
from rankone.tensors.train import Train
from rankone.trajectories.system.timeline import BranchedTimeline, Timeline
from tests.problems import EXAMPLES
from tests.share.export.solutions import (
    solved,
    synthetic,
    synthetic_with_breaks,
    synthetic_with_scales,
)
from tests.solution.test_changing_orders import DOSE, WASHED, text
from tests.solution.test_opened_events import DOWN, KICK, KICKED, UP

RTOL = 1e-3
COUNT = 400
"""Points at which models are asked."""


@dataclass(frozen=True)
class Case:
    """A solution to export.

    Attributes
    ----------
    kind : str
        "plain", "events", "branches" or "many states".
    make : callable
    often : str
        Languages that have it in every run, beside Python and JavaScript: pages, which have
        statistics, and those that take a compiler have all others in the slow runs.
    slow : bool
        Whether it takes long to solve.
    """

    kind: str
    make: Callable[[], ro.Solution]
    often: str = ""
    slow: bool = False


# --- events ------------------------------------------------------------------------------------


def event(when, direction, name, then=None, **further):
    return {"when": when, "direction": direction, "name": name, **further} | (
        {"then": then} if then else {}
    )


BALL = text(
    {"y": "v", "v": "-9.81 - c*v*abs(v)"},
    {"y": "h", "v": 0},
    {"h": (0.8, 1.2), "c": (0.04, 0.06), "e": (0.78, 0.82)},
    1.6,
    event("y", "falling", "bounce", {"y": 0, "v": "-e*v"}),
)
LAGGED = text(
    {"A": "r - k*A", "r": "0"},
    {"A": 0, "r": 0},
    {"k": (0.2, 0.5), "lag": (0.5, 2), "span": (1.5, 2.5)},
    8,
    event("t - lag", "rising", "start", {"r": 1}),
    event("t - lag - span", "rising", "stop", {"r": 0}),
)
# drops a stage, and for most parameters comes back before the horizon ends
ROCKET = text(
    {"h": "v", "v": "f*(1 - s)/m - 9.81", "m": "-9*(1 - s)", "s": "0"},
    {"h": 0, "v": 0, "m": "2*d", "s": 0},
    {"f": (3000, 3400), "d": (95, 105)},
    13.5,
    event("m - 1.7*d", "falling", "drop", {"m": "1.2*d", "s": 1}),
    event("h", "falling", "ground", terminal=True),
)


PROBLEMS = {"ball": BALL, "dose": LAGGED, "rocket": ROCKET}
"""With one order of events, and all that events can do: resets, known times, an end."""


def two_runs():
    """The ball with other cores in its later slabs."""
    ball = solution_of("ball")
    slabs = list(ball.outcome.slabs)
    for k in range(len(slabs) // 2, len(slabs)):
        first, second, *cores = slabs[k].cores
        slabs[k] = replace(slabs[k], train=Train((0.5 * first, 2.0 * second, *cores)))
    return ro.Solution(replace(ball.outcome, slabs=tuple(slabs)), ball.metadata)


# --- orders of events that change inside the box -----------------------------------------------

FREE = {"x": "v", "v": "-x"}
RUB = {"x": "v", "v": "-x - mu*sign(v)"}
LEVEL = event("x - 1.395", "rising", "kick", {"v": "-v"})
END = event("x - 0.3", "falling", "end", terminal=True)
THROWN = {"x": 0, "v": "a"}

# a guard at a turning point decides
RUBBING = text(RUB, {"x": "a", "v": 0}, {"a": (1.5, 2.5), "mu": (0.3, 0.4)}, 9)
# four branches, one of them over two roots
BRAKED = text(FREE, THROWN, {"a": (0.8, 1.5), "c": (0.9, 1.1)}, 5.5, UP, DOWN)
# one branch, and an event that it grazes in a sliver
SLIVER = text(FREE, THROWN, {"a": (0.7, 1.4)}, 4, LEVEL)
# an event that may be past at the start
LATE = text({"x": "-x/2"}, {"x": 1}, {"a": (-1, 1.5)}, 3, DOSE)
ENDED = text({"x": "-k*x"}, {"x": 1}, {"a": (1, 3), "k": (0.3, 0.9)}, 5, DOSE, END)
KICKED_IN_A_SCALE = text(FREE, THROWN, {"a": (0.7, 1.4, "log"), "c": (0.9, 1.1)}, 4, KICK)


# --- many states -------------------------------------------------------------------------------


def bar():
    """Heat in seventy cells."""
    n, t, k = 70, *sp.symbols("t k")
    second = scipy.sparse.diags([-1.0, 2.0, -1.0], [-1, 0, 1], shape=(n, n)) * (n + 1) ** 2
    heated = np.zeros(n)
    heated[0] = (n + 1) ** 2
    problem = ro.Problem.from_matrices(
        None,
        scipy.sparse.eye(n),
        {k: second},
        {k: heated},
        time=(t, 0, 0.3),
        parameters={k: (0.7, 1.4)},
        initial=np.zeros(n),
        names="u",
    )
    return ro.solve(problem, rtol=RTOL)


# --- smaller solutions -------------------------------------------------------------------------


def with_units():
    solution = solved("decay")
    units = (("t", "h"), ("k", "1/h"), ("u", "µg/m³"))
    return ro.Solution(solution.outcome, replace(solution.metadata, units=units))


def _problem(problem: ro.Problem) -> Callable[[], ro.Solution]:
    return lambda: ro.solve(problem, RTOL)


def _example(name: str) -> Callable[[], ro.Solution]:
    return lambda: solved(name)


CASES: Mapping[str, Case] = {
    **{name: Case("plain", _example(name)) for name in EXAMPLES},
    "synthetic": Case("plain", synthetic),
    "unequal": Case("plain", synthetic_with_breaks, often="c"),
    "scaled": Case("plain", synthetic_with_scales),
    "no parameters": Case("plain", lambda: solved("decay").fix(k=2.0)),
    "no time": Case("plain", lambda: solved("decay").at(1.0)),
    "units": Case("plain", with_units, often="c page fmu2 fmu3"),
    "ball": Case("events", _problem(BALL)),
    "dose": Case("events", _problem(LAGGED)),
    "rocket": Case("events", _problem(ROCKET), often="c fmu2"),
    "rocket, fixed": Case("events", lambda: solution_of("rocket").fix(d=100.0), often="page"),
    "two runs": Case("events", two_runs, often="c"),
    "washed": Case("branches", _problem(WASHED), often="c fmu3"),
    "rubbing": Case("branches", _problem(RUBBING)),
    # one branch is smooth over the root of a height that another one gives
    "kicked": Case("branches", _problem(KICKED), often="c"),
    "braked": Case("branches", _problem(BRAKED), slow=True),
    "sliver": Case("branches", _problem(SLIVER)),
    "late": Case("branches", _problem(LATE)),
    "ended": Case("branches", _problem(ENDED)),
    "kicked, in a scale": Case("branches", _problem(KICKED_IN_A_SCALE), slow=True),
    "kicked, at": Case("branches", lambda: solution_of("kicked").at(3.0), slow=True),
    "kicked, part": Case(
        "branches", lambda: solution_of("kicked").restrict(a=(0.9, 1.2)), slow=True
    ),
    "kicked, fixed": Case("branches", lambda: solution_of("kicked").fix(c=1.0), often="page"),
    "kicked, outputs": Case(
        "branches",
        lambda: solution_of("kicked").output({"area": "integral(x, 0, 4)", "twice": "2*x"}),
        slow=True,
    ),
    "rubbing, fixed": Case("branches", lambda: solution_of("rubbing").fix(a=1.8, mu=0.33)),
    "bar": Case("many states", bar),
}


@cache
def solution_of(name: str) -> ro.Solution:
    solution = CASES[name].make()
    assert solution.success
    return solution


def timeline(name: str) -> Timeline | BranchedTimeline | None:
    return solution_of(name).outcome.timeline


# --- what a solution says, to be compared with ---------------------------------------------------


@dataclass(frozen=True)
class Answers:
    """What a solution or a model says at points.

    Attributes
    ----------
    values : ndarray, shape (unknowns, N)
    rates : ndarray, shape (unknowns, N)
        Derivatives in time.
    gradient : ndarray, shape (unknowns, parameters, N)
    batch : ndarray, shape (unknowns, N)
        Values again, asked for all points at once.
    times : dict of ndarray, shape (occurrences, N)
        By event; empty without events.
    end : ndarray, shape (N,)
    branch : ndarray, shape (N,)
    unknowns, parameters : tuple of str
    units : dict
    ranges : ndarray, shape (1 + parameters, 2)
    refused : list of str
        For each coordinate below, above, and not a number: what became of it.
    """

    values: np.ndarray
    rates: np.ndarray | None = None
    gradient: np.ndarray | None = None
    batch: np.ndarray | None = None
    times: Mapping[str, np.ndarray] | None = None
    end: np.ndarray | None = None
    branch: np.ndarray | None = None
    unknowns: tuple[str, ...] | None = None
    parameters: tuple[str, ...] | None = None
    units: Mapping[str, str] | None = None
    ranges: np.ndarray | None = None
    refused: tuple[str, ...] | None = None


@cache
def points(name: str) -> dict[str, np.ndarray]:
    """Random points by name, some at corners of the box, ends of slabs, breaks, and at events."""
    solution = solution_of(name)
    metadata: SolutionMetadata = solution.metadata
    rng = np.random.default_rng(2)
    box = {metadata.time: solution.time, **solution.parameters}
    where = {}
    for key, (a, b) in box.items():
        where[key] = np.clip(a + (b - a) * rng.random(COUNT), a, b)
    for key, ends in solution.parameters.items():
        where[key][::3] = rng.choice(ends, len(where[key][::3]))
    clock = where[metadata.time]
    clock[:2] = solution.time
    if timeline(name) is None:
        ends = [slab.end for slab in solution.outcome.slabs][: COUNT // 8]
        clock[2 : 2 + len(ends)] = np.clip(ends, *solution.time)
        for j, key in enumerate(solution.parameters):
            breaks = [x for s in solution.outcome.slabs for x in s.bases[j].breaks][: COUNT // 8]
            where[key][COUNT - len(breaks) :] = breaks
        return where
    if "lag" in box:
        clock[2::5] = where["lag"][2::5]
        clock[3::5] = where["lag"][3::5] + where["span"][3::5]
    if name == "washed":  # both events at one time: it is not known which order holds
        where["b"][7::25] = np.clip(where["a"][7::25], *solution.parameters["b"])
    at = {key: where[key][4::20] for key in solution.parameters}
    for times in solution.event_times(timeline(name).events[0], at)[:1]:
        clock[4::20] = np.where(np.isfinite(times), times, clock[4::20])
    return where


def without_time(name: str, where: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {key: where[key] for key in solution_of(name).parameters}


def along(values) -> np.ndarray:
    """For every point, also where nothing depends on parameters."""
    values = np.asarray(values)
    return values if values.shape[-1:] == (COUNT,) else np.repeat(values[..., None], COUNT, -1)


@cache
def reference(name: str) -> Answers:
    """What the solution itself says."""
    solution, where = solution_of(name), points(name)
    at = without_time(name, where)
    here = at if solution.metadata.timeless else where
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ro.RankoneWarning)  # of what is undecided
        values, gradient = solution(here), solution.gradient(here)
    shape = len(solution.unknowns), COUNT
    values = np.broadcast_to(np.reshape(values, (shape[0], -1)), shape)
    assert np.isnan(values).mean() < 0.5
    events = timeline(name)
    return Answers(
        values=values,
        gradient=np.reshape(gradient, (shape[0], len(at), COUNT)),
        times={e: along(solution.event_times(e, at)) for e in events.events} if events else {},
        end=along(solution.end(at)) if events else None,
        branch=along(solution.branch(at)) if isinstance(events, BranchedTimeline) else None,
        unknowns=tuple(solution.unknowns),
        parameters=tuple(solution.parameters),
        units=dict(solution.metadata.units),
        ranges=np.array([solution.time, *solution.parameters.values()], dtype=float),
    )
