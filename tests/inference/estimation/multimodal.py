"""Thirty searches with several minima: phases, resonances, frequencies, wells of outputs.

``python -m tests.inference.estimation.multimodal`` prints a table beside differential evolution on
the same solutions, which the values in ``LEAST`` are from.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.optimize

import rankone as ro

__all__ = ["CASES", "LEAST", "Case"]

Box = Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Case:
    """Equations, where they are solved, and what is to be least."""

    rates: Mapping[str, str]
    initial: Mapping[str, Any]
    box: Box
    end: float
    objective: Any
    times: Any = None
    sense: str = "min"

    @property
    def at(self) -> Any:
        """The times of the objective: the end of the horizon, unless others are given."""
        return self.end if self.times is None else self.times

    @functools.cached_property
    def solution(self) -> ro.Solution:
        problem = ro.Problem.from_strings(self.rates, self.initial, self.box, (0, self.end))
        return ro.solve(problem, 1e-5)

    def value(self, p: Any) -> float:
        """The objective at parameters (d,), with the sign that makes it one to minimise."""
        given = dict(zip(self.box, map(float, p), strict=True))
        states = self.solution(self.at, given)
        values = dict(zip(self.solution.unknowns, states, strict=True))
        sign = 1.0 if self.sense == "min" else -1.0
        if isinstance(self.objective, str):
            return sign * float(values[self.objective])
        return sign * float(self.objective(values, given))

    def evolved(self) -> float:
        """The least value that differential evolution finds."""
        bounds, settings = list(self.box.values()), {"popsize": 40, "tol": 1e-9, "maxiter": 300}
        runs = (
            scipy.optimize.differential_evolution(self.value, bounds, seed=seed, **settings)
            for seed in range(4)
        )
        return min(float(run.fun) for run in runs)

    def is_least(self, value: float, least: float) -> bool:
        """Whether a value, with the sign of ``value``, is the least but for the tolerance."""
        return value <= least + 1e-5 * max(1.0, abs(least))


def outputs(function: Callable[[Any], float], box: Box, **given: Any) -> Case:
    """A function of states that become the parameters at t = 1."""
    rates = {f"x{i}": name for i, name in enumerate(box)}

    def objective(values: Mapping[str, Any], parameters: Any) -> float:
        return function(np.array([values[name] for name in rates]))

    return Case(rates, dict.fromkeys(rates, "0"), box, 1.0, objective, **given)


def cube(d: int, lower: float, upper: float) -> Box:
    return {f"p{i}": (lower, upper) for i in range(d)}


def rastrigin(x: Any) -> float:
    return float(np.sum((x - 0.31) ** 2 - 3.0 * np.cos(2 * np.pi * (x - 0.31))))


def ackley(x: Any) -> float:
    y = x - 0.37
    mean = np.sqrt(np.mean(y**2) + 1e-4)
    return float(-20 * np.exp(-0.2 * mean) - np.exp(np.mean(np.cos(2 * np.pi * y))))


def griewank(x: Any) -> float:
    i = np.sqrt(np.arange(1, x.size + 1))
    return float(np.sum((x - 1.3) ** 2) / 400 - np.prod(np.cos((x - 1.3) / i)))


def levy(x: Any) -> float:
    w = 1 + (x - 1) / 4
    middle = np.sum((w[:-1] - 1) ** 2 * (1 + 10 * np.sin(np.pi * w[:-1] + 1) ** 2))
    end = (w[-1] - 1) ** 2 * (1 + np.sin(2 * np.pi * w[-1]) ** 2)
    return float(np.sin(np.pi * w[0]) ** 2 + middle + end)


def schwefel(x: Any) -> float:
    return float(-np.sum(x * np.sin(np.sqrt(np.abs(x) + 1e-9))))


def branin(x: Any) -> float:
    a, b = x
    well = (b - 5.1 / (4 * np.pi**2) * a**2 + 5 / np.pi * a - 6) ** 2
    return float(well + 10 * (1 - 1 / (8 * np.pi)) * np.cos(a) + 10 + 0.1 * a)


def shubert(x: Any) -> float:
    i = np.arange(1, 6)
    return float(np.prod([np.sum(i * np.cos((i + 1) * each + i)) for each in x]))


SHEKEL = np.array(
    [
        [4, 4, 4, 4], [1, 1, 1, 1], [8, 8, 8, 8], [6, 6, 6, 6], [3, 7, 3, 7],
        [2, 9, 2, 9], [5, 5, 3, 3], [8, 1, 8, 1], [6, 2, 6, 2], [7, 3.6, 7, 3.6],
    ]
)  # fmt: skip
DEPTHS = np.array([1, 2, 2, 4, 4, 6, 3, 7, 5, 5]) / 10


def shekel(x: Any) -> float:
    return float(-np.sum(1.0 / (((x - SHEKEL) ** 2).sum(axis=1) + DEPTHS)))


HARTMANN6 = (
    np.array(
        [
            [10, 3, 17, 3.5, 1.7, 8], [0.05, 10, 17, 0.1, 8, 14],
            [3, 3.5, 1.7, 10, 17, 8], [17, 8, 0.05, 10, 0.1, 14],
        ]
    ),
    np.array(
        [
            [1312, 1696, 5569, 124, 8283, 5886], [2329, 4135, 8307, 3736, 1004, 9991],
            [2348, 1451, 3522, 2883, 3047, 6650], [4047, 8828, 8732, 5743, 1091, 381],
        ]
    ) / 1e4,
)  # fmt: skip
WEIGHTS = np.array([1.0, 1.2, 3.0, 3.2])


def hartmann(tables: Any) -> Callable[[Any], float]:
    a, places = tables
    return lambda x: float(-WEIGHTS @ np.exp(-(a * (x - places) ** 2).sum(axis=1)))


WAVE = {"x": "v", "v": "-w**2*x"}
TIMES = np.linspace(0.2, 3.0, 15)


def misfit(data: Any) -> Callable[[Any, Any], float]:
    """Sum of squares against data for x."""
    return lambda values, parameters: float(np.sum((values["x"] - data) ** 2))


PAIR = {"x": "v", "v": "-a**2*x", "y": "u", "u": "-b**2*y"}
STARTS = {"x": "1", "v": "0", "y": "0", "u": "b"}
THREE = {**PAIR, "z": "s", "s": "-c**2*z"}
RISING = {"x": "1", "v": "0", "y": "1", "u": "0", "z": "1", "s": "0"}
THREE_TONES = sum(np.cos(w * TIMES) for w in (2.3, 5.1, 7.7))

CASES: dict[str, Case] = {
    # phases and frequencies
    "phase": Case(
        WAVE, {"x": "1", "v": "0"}, {"w": (2, 40)}, 3.0,
        lambda u, p: u["x"] + 0.002 * (p["w"] - 23) ** 2,
    ),
    "frequency": Case(
        WAVE, {"x": "1", "v": "0"}, {"w": (1, 60)}, 3.0, misfit(np.cos(47.3 * TIMES)), TIMES
    ),
    "frequency, amplitude, slope": Case(
        WAVE, {"x": "a", "v": "w*b"}, {"w": (1, 30), "a": (-2, 2), "b": (-2, 2)}, 3.0,
        misfit(0.8 * np.cos(21.7 * TIMES) - 0.5 * np.sin(21.7 * TIMES)), TIMES,
    ),
    "damped": Case(
        {"x": "v", "v": "-w**2*x - d*v"}, {"x": "1", "v": "0"}, {"w": (1, 40), "d": (0.05, 2)},
        3.0, misfit(np.exp(-0.2 * TIMES) * np.cos(33.0 * TIMES)), TIMES,
    ),
    "two frequencies": Case(
        PAIR, STARTS, {"a": (1, 20), "b": (1, 20)}, 3.0,
        lambda u, p: np.sum((u["x"] + u["y"] - np.cos(13.1 * TIMES) - np.sin(6.4 * TIMES)) ** 2),
        TIMES,
    ),
    "two frequencies, two amplitudes": Case(
        PAIR, {"x": "p", "v": "0", "y": "0", "u": "b*q"},
        {"a": (1, 12), "b": (1, 12), "p": (-2, 2), "q": (-2, 2)}, 3.0,
        lambda u, p: np.sum(
            (u["x"] + u["y"] - 0.7 * np.cos(7.1 * TIMES) + 1.2 * np.sin(4.4 * TIMES)) ** 2
        ),
        TIMES,
    ),
    "meeting": Case(
        PAIR, STARTS, {"a": (1, 12), "b": (1, 12)}, 2.0,
        lambda u, p: (u["x"] - 0.3) ** 2 + (u["y"] + 0.6) ** 2 + 0.002 * (p["a"] - p["b"] - 3) ** 2,
    ),
    "three frequencies": Case(
        THREE, RISING, {"a": (1, 10), "b": (1, 10), "c": (1, 10)}, 3.0,
        lambda u, p: np.sum((u["x"] + u["y"] + u["z"] - THREE_TONES) ** 2), TIMES,
    ),
    "three oscillators": Case(
        THREE, RISING, {"a": (1, 7), "b": (1, 7), "c": (1, 7)}, 3.0,
        lambda u, p: u["x"] * u["y"] * u["z"] + 0.01 * (p["a"] + 2 * p["b"] - 9) ** 2
        + 0.01 * (p["c"] - 4.2) ** 2,
    ),
    "six of three oscillators": Case(
        THREE, {"x": "p", "v": "0", "y": "q", "u": "0", "z": "r", "s": "0"},
        {"a": (1, 8), "b": (1, 8), "c": (1, 8), "p": (0.2, 2), "q": (0.2, 2), "r": (0.2, 2)}, 3.0,
        lambda u, p: np.sum((u["x"] + u["y"] + u["z"] - THREE_TONES) ** 2), TIMES,
    ),
    "chirp": Case({"x": "cos(w*t**2)"}, {"x": "0"}, {"w": (0.5, 12)}, 3.0, "x"),
    "pendulum": Case(
        {"q": "w", "w": "-g*sin(q) - 0.1*w"}, {"q": "q0", "w": "w0"},
        {"g": (4, 12), "q0": (-2, 2), "w0": (-2, 2)}, 4.0, "q",
    ),
    # resonances and pulses
    "resonance": Case(
        {"x": "v", "v": "cos(5*t) + 0.8*cos(8*t) - w**2*x - 0.2*v"}, {"x": "0", "v": "0"},
        {"w": (2, 12)}, 12.0, "x", sense="max",
    ),
    "resonance with phase": Case(
        {"x": "v", "v": "cos(4*t + q) - w**2*x - 0.3*v"}, {"x": "0", "v": "0"},
        {"w": (2, 7), "q": (-3, 9)}, 8.0, "x",
    ),
    "absorber": Case(
        {"x": "v", "v": "cos(3*t) - 9*x + s*(y - x) - 0.1*v", "y": "u", "u": "s*(x - y)*r"},
        dict.fromkeys("xvyu", "0"), {"s": (0.2, 6), "r": (0.5, 6)}, 9.0,
        lambda u, p: np.sum(u["x"] ** 2), np.linspace(5, 9, 21),
    ),
    "two pulses": Case(
        {"x": "v", "v": "exp(-8*(t - a)**2) + exp(-8*(t - b)**2) - 16*x"}, {"x": "0.2", "v": "0"},
        {"a": (1, 5), "b": (1, 5)}, 6.0, lambda u, p: u["x"] ** 2 + u["v"] ** 2 / 16,
    ),
    "four pulses": Case(
        {"x": "v", "v": " + ".join(f"exp(-8*(t - {a})**2)" for a in "abcd") + " - 16*x"},
        {"x": "0.2", "v": "0"}, dict.fromkeys("abcd", (1, 5)), 6.0,
        lambda u, p: 0.1 * u["v"] - u["x"] + 0.02 * (p["a"] - 4) ** 2 + 0.01 * (p["b"] - 3) ** 2,
    ),
    # populations and wells
    "predator": Case(
        {"x": "x*(a - y)", "y": "y*(x - b)"}, {"x": "1", "y": "2"},
        {"a": (1, 4), "b": (1, 4)}, 4.0, lambda u, p: (u["x"] - 1.5) ** 2 + (u["y"] - 2.5) ** 2,
    ),
    "two wells": Case(
        {"x": "x - x**3 + f"}, {"x": "x0"}, {"x0": (-1.5, 1.5), "f": (-0.3, 0.3)}, 2.0,
        lambda u, p: (u["x"] ** 2 - 0.81) ** 2 + 0.02 * u["x"] + 0.05 * p["f"] ** 2,
    ),
    "oscillating wells": Case(
        {"x": "2*cos(3*x) + f"}, {"x": "x0"}, {"x0": (-3, 3), "f": (-1, 1)}, 0.3,
        lambda u, p: np.cos(9 * u["x"]) + 0.05 * (u["x"] - 0.4) ** 2 + 0.1 * p["f"] ** 2,
    ),
    # wells of outputs, from the literature
    "branin": outputs(branin, {"p0": (-5, 10), "p1": (0, 15)}),
    "shubert": outputs(shubert, cube(2, -10, 10)),
    "rastrigin 4": outputs(rastrigin, cube(4, -3, 3)),
    "rastrigin 6": outputs(rastrigin, cube(6, -2, 2.5)),
    "griewank 5": outputs(griewank, cube(5, -9, 9)),
    "levy 6": outputs(levy, cube(6, -6, 7)),
    "ackley 5": outputs(ackley, cube(5, -4, 5)),
    "schwefel 4": outputs(schwefel, cube(4, -450, 450)),
    "shekel": outputs(shekel, cube(4, 0, 10)),
    "hartmann 6": outputs(hartmann(HARTMANN6), cube(6, 0, 1)),
}  # fmt: skip


LEAST = {
    "phase": -0.9979654,
    "frequency": 0,
    "frequency, amplitude, slope": 0,
    "damped": 5.311342e-05,
    "two frequencies": 0,
    "two frequencies, two amplitudes": 0,
    "meeting": 5.752542e-05,
    "three frequencies": 0,
    "three oscillators": -0.9982147,
    "six of three oscillators": 0,
    "chirp": 0.1689806,
    "pendulum": -1.90812,
    "resonance": -0.3789313,
    "resonance with phase": -0.5806712,
    "absorber": 0.04964648,
    "two pulses": 9.913611e-05,
    "four pulses": -0.4177744,
    "predator": 0,
    "two wells": -0.01803076,
    "oscillating wells": -0.9998704,
    "branin": 0.08320737,
    "shubert": -186.7309,
    "rastrigin 4": -12,
    "rastrigin 6": -18,
    "griewank 5": -1,
    "levy 6": 0,
    "ackley 5": -22.67832,
    "schwefel 4": -1675.932,
    "shekel": -10.53641,
    "hartmann 6": -3.322368,
}
"""Least values over the box, with the sign of ``Case.value``."""


def main() -> None:
    """A line for each case."""
    right = 0
    for name, case in CASES.items():
        best = case.solution.minimize(case.objective, case.at, sense=case.sense)
        value, evolved = case.value(list(best.x.values())), case.evolved()
        right += case.is_least(value, min(evolved, LEAST[name]))
        print(f"{name:32s} {value:12.6f} {evolved:12.6f} {LEAST[name]:12.6f} {best.message}")
    print(f"{right} of {len(CASES)}")


if __name__ == "__main__":
    main()
