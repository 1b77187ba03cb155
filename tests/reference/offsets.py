"""Forty-one systems far from zero: temperatures, pressures, years; each with its exact values.

A state x moves through a sigmoid, a high power or a narrow pulse around an offset of 36 to 1e5,
which is in a rate, an initial value, a jump or an output. The exact values use forms that neither
overflow nor cancel, written by hand.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.integrate
from scipy.special import expit

__all__ = ["SYSTEMS", "Offset"]

END = 2.0
JUMP = 1.0
PLACES = ("rate", "start", "jump", "output")


@dataclass(frozen=True)
class Offset:
    """A system x' = a, and y with a feature of x or of a parameter.

    Attributes
    ----------
    place : {"rate", "start", "jump", "output"}
    text : str
        The feature of ``{}``.
    feature : callable
        The same in a stable form.
    centre, width : float
        Where it is, and how far it reaches.
    """

    place: str
    text: str
    feature: Callable[[np.ndarray], np.ndarray]
    centre: float
    width: float

    @property
    def arguments(self) -> dict[str, object]:
        """What ``Problem.from_strings`` takes."""
        start = self.centre - self.width
        rhs = {"x": f"a*{self.width:.12g}", "y": "-y"}
        initial = {"x": f"{start:.12g}", "y": "0"}
        box: dict[str, tuple[float, float]] = {"a": (0.9, 1.1)}
        jumps = None
        if self.place == "rate":
            rhs["y"] = f"{self.text.format('x')} - y"
        elif self.place == "start":
            box["b"] = (start, self.centre + self.width)
            initial["y"] = self.text.format("b")
        elif self.place == "jump":
            jumps = {JUMP: {"y": f"y + {self.text.format('x')}"}}
        return {"rhs": rhs, "initial": initial, "parameters": box, "time": (0, END), "jumps": jumps}

    def exact(self, t: np.ndarray, a: float, b: float) -> np.ndarray:
        """y, or the output, at ascending times."""
        start = self.centre - self.width

        def x(time: np.ndarray) -> np.ndarray:
            return start + a * self.width * time

        if self.place == "output":
            return self.feature(x(t))
        if self.place == "start":
            return self.feature(np.asarray(b)) * np.exp(-t)
        if self.place == "jump":
            return np.where(t >= JUMP, self.feature(x(np.asarray(JUMP))) * np.exp(JUMP - t), 0.0)
        done = scipy.integrate.solve_ivp(
            lambda time, y: self.feature(x(time)) - y,
            (0.0, END),
            [0.0],
            "DOP853",
            t,
            rtol=1e-11,
            atol=1e-14,
            max_step=0.02,
        )
        return done.y[0]


def _made(index: int) -> Offset:
    draw = random.Random(f"offset {index}")
    centre = float(f"{36.0 * (1e5 / 36.0) ** draw.random():.6g}")
    slope = float(f"{draw.uniform(0.3, 3.0):.3g}")
    n = draw.choice([20, 60, 125, 300])
    c, s = f"{centre!r}", f"{slope!r}"
    kinds = [
        (f"1/(1 + exp(({{0}} - {c})/{s}))", lambda x: expit(-(x - centre) / slope)),
        (f"1/(1 + exp(({c} - {{0}})/{s}))", lambda x: expit((x - centre) / slope)),
        (f"0.5*(1 + tanh(({{0}} - {c})/{s}))", lambda x: expit(2 * (x - centre) / slope)),
        (
            f"exp(({{0}} - {c})/{s})/(1 + exp(({{0}} - {c})/{s}))",
            lambda x: expit((x - centre) / slope),
        ),
        (f"1/(1 + ({{0}}/{c})**{n})", lambda x: expit(-n * np.log(x / centre))),
        (f"({{0}}/{c})**{n}/(1 + ({{0}}/{c})**{n})", lambda x: expit(n * np.log(x / centre))),
        (f"log(1 + exp(({{0}} - {c})/{s}))", lambda x: np.logaddexp(0.0, (x - centre) / slope)),
        (
            f"exp({n}.25*(cos(({{0}} - {c})/{s}) - 1))",
            lambda x: np.exp(-2 * (n + 0.25) * np.sin((x - centre) / slope / 2) ** 2),
        ),
    ]
    kind = index // len(PLACES) % len(kinds)
    width = 4.0 * centre / n if kind in (4, 5) else 2.0 * slope
    return Offset(PLACES[index % len(PLACES)], *kinds[kind], centre, width)


SYSTEMS = {
    "body_temperature": Offset(
        "rate",
        "1/(1 + exp(({0} - 310.15)/0.43))",
        lambda x: expit(-(x - 310.15) / 0.43),
        310.15,
        1.15,
    ),
    **{f"{_made(i).place}_{i}": _made(i) for i in range(40)},
}
