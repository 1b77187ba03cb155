"""Solve models on wide boxes: python tests/benchmarks/wide.py [--narrow] [--only NAME] [--plain]

Two or three parameters × and ÷ 10, some × and ÷ 100, at rtol 1e-3: as plain intervals, and with
``"log"``. A success is *wrong* if it is off by more than 5 × rtol at one of 24 random points even
in the parameters, or of 24 even in their logarithms, × 21 times, against SciPy. With ``--narrow``
each refused box is narrowed as its message says, and solved again.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import time
from collections import Counter
from dataclasses import dataclass

import numpy as np
import scipy.integrate
import sympy as sp

import rankone as ro
from rankone.support.budget import effort_of

RTOL = 1e-3
WITHIN = 5.0
POINTS = 24  # Random points, in each of the two measures


@dataclass(frozen=True)
class Model:
    """Right-hand sides, initial values, nominal parameters and the factor each way, and the end."""

    name: str
    rhs: dict[str, str]
    initial: dict[str, str | float]
    parameters: dict[str, float]
    end: float
    factor: float = 10.0

    def box(self, scale: str | None) -> dict[str, tuple[float | str, ...]]:
        """The intervals, with a scale behind them or without."""
        ends = {k: (p / self.factor, p * self.factor) for k, p in self.parameters.items()}
        return {k: (*pair, scale) if scale else pair for k, pair in ends.items()}


MODELS = (
    # Michaelis and Menten, Biochem. Z. 49 (1913); mass action as Briggs and Haldane have it
    Model("michaelis_menten", {"s": "-v*s/(K + s)"}, {"s": 1}, {"v": 1, "K": 0.5}, 3),
    Model(
        "enzyme",
        {"s": "-a*s*(0.1 - c) + b*c", "c": "a*s*(0.1 - c) - (b + k)*c"},
        {"s": 1, "c": 0},
        {"a": 10, "b": 1, "k": 5},
        5,
    ),
    # Hill, J. Physiol. 40 (1910): a gene that represses itself
    Model("hill", {"x": "b/(1 + (x/K)**2) - d*x"}, {"x": 0}, {"b": 1, "K": 0.5, "d": 1}, 5),
    Model("hill_100", {"x": "b/(1 + (x/K)**2) - x"}, {"x": 0}, {"b": 1, "K": 0.5}, 5, 100),
    # Kermack and McKendrick, Proc. R. Soc. A 115 (1927)
    Model(
        "sir",
        {"s": "-b*s*i", "i": "b*s*i - g*i"},
        {"s": "1 - i0", "i": "i0"},
        {"b": 0.6, "g": 0.2, "i0": 1e-4},
        30,
    ),
    Model(
        "sir_i0",
        {"s": "-b*s*i", "i": "b*s*i - 0.2*i"},
        {"s": "1 - i0", "i": "i0"},
        {"b": 0.4, "i0": 1e-4},
        30,
    ),
    # Lotka and Volterra
    Model(
        "predator_prey",
        {"x": "a*x - x*y", "y": "-c*y + x*y"},
        {"x": 1, "y": 0.5},
        {"a": 0.5, "c": 0.5},
        10,
    ),
    # One compartment with absorption, and two compartments: Gibaldi and Perrier (1982)
    Model(
        "absorption",
        {"g": "-ka*g", "c": "ka*g/V - ke*c"},
        {"g": 1, "c": 0},
        {"ka": 1, "ke": 0.2, "V": 1},
        10,
    ),
    Model(
        "two_compartments",
        {"c": "-(k10 + k12)*c + k21*p", "p": "k12*c - k21*p"},
        {"c": 1, "p": 0},
        {"k10": 0.2, "k12": 0.5, "k21": 0.3},
        10,
    ),
    Model(
        "saturable_elimination",
        {"g": "-ka*g", "c": "ka*g - v*c/(K + c)"},
        {"g": 1, "c": 0},
        {"ka": 1, "v": 0.5, "K": 0.2},
        10,
    ),
    # First-order reaction in a batch that heats up: Arrhenius with a dimensionless temperature
    Model(
        "arrhenius",
        {"c": "-k*c*exp(5 - 5/T)", "T": "h*k*c*exp(5 - 5/T) - 0.5*(T - 1)"},
        {"c": 1, "T": 1},
        {"k": 0.1, "h": 0.2},
        5,
    ),
    # Goodwin, Adv. Enzyme Regul. 3 (1965)
    Model(
        "goodwin",
        {"x": "a/(1 + z**8) - d*x", "y": "x - 0.5*y", "z": "k*y - 0.5*z"},
        {"x": 0.1, "y": 0.1, "z": 0.1},
        {"a": 1, "d": 0.5, "k": 0.5},
        10,
    ),
    # FitzHugh, Biophys. J. 1 (1961)
    Model(
        "fitzhugh",
        {"v": "v - v**3/3 - w + I", "w": "e*(v + 0.7 - 0.8*w)"},
        {"v": -1, "w": 0},
        {"e": 0.08, "I": 0.3},
        20,
    ),
    # Two enzymatic steps, each with its own constant: Goldbeter and Koshland, PNAS 78 (1981)
    Model(
        "cascade",
        {
            "x": "v*(1 - x)/(K + 1 - x) - 0.5*x/(0.2 + x)",
            "y": "k*x*(1 - y)/(K + 1 - y) - 0.3*y/(0.2 + y)",
        },
        {"x": 0, "y": 0},
        {"v": 0.5, "K": 0.2, "k": 1},
        5,
    ),
    # Transcription and translation in two steps, × and ÷ 100
    Model(
        "expression_100",
        {"m": "a - d*m", "p": "m - 0.2*p"},
        {"m": 0, "p": 0},
        {"a": 1, "d": 0.5},
        10,
        100,
    ),
    # Viral dynamics: Perelson et al., Science 271 (1996)
    Model(
        "virus",
        {"T": "1 - 0.1*T - b*T*V", "I": "b*T*V - d*I", "V": "p*I - 3*V"},
        {"T": 10, "I": 0, "V": 1e-3},
        {"b": 0.1, "d": 0.5, "p": 10},
        10,
    ),
)


def error(solution: ro.Solution, model: Model) -> float:
    """Largest error over the size of its unknown, at points in both measures."""
    names, times = list(solution.parameters), np.linspace(0.0, model.end, 21)
    symbols = {name: sp.Symbol(name) for name in (*model.rhs, *names)}
    rates = [sp.sympify(rate, locals=symbols) for rate in model.rhs.values()]
    starts = [sp.sympify(model.initial[state], locals=symbols) for state in model.rhs]
    rhs = sp.lambdify([[symbols[s] for s in model.rhs], *(symbols[n] for n in names)], rates)
    start = sp.lambdify([symbols[n] for n in names], starts)
    draw = np.random.default_rng(5).random((2 * POINTS, len(names)))
    lower, upper = np.array(list(solution.parameters.values())).T
    points = lower + (upper - lower) * draw
    points[POINTS:] = lower * (upper / lower) ** draw[POINTS:]
    largest = np.zeros(len(rates))
    size = np.zeros(len(rates))
    for point in points:
        exact = scipy.integrate.solve_ivp(
            lambda _, u, at=point: rhs(u, *at),
            (0.0, model.end),
            np.array(start(*point), dtype=float),
            method="LSODA",
            rtol=1e-9,
            atol=1e-12,
            t_eval=times,
        ).y
        values = solution(t=times, **dict(zip(names, point, strict=True)))
        largest = np.maximum(largest, np.abs(values - exact).max(axis=1))
        size = np.maximum(size, np.abs(exact).max(axis=1))
    return float((largest / size).max())


def verdict_of(solution: ro.Solution, model: Model) -> str:
    """Refused, ok or wrong."""
    if not solution.success:
        return "refused"
    return "ok" if error(solution, model) <= WITHIN * RTOL else "wrong"


def narrower_box(solution: ro.Solution) -> dict[str, tuple[float, float]] | None:
    """The intervals that the message of a refused solve tells."""
    return solution.outcome.verdict.narrower or None


def main() -> None:
    """Print a line for each system and scale, and the counts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", default=[model.name for model in MODELS])
    parser.add_argument("--plain", action="store_true", help="without the logarithm")
    parser.add_argument("--log", action="store_true", help="with the logarithm alone")
    parser.add_argument("--narrow", action="store_true", help="narrow refused boxes as told")
    parser.add_argument("--effort", default="normal", type=effort_of, help="budget of work")
    arguments = parser.parse_args()
    counts: Counter[str] = Counter()
    scales = [s for s, skip in ((None, arguments.log), ("log", arguments.plain)) if not skip]
    for model in MODELS:
        if model.name not in arguments.only:
            continue
        for scale in scales:
            problem = ro.Problem.from_strings(
                model.rhs, model.initial, model.box(scale), (0, model.end)
            )
            compiled = ro.compile(problem)
            began = time.process_time()
            solution = compiled.solve(RTOL, effort=arguments.effort)
            seconds = time.process_time() - began
            verdict = verdict_of(solution, model)
            counts[f"{scale or 'plain'} {verdict}"] += 1
            nodes = ", ".join(map(str, solution.nodes))
            print(
                f"{model.name}, {scale or 'plain'}: {verdict}, {solution.method}, error "
                f"{solution.error:.2g}, rank {solution.rank}, nodes ({nodes}), {seconds:.1f} s",
                flush=True,
            )
            if verdict != "refused":
                continue
            print(f"    {solution.message}", flush=True)
            told = narrower_box(solution) if arguments.narrow else None
            if told is not None:
                began = time.process_time()
                solution = compiled.solve(RTOL, parameters=told, effort=arguments.effort)
                seconds = time.process_time() - began
                verdict = verdict_of(solution, model)
                counts[f"narrowed as told {verdict}"] += 1
                nodes = ", ".join(map(str, solution.nodes))
                print(
                    f"    narrowed to {told}: {verdict}, error {solution.error:.2g}, nodes "
                    f"({nodes}), {seconds:.1f} s",
                    flush=True,
                )
    print(", ".join(f"{number} {verdict}" for verdict, number in sorted(counts.items())))


if __name__ == "__main__":
    main()
