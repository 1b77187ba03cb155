"""Solve systems whose rates switch and print a Markdown table: python tests/benchmarks/switches.py

Friction, stops, walls, rectifiers and saturation, at rtol 1e-4. *kept* is the largest error of a
success over the tolerance, against single trajectories with narrow smooth steps in place of the
switches, or by events from the equations as they are written; it is *wrong* above 5. Seconds are
those of the processor, compiling included. ``--oscillators`` solves long oscillations instead, at
1e-5, against single trajectories.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import time
import warnings

import numpy as np
import sympy as sp

import rankone as ro
from tests.honesty.cases import Case, t, unknown
from tests.honesty.verdicts import judged

RTOL = 1e-4
_POINTS, _TIMES = 6, 400

a, b, c = sp.symbols("a b c")
x, y, v, w = map(unknown, ("x", "y", "v", "w"))


def switching(name, unknowns, rates, initial, box, end, events=()) -> Case:
    """A case with switches; with events its truth is single trajectories."""
    return Case(
        name, unknowns, rates, initial, box, end, RTOL, [], [], events=list(events), switches=True
    )


def systems() -> list[Case]:
    """The systems of the table."""
    spring = 2 * (y - x) + sp.Rational(1, 5) * (w - v)
    stop = ro.Event(y - x - c, "falling", then={v: w, w: v}, name="stop")
    wall = ro.Event(x - c, "rising", then={v: -b * v}, name="wall")
    force = sp.Max(-1, sp.Min(1, -a * (x + 2 * v)))
    friction = a * sp.cos(t / 2) - x - b * sp.sign(v)
    masses = {a: (3.4, 3.6), b: (0.5, 0.55), c: (0.3, 0.35)}
    return [
        switching(
            "friction, one mass",
            [x, v],
            [v, friction],
            [0, c],
            {a: (1.6, 1.7), b: (0.5, 0.55), c: (0.45, 0.55)},
            15,
        ),
        switching(
            "friction, two masses",
            [x, v, y, w],
            [v, a * sp.cos(t / 2) - x + spring - b * sp.sign(v), w, -spring - c * sp.sign(w)],
            [0, sp.Rational(1, 2), 0, 0],
            masses,
            8,
        ),
        switching(
            "two masses with a stop",
            [x, v, y, w],
            [v, -a * x, w, -b * (y - 1)],
            [0, sp.Rational(3, 2), 1, 0],
            {a: (3.8, 4.2), b: (0.9, 1.1), c: (0.5, 0.6)},
            4,
            [stop],
        ),
        switching(
            "pendulum against a wall",
            [x, v],
            [v, -a * sp.sin(x) - v / 20],
            [-1, 0],
            {a: (0.9, 1.1), b: (0.6, 0.7), c: (0.2, 0.3)},
            10,
            [wall],
        ),
        switching(
            "diode rectifier",
            [x],
            [a * sp.Max(0, sp.sin(3 * t) - x - b) - c * x],
            [0],
            {a: (18, 22), b: (0.1, 0.15), c: (0.4, 0.6)},
            6,
        ),
        switching(
            "saturated controller",
            [x, v],
            [v, force - c * v],
            [b, 0],
            {a: (0.8, 1.2), b: (4, 5), c: (0.05, 0.1)},
            12,
        ),
    ]


def oscillators() -> dict[str, ro.Problem]:
    """Long oscillations in two parameters."""
    text = ro.Problem.from_strings
    prey = {"x": "x*(1.5 - y)", "y": "-y*(3 - x)"}, {"x": "a", "y": "b"}
    rates = {"v": "v - v**3/3 - w + a", "w": "b*(v + 0.7 - 0.8*w)"}
    nerve = {
        "v": "a - b*m**3*h*(v - 115) - 36*n**4*(v + 12) - 0.3*(v - 10.613)",
        "m": "0.1*(25 - v)/(exp((25 - v)/10) - 1)*(1 - m) - 4*exp(-v/18)*m",
        "h": "0.07*exp(-v/20)*(1 - h) - h/(exp((30 - v)/10) + 1)",
        "n": "0.01*(10 - v)/(exp((10 - v)/10) - 1)*(1 - n) - 0.125*exp(-v/80)*n",
    }
    chemistry = {"x": "a + x**2*y - (b + 1)*x", "y": "b*x - x**2*y"}
    return {
        "Lotka-Volterra, 36 periods": text(*prey, {"a": (8, 12), "b": (4, 6)}, (0, 120)),
        "FitzHugh-Nagumo, 30 periods": text(
            rates, {"v": -1, "w": -0.5}, {"a": (0.45, 0.55), "b": (0.07, 0.09)}, (0, 1100)
        ),
        "Brusselator, 20 periods": text(
            chemistry, {"x": 1, "y": 1}, {"a": (0.9, 1.1), "b": (2.8, 3.2)}, (0, 150)
        ),
        "van der Pol, 15 periods": text(
            {"x": "v", "v": "a*(1 - x**2)*v - x"},
            {"x": "b", "v": 0},
            {"a": (3, 6), "b": (1, 2)},
            (0, 150),
        ),
        "Hodgkin-Huxley, 10 periods": text(
            nerve,
            {"v": 0, "m": 0.0529, "h": 0.5961, "n": 0.3177},
            {"a": (10, 12), "b": (115, 125)},
            (0, 140),
        ),
        "pendulum, 20 periods": text(
            {"x": "v", "v": "-b*sin(x)"},
            {"x": "a", "v": 0},
            {"a": (2, 2.6), "b": (0.9, 1.1)},
            (0, 180),
        ),
    }


def long_oscillation(name: str, problem: ro.Problem, rtol: float) -> str:
    """A line of the table of oscillators."""
    began = time.process_time()
    solution = ro.solve(problem, rtol=rtol)
    seconds = time.process_time() - began
    if not solution.success:
        return f"| {name} | | | {seconds:.1f} | refused: {solution.message[:80]} |"
    kept = oscillation_error(problem, solution) / rtol
    verdict = "ok" if kept <= 5 else "wrong"
    return f"| {name} | {solution.rank} | {kept:.2f} | {seconds:.1f} | {verdict} |"


def oscillation_error(problem: ro.Problem, solution: ro.Solution) -> float:
    """Largest error of an unknown over its size, against single trajectories."""
    times = np.linspace(*map(float, problem.time[1:]), _TIMES)
    ends = np.array(list(solution.parameters.values()))
    shares = np.random.default_rng(11).random((_POINTS, len(ends)))
    errors, sizes = [], []
    for point in ends[:, 0] + np.ptp(ends, axis=1) * shares:
        named = dict(zip(solution.parameters, point.tolist(), strict=True))
        exact = problem.trajectory(times, rtol=1e-11, **named).values
        errors.append(np.abs(solution(t=times, **named) - exact).max(axis=1))
        sizes.append(np.abs(exact).max(axis=1))
    return float((np.max(errors, axis=0) / np.max(sizes, axis=0)).max())


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--oscillators", action="store_true", help="solve long oscillations")
    warnings.simplefilter("ignore", ro.RankoneWarning)
    if parser.parse_args().oscillators:
        print("| oscillator | rank | kept | seconds | verdict |")
        print("| --- | ---: | ---: | ---: | --- |")
        for name, problem in oscillators().items():
            print(long_oscillation(name, problem, 1e-5), flush=True)
        return
    print("| system | kept | seconds | verdict |")
    print("| --- | ---: | ---: | --- |")
    for case in systems():
        began = time.process_time()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ro.RankoneWarning)
            ro.solve(case.problem(), RTOL)
        seconds = time.process_time() - began
        found = judged(case, longest=np.inf)
        message = "" if found.verdict == "ok" else f": {found.message[:120]}"
        print(
            f"| {case.name} | {found.kept:.2f} | {seconds:.1f} | {found.verdict}{message} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
