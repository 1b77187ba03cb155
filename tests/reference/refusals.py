"""Systems that are beyond reach, or nearly: each is to be refused soon, with a remedy that works.

Hybrid boxes whose orders of events cannot be continued, ranks that explode, steep and jumping
dependence on parameters, chaos and many periods. A solve that succeeds is welcome too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import rankone as ro

__all__ = ["REFUSALS", "Refusal"]

Box = Mapping[str, tuple[float, float]]


@dataclass(frozen=True, eq=False)
class Refusal:
    """A system as text, with a tolerance."""

    name: str
    kind: str
    rates: Mapping[str, str]
    initial: Mapping[str, str | float]
    box: Box
    end: float
    rtol: float = 1e-4
    events: Sequence[Mapping[str, Any]] = ()
    definitions: Mapping[str, str] = field(default_factory=dict)

    def problem(self, box: Box | None = None) -> ro.Problem:
        """The problem, perhaps with narrower intervals of some parameters."""
        return ro.Problem.from_strings(
            rhs=self.rates,
            initial=self.initial,
            parameters={**self.box, **(box or {})},
            time=(0.0, self.end),
            name=self.name,
            events=list(self.events),
            definitions=dict(self.definitions),
        )


def _event(
    when: str, direction: str, then: Mapping[str, str] | None = None, name: str = ""
) -> dict[str, Any]:
    """The fields of an event."""
    event: dict[str, Any] = {"when": when, "direction": direction}
    if then:
        event["then"] = dict(then)
    if name:
        event["name"] = name
    return event


def _coupled(count: int) -> dict[str, str]:
    """Kuramoto's oscillators, each with a frequency of its own."""
    return {
        f"x{i}": f"w{i} + 0.4*("
        + " + ".join(f"sin(x{j} - x{i})" for j in range(count) if j != i)
        + ")"
        for i in range(count)
    }


def _chain(count: int) -> dict[str, str]:
    """Masses in a row between walls, with springs that stiffen: Fermi, Pasta, Ulam and Tsingou."""
    names = ["0", *(f"x{i}" for i in range(count)), "0"]

    def force(i: int) -> str:
        right, left = f"({names[i + 2]} - x{i})", f"(x{i} - {names[i]})"
        return f"{right} - {left} + b*({right}**3 - {left}**3)"

    moves = {f"x{i}": f"v{i}" for i in range(count)}
    return moves | {f"v{i}": force(i) for i in range(count)}


