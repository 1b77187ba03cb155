"""Solve systems with events and print a Markdown table: python tests/benchmarks/events.py

Impacts, thresholds, relays, spikes and doses at unknown times. *claimed* is the measured error of
the solution over the tolerance, *true* the largest one at 25 random points × 40 random times, times
within rtol horizons of a reset left out, against single trajectories from the equations as they
were written (Problem.trajectory, rtol 1e-9); a success is *wrong* above 5. Seconds are of the
processor, for the solve alone. ``--fits`` fits 400 noisy data sets of a dose with an unknown lag.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import time
import warnings
from typing import Any

import numpy as np

import rankone as ro

WITHIN = 5.0
POINTS, TIMES = 25, 40


def event(
    when: str,
    direction: str,
    then: dict[str, Any] | None = None,
    name: str = "event",
    **further: Any,
) -> dict[str, Any]:
    """One event in text."""
    reset = {"then": then} if then else {}
    return {"when": when, "direction": direction, "name": name, **reset, **further}


def problem(
    rhs: dict[str, Any], initial: dict[str, Any], box: dict[str, Any], end: float, **further: Any
) -> ro.Problem:
    return ro.Problem.from_strings(rhs, initial, box, (0, end), **further)


DRAG = "c*sqrt(p**2 + q**2)"
BOUNCE = event("y", "falling", {"y": 0, "v": "-e*v"}, "bounce")
LAG = problem(
    {"A": "r - k*A", "r": "0"},
    {"A": 0, "r": 0},
    {"k": (0.2, 0.5), "lag": (0.5, 2), "span": (1.5, 2.5), "second": (5, 6)},
    10,
    events=[
        event("t - lag", "rising", {"r": 1}, "start"),
        event("t - lag - span", "rising", {"r": 0}, "stop"),
    ],
    jumps={"second": {"A": "A + 1"}},
)
SYSTEMS = {
    "bouncing ball with drag": (
        problem(
            {"y": "v", "v": "-9.81 - c*v*abs(v)"},
            {"y": "h", "v": 0},
            {"h": (0.9, 1.1), "c": (0.04, 0.06), "e": (0.83, 0.87)},
            3.05,
            events=[BOUNCE],
        ),
        1e-6,
    ),
    "ball on a moving table": (
        problem(
            {"y": "v", "v": "-9.81"},
            {"y": 1, "v": 0},
            {"w": (5, 6), "A": (0.02, 0.03), "e": (0.6, 0.7)},
            1.3,
            events=[
                event(
                    "y - A*sin(w*t)",
                    "falling",
                    {"y": "A*sin(w*t)", "v": "-e*v + (1 + e)*A*w*cos(w*t)"},
                    "hit",
                )
            ],
        ),
        1e-4,
    ),
    "projectile to a slope": (
        problem(
            {
                "x": "p",
                "y": "q",
                "p": f"-{DRAG}*p",
                "q": f"-9.81 - {DRAG}*q",
            },
            {"x": 0, "y": 0, "p": "w*cos(a)", "q": "w*sin(a)"},
            {"w": (15, 25), "a": (0.6, 0.9), "c": (0.001, 0.01)},
            6,
            events=[event("y - x/10", "falling", name="ground", terminal=True)],
        ),
        1e-4,
    ),
    "rocket that drops a stage": (
        problem(
            {
                "h": "v",
                "v": "f*(1 - 7*s/10)/m - 9.81 - v*abs(v)/(1000*m)",
                "m": "-q*(1 - 7*s/10)",
                "s": "0",
            },
            {"h": 0, "v": 0, "m": "2*d", "s": 0},
            {"f": (3000, 3400), "q": (9, 11), "d": (95, 105)},
            12,
            events=[event("m - 1.6*d", "falling", {"m": "1.2*d", "s": 1}, "drop")],
        ),
        1e-4,
    ),
    "thermostat": (
        problem(
            {"x": "-k*(x - 10) + f*s", "s": "0"},
            {"x": 15, "s": 1},
            {"k": (0.28, 0.32), "f": (9, 10), "low": (18.8, 19.2)},
            10,
            events=[
                event("x - 22", "rising", {"s": 0}, "off"),
                event("x - low", "falling", {"s": 1}, "on"),
            ],
        ),
        1e-4,
    ),
    "integrate-and-fire neuron": (
        problem(
            {"u": "(w - u)/tau"},
            {"u": 0},
            {"w": (1.4, 1.6), "tau": (9, 11), "top": (0.95, 1.05)},
            100,
            events=[event("u - top", "rising", {"u": 0}, "spike")],
        ),
        1e-4,
    ),
    "switching converter": (
        problem(
            {"i": "(24*s - u)/L", "u": "(i - u/R)/C", "s": "0"},
            {"i": 6, "u": 12, "s": 1},
            {"L": (0.9, 1.1), "C": (0.9, 1.1), "R": (1.9, 2.1)},
            3.2,
            events=[
                event("i - 7", "rising", {"s": 0}, "off"),
                event("i - 5", "falling", {"s": 1}, "on"),
            ],
        ),
        1e-4,
    ),
    "tank that runs empty": (
        problem(
            {"x": "-k*sqrt(x)"},
            {"x": 1},
            {"k": (0.9, 1.1)},
            3,
            events=[event("x - 0.01", "falling", name="empty", terminal=True)],
        ),
        1e-4,
    ),
    "infusion and dose": (LAG, 1e-4),
}


def error(system: ro.Problem, solution: ro.Solution, rtol: float) -> float:
    """Largest error over the size of the unknown; infinite where one has no value."""
    generator, end = np.random.default_rng(3), solution.time[1]
    box = np.array(list(solution.parameters.values()))
    worst, sizes = np.zeros(len(solution.unknowns)), np.zeros(len(solution.unknowns))
    for _ in range(POINTS):
        point = dict(zip(solution.parameters, generator.uniform(box[:, 0], box[:, 1]), strict=True))
        events = system.trajectory(np.array([end]), point, rtol=1e-9).events
        instants = np.concatenate([*events.values(), [-end]])
        times = np.sort(generator.uniform(0.0, end, TIMES))
        times = times[np.abs(times[:, None] - instants).min(axis=1) > 1.02 * rtol * end]
        exact, values = system.trajectory(times, point, rtol=1e-9).values, solution(times, point)
        if (np.isnan(exact) != np.isnan(values)).any():
            return np.inf
        worst = np.maximum(worst, np.nanmax(np.abs(values - exact), axis=1, initial=0.0))
        sizes = np.maximum(sizes, np.nanmax(np.abs(exact), axis=1, initial=0.0))
    return float((worst / sizes).max())


def table() -> None:
    """Print a line for each system, and the counts."""
    print("| system | rtol | stretches | trajectories | claimed | true | seconds | verdict |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | --- |")
    counts = dict.fromkeys(("ok", "refused", "wrong"), 0)
    for name, (system, rtol) in SYSTEMS.items():
        compiled = ro.compile(system)
        began = time.process_time()
        try:
            solution = compiled.solve(rtol)
        except ro.ConvergenceError as refusal:
            counts["refused"] += 1
            print(f"| {name} | {rtol:g} | | | | | | refused: {refusal} |", flush=True)
            continue
        seconds = time.process_time() - began
        true = error(system, solution, rtol) / rtol
        verdict = "refused"
        if solution.success:
            verdict = "ok" if true <= WITHIN else "wrong"
        counts[verdict] += 1
        sampled = sum(record.trajectories for record in solution.history)
        print(
            f"| {name} | {rtol:g} | {solution.timeline.stretches} | {sampled} | "
            f"{solution.error / rtol:.2g} | {true:.2g} | {seconds:.1f} | {verdict} |",
            flush=True,
        )
    print("\n" + ", ".join(f"{count} {verdict}" for verdict, count in counts.items()))


def fits(count: int) -> None:
    """Print how often the interval of each parameter holds the true value."""
    solution = ro.solve(LAG, 1e-4)
    truth = {"k": 0.33, "lag": 1.23, "span": 1.97, "second": 5.41}
    times, generator = np.linspace(0.4, 9.8, 20), np.random.default_rng(0)
    exact, inside = solution["A"](times, truth), dict.fromkeys(truth, 0)
    converged = said = near = 0
    for _ in range(count):
        data = exact + 0.03 * generator.normal(size=times.size)
        fit = solution.fit(times, data, observe="A", sigma=0.03)
        converged += fit.converged
        said += "the sum of squares jumps" in fit.message
        near += fit.converged and bool(fit.jumps)
        for name, (low, high) in fit.interval().items():
            inside[name] += low <= truth[name] <= high
    print(
        f"of {count}: {converged} converged, {near} of them with a jump inside an interval; {said} "
        f"ended at a jump and say so; inside the 95 % interval: {inside}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fits", action="store_true")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", ro.RankoneWarning)
    if arguments.fits:
        fits(400)
    else:
        table()


if __name__ == "__main__":
    main()