_SPRINGS = _chain(5)
_EVERY = [
    # -- orders and counts of events --------------------------------------------------------------
    Refusal(
        "infusion of unknown length, with a mark",
        "events",
        {"d": "r - k*d", "r": "0"},
        {"d": 0, "r": 0},
        {"D": (6, 11), "k": (0.5, 2)},
        24,
        events=[
            _event("t - 1", "rising", {"r": "1"}, "on"),
            _event("t - 1 - D", "rising", {"r": "0"}, "off"),
            _event("t - 9", "rising", name="mark"),
        ],
    ),
    Refusal(
        "two boluses that swap",
        "events",
        {"x": "-k*x"},
        {"x": 0},
        {"k": (0.5, 2), "a": (4, 9), "b": (6, 11)},
        24,
        events=[
            _event("t - a", "rising", {"x": "x + 1"}, "first"),
            _event("t - b", "rising", {"x": "x + 2"}, "second"),
        ],
    ),
    Refusal(
        "integrate and fire, one to many spikes",
        "events",
        {"x": "k - x"},
        {"x": 0},
        {"k": (1.06, 2.5)},
        5,
        events=[_event("x - 1", "rising", {"x": "0"}, "spike")],
    ),
    Refusal(
        "integrate and fire with a leak",
        "events",
        {"x": "k - g*x"},
        {"x": 0},
        {"k": (1.5, 4), "g": (0.5, 1.4)},
        12,
        events=[_event("x - 1", "rising", {"x": "0"}, "spike")],
    ),
    Refusal(
        "ball whose bounces accumulate",
        "events",
        {"y": "v", "v": "-9.81"},
        {"y": "h", "v": 0},
        {"h": (0.8, 1.2), "e": (0.5, 0.9)},
        5,
        events=[_event("y", "falling", {"y": "0", "v": "-e*v"}, "bounce")],
    ),
    Refusal(
        "thermostat over two days",
        "events",
        {"T": "3*on - loss*(T - 15)", "on": "0"},
        {"T": 20, "on": 0},
        {"loss": (0.1, 0.4)},
        48,
        events=[
            _event("T - 19", "falling", {"on": "1"}, "heat"),
            _event("T - 21", "rising", {"on": "0"}, "rest"),
        ],
    ),
    Refusal(
        "oscillator that grazes a wall",
        "events",
        {"x": "v", "v": "-x - 0.1*v + F*cos(1.3*t)"},
        {"x": 0, "v": 0},
        {"F": (0.3, 1), "w": (0.3, 0.8)},
        30,
        events=[_event("x - w", "rising", {"v": "-0.7*v"}, "hit")],
    ),
    Refusal(
        "three thresholds in a race",
        "events",
        {"x": "a - x/5", "y": "b - y/5", "z": "c - z/5"},
        {"x": 0, "y": 0, "z": 0},
        {"a": (0.7, 1.3), "b": (0.7, 1.3), "c": (0.7, 1.3)},
        6,
        events=[
            _event("x - 1", "rising", {"x": "0", "y": "y/2"}, "one"),
            _event("y - 1", "rising", {"y": "0", "z": "z/2"}, "two"),
            _event("z - 1", "rising", {"z": "0", "x": "x/2"}, "three"),
        ],
    ),
    # -- rates that switch ------------------------------------------------------------------------
    Refusal(
        "driven friction in a wide box",
        "hybrid",
        {"x": "v", "v": "push*cos(t/2) - x - mu*sign(v)"},
        {"x": 0, "v": 0.5},
        {"push": (0.6, 2), "mu": (0.3, 0.9)},
        30,
    ),
    Refusal(
        "two blocks on a belt",
        "hybrid",
        {
            "x": "v",
            "v": "-x - 0.8*(x - y) - (0.6 + 0.4*exp(-Abs(v - b)/0.2))*sign(v - b)",
            "y": "w",
            "w": "-y - 0.8*(y - x) - m*(0.6 + 0.4*exp(-Abs(w - b)/0.2))*sign(w - b)",
        },
        {"x": 0, "v": 0, "y": 0.3, "w": 0},
        {"b": (0.2, 0.5), "m": (0.8, 1.4)},
        40,
    ),
    Refusal(
        "Chua's circuit",
        "hybrid",
        {"x": "a*(y - x - f)", "y": "x - y + z", "z": "-b*y"},
        {"x": 0.1, "y": 0, "z": 0},
        {"a": (8.5, 9.5), "b": (14, 15)},
        60,
        definitions={"f": "-0.714*x - 0.2145*(Abs(x + 1) - Abs(x - 1))"},
    ),
    Refusal(
        "relay with a load that reverses",
        "hybrid",
        {"x": "v", "v": "-2*sign(x + c*v) + a*cos(w*t)"},
        {"x": 1, "v": 0},
        {"c": (0.05, 0.6), "a": (1, 3), "w": (0.5, 2)},
        20,
    ),
    Refusal(
        "two masses with a stop, for long",
        "hybrid",
        {"x": "v", "v": "-a*x", "y": "w", "w": "-b*(y - 1)"},
        {"x": 0, "v": 1.5, "y": 1, "w": 0},
        {"a": (3, 5), "b": (0.7, 1.3), "c": (0.3, 0.7)},
        20,
        events=[_event("y - x - c", "falling", {"v": "w", "w": "v"}, "stop")],
    ),
    Refusal(
        "motor with friction and set points that change",
        "hybrid",
        {"x": "v", "v": "Max(-5, Min(5, K*(r - x) - 2*v)) - F*sign(v) - 0.2*v"},
        {"x": 0, "v": 0},
        {"K": (2, 20), "F": (0.2, 2), "a": (1, 4)},
        15,
        definitions={"r": "Piecewise((1, t < a), (-1, t < 2*a), (0.2, True))"},
    ),
    # -- ranks that explode -----------------------------------------------------------------------
    Refusal(
        "six oscillators that are coupled",
        "rank",
        _coupled(6),
        {f"x{i}": i for i in range(6)},
        {f"w{i}": (0.5 + 0.3 * i, 1.5 + 0.3 * i) for i in range(6)},
        40,
    ),
    Refusal(
        "row of stiffening springs",
        "rank",
        _SPRINGS,
        {name: (f"s{name[1:]}" if name[0] == "x" else 0) for name in _SPRINGS},
        {"b": (0, 2), **{f"s{i}": (-1, 1) for i in range(5)}},
        40,
    ),
    Refusal(
        "products of phases",
        "rank",
        {"x": "sin(a*t + b*x) - c*x*cos(d*t*x)", "y": "cos(b*t*x) - y*sin(c*t)**2"},
        {"x": 0.5, "y": 0},
        {"a": (1, 5), "b": (1, 5), "c": (0.2, 1), "d": (0.5, 3)},
        30,
    ),
    Refusal(
        "predators and prey with all rates unknown",
        "rank",
        {"x": "x*(a - b*y)", "y": "-y*(c - d*x)"},
        {"x": "p", "y": "q"},
        {
            "a": (0.5, 2),
            "b": (0.5, 2),
            "c": (1, 4),
            "d": (0.5, 2),
            "p": (1, 10),
            "q": (1, 5),
        },
        40,
    ),
    # -- steep dependence, and jumps --------------------------------------------------------------
    Refusal(
        "separatrix that moves",
        "jump",
        {"x": "s*x*(1 - x)*(x - c)"},
        {"x": "x0"},
        {"x0": (0, 1), "c": (0.3, 0.6), "s": (1, 3)},
        30,
    ),
    Refusal(
        "toggle switch",
        "jump",
        {"u": "A/(1 + v**2) - u", "v": "B/(1 + u**2) - v"},
        {"u": "u0", "v": "v0"},
        {"A": (3, 5), "B": (3, 5), "u0": (0, 2), "v0": (0, 2)},
        25,
    ),
    Refusal(
        "two wells, shifted",
        "jump",
        {"x": "x - x**3 + a"},
        {"x": "k"},
        {"k": (-0.8, 0.8), "a": (-0.15, 0.15)},
        9,
    ),
    Refusal(
        "oblique step over two parameters",
        "jump",
        {"x": "-x + Heaviside(a + b**2 - 0.7)"},
        {"x": 0},
        {"a": (0, 1), "b": (0, 1)},
        3,
    ),
    Refusal(
        "steep sigmoid of three parameters",
        "steep",
        {"x": "-x + tanh(1000*(a*b - c/2))"},
        {"x": 0},
        {"a": (0, 1), "b": (0, 1), "c": (0, 1)},
        3,
    ),
    Refusal(
        "ignition",
        "steep",
        {"x": "x**2*(1 - x)*exp(s)"},
        {"x": "x0"},
        {"x0": (0.001, 0.1), "s": (0, 3)},
        50,
    ),
    Refusal(
        "blow-up in a part of the box",
        "steep",
        {"x": "x**2 - k"},
        {"x": "x0"},
        {"x0": (0.5, 1.5), "k": (0.2, 1)},
        3,
    ),
    # -- chaos ------------------------------------------------------------------------------------
    Refusal(
        "Lorenz",
        "chaos",
        {"x": "10*(y - x)", "y": "x*(r - z) - y", "z": "x*y - b*z"},
        {"x": 1, "y": 1, "z": 1},
        {"r": (26, 30), "b": (2.5, 2.8)},
        25,
    ),
    Refusal(
        "Rössler",
        "chaos",
        {"x": "-y - z", "y": "x + 0.2*y", "z": "0.2 + z*(x - c)"},
        {"x": 1, "y": 1, "z": 0},
        {"c": (5, 6)},
        150,
    ),
    Refusal(
        "forced Duffing",
        "chaos",
        {"x": "v", "v": "-d*v + x - x**3 + F*cos(t)"},
        {"x": 1, "v": 0},
        {"d": (0.2, 0.3), "F": (0.3, 0.45)},
        100,
    ),
    Refusal(
        "double pendulum",
        "chaos",
        {
            "p": "v",
            "q": "w",
            "v": "(-19.62*sin(p) - 9.81*sin(p - 2*q)"
            " - 2*sin(p - q)*(w**2 + v**2*cos(p - q)))/(3 - cos(2*p - 2*q))",
            "w": "2*sin(p - q)*(2*v**2 + 19.62*cos(p) + w**2*cos(p - q))/(3 - cos(2*p - 2*q))",
        },
        {"p": "a", "q": "b", "v": 0, "w": 0},
        {"a": (1.5, 2.5), "b": (1.5, 2.5)},
        15,
    ),
    # -- many periods -----------------------------------------------------------------------------
    Refusal(
        "centre over five thousand turns",
        "periods",
        {"x": "-w*y", "y": "w*x"},
        {"x": 1, "y": 0},
        {"w": (0.9, 1.1)},
        31416,
    ),
    Refusal(
        "pendulum over three hundred swings",
        "periods",
        {"x": "v", "v": "-sin(x)"},
        {"x": "a", "v": 0},
        {"a": (0.5, 3)},
        2000,
    ),
    Refusal(
        "scan into a limit cycle",
        "periods",
        {"v": "v - v**3/3 - w + I0", "w": "0.08*(v + 0.7 - 0.8*w)"},
        {"v": -1, "w": -0.5},
        {"I0": (0.2, 0.6)},
        300,
    ),
    Refusal(
        "Brusselator across its Hopf point",
        "periods",
        {"x": "a + x**2*y - (b + 1)*x", "y": "b*x - x**2*y"},
        {"x": 1, "y": 1},
        {"a": (0.9, 1.1), "b": (1.5, 3)},
        100,
    ),
]
REFUSALS = {each.name: each for each in _EVERY}
"""The systems, by name."""
