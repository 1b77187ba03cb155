"""Sixty systems that saturate, stick, rest at a limit or switch by the clock.

Each is a problem in text as an engineer writes it, with constants, a box and a horizon. Beside it
are its trajectories, from modes written by hand (``tests/reference/modes.py``) or in closed form.
Cases of one ``group`` mean the same in several spellings.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import cos, exp, pi, sin, sqrt
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import rankone as ro
from tests.reference.modes import Exit, Mode, Reference, friction, kinked, machine

__all__ = ["SATURATIONS", "Switched"]

Array = NDArray[np.float64]
RTOL = 1e-4
SEED, POINTS, TIMES = 51, 24, 40


@dataclass(frozen=True, eq=False)
class Switched:
    """A system as an engineer writes it, and its trajectories by other means.

    Attributes
    ----------
    name, kind, group : str
        Cases of one group are one system in several spellings; empty for a system of its own.
    rates, initial, box, end, definitions, events, jumps
        As :meth:`rankone.Problem.from_strings` takes them.
    reference : callable
        The states (n, times) at ``p.name``, in the order of ``compared``.
    compared : tuple of str
        The states that the reference has; all of them if empty.
    resets : callable
        Times at which compared states jump, for given parameters.
    hard : bool
        Whether the order of what happens changes in the box, or a state slides or rests.
    """

    name: str
    kind: str
    rates: Mapping[str, str]
    initial: Mapping[str, str | float]
    box: Mapping[str, tuple[float, float]]
    end: float
    reference: Reference
    group: str = ""
    definitions: Mapping[str, str] = field(default_factory=dict)
    events: Sequence[Mapping[str, Any]] = ()
    jumps: Mapping[Any, Mapping[str, str | float]] | None = None
    compared: tuple[str, ...] = ()
    resets: Callable[[SimpleNamespace], Sequence[float]] = lambda p: ()
    hard: bool = False

    @property
    def asked(self) -> tuple[str, ...]:
        """The states that are compared."""
        return self.compared or tuple(self.rates)

    def problem(self) -> ro.Problem:
        """The problem that rankone is given."""
        return ro.Problem.from_strings(
            rhs=self.rates,
            initial=self.initial,
            parameters=dict(self.box),
            time=(0.0, self.end),
            name=self.name,
            definitions=dict(self.definitions),
            events=list(self.events),
            jumps=self.jumps,
        )

    def points(self, count: int = POINTS) -> list[SimpleNamespace]:
        """Random parameters of the box."""
        ends = np.array(list(self.box.values()), dtype=float)
        shares = np.random.default_rng(SEED).random((count, len(ends)))
        return [
            SimpleNamespace(**dict(zip(self.box, row.tolist(), strict=True)))
            for row in ends[:, 0] + np.ptp(ends, axis=1) * shares
        ]

    def times(self, count: int = TIMES) -> Array:
        """Equispaced times over the horizon."""
        return np.linspace(0.0, self.end, count)


SATURATIONS: dict[str, Switched] = {}
"""The systems, by name."""


def add(name: str, kind: str, *rest: Any, **more: Any) -> None:
    """Register a system."""
    assert name not in SATURATIONS, name
    SATURATIONS[name] = Switched(name, kind, *rest, **more)


def spelled(
    group: str, kind: str, spellings: Mapping[str, Mapping[str, Any]], **common: Any
) -> None:
    """Register the spellings of one system: what they have in common, and what differs."""
    for how, parts in spellings.items():
        add(f"{group}: {how}", kind, group=group, **{**common, **parts})


def clip(low: float, value: float, high: float) -> float:
    """The value, or the limit that it passes."""
    return min(max(value, low), high)


# -- saturated controllers ------------------------------------------------------------------------

_TWELVE_VOLTS = {
    "Max of Min": "Max(-12, Min(12, v))",
    "Min of Max": "Min(12, Max(-12, v))",
    "Piecewise": "Piecewise((-12, v < -12), (12, v > 12), (v, True))",
    "nested": "Piecewise((12, v >= 12), (Piecewise((-12, v <= -12), (v, True)), True))",
}


def _servo(t, u, p):
    th, w = u
    return w, (8 * clip(-12, p.kp * (p.r - th) - 0.5 * w, 12) - w) / 0.05


# A position servo of a 12 V motor. It starts in saturation in a part of the box.
spelled(
    "position servo",
    "saturation",
    {how: {"definitions": {"v": "kp*(r - th) - w/2", "u": u}} for how, u in _TWELVE_VOLTS.items()},
    rates={"th": "w", "w": "(8*u - w)/0.05"},
    initial={"th": 0, "w": 0},
    box={"kp": (20, 40), "r": (0.3, 0.8)},
    end=0.3,
    reference=kinked(_servo, lambda p: (0, 0)),
)


def _wound_back(t, u, p):
    w, q = u
    v = p.Kp * (p.r - w) + 1.5 * q
    volts = clip(-12, v, 12)
    return (10 * volts - w) / 0.2, p.r - w + (volts - v) / p.Kp


# The speed loop of the same motor, whose integrator winds back by what the limit cuts off.
spelled(
    "back-calculation",
    "saturation",
    {
        how: {"definitions": {"v": "Kp*(r - w) + 1.5*q", "u": _TWELVE_VOLTS[how]}}
        for how in ("Max of Min", "Min of Max", "Piecewise")
    },
    rates={"w": "(10*u - w)/0.2", "q": "r - w + (u - v)/Kp"},
    initial={"w": 0, "q": 0},
    box={"Kp": (0.1, 0.3), "r": (60, 100)},
    end=2,
    reference=kinked(_wound_back, lambda p: (0, 0)),
)


def _filtered_pid(t, u, p):
    w, q, f = u
    r = 50 if t < 0.5 else (p.r if t < 1.5 else 30)
    e = r - w
    v = p.Kp * e + 2 * q - 0.002 * (w - f) / 0.02
    volts = clip(-12, v, 12)
    return (10 * volts - w) / 0.2, e + (volts - v) / p.Kp, (w - f) / 0.02


add(
    "filtered PID with stepwise set points",
    "saturation",
    rates={"w": "(10*u - w)/0.2", "q": "e + (u - v)/Kp", "f": "(w - f)/0.02"},
    initial={"w": 0, "q": 0, "f": 0},
    box={"Kp": (0.15, 0.25), "r": (70, 100)},
    end=2.5,
    definitions={
        "e": "Piecewise((50, t < 0.5), (r, t < 1.5), (30, True)) - w",
        "v": "Kp*e + 2*q - 0.002*(w - f)/0.02",
        "u": "Max(-12, Min(12, v))",
    },
    reference=kinked(_filtered_pid, lambda p: (0, 0, 0), lambda p: (0.5, 1.5)),
    hard=True,
)


def _conditional(held: bool):
    def rates(t, u, p):
        w, q = u
        e = p.r - w
        volts = 12 if held else p.Kp * e + 0.8 * q
        return (10 * volts - w) / 0.2, 0 if held else e

    return rates


def _volts(u, p):
    return p.Kp * (p.r - u[0]) + 0.8 * u[1]


# The integrator stops while the limit is active and the error would wind it up further.
spelled(
    "conditional integration",
    "saturation",
    {
        how: {"rates": {"w": "(10*Max(-12, Min(12, v)) - w)/0.2", "q": rate}}
        for how, rate in {
            "product": "Piecewise((0, (Abs(v) > 12) & (e*v > 0)), (e, True))",
            "two cases": "Piecewise((0, ((v > 12) & (e > 0)) | ((v < -12) & (e < 0))), (e, True))",
        }.items()
    },
    initial={"w": 0, "q": 0},
    box={"Kp": (0.15, 0.3), "r": (60, 100)},
    end=2,
    definitions={"e": "r - w", "v": "Kp*e + 0.8*q"},
    reference=machine(
        {
            "held": Mode(_conditional(True), (Exit(lambda t, u, p: _volts(u, p) - 12, "free"),)),
            "free": Mode(_conditional(False), (Exit(lambda t, u, p: 12 - _volts(u, p), "held"),)),
        },
        lambda t, u, p: "held" if _volts(u, p) > 12 else "free",
        lambda p: (0, 0),
    ),
    hard=True,
)


def _elevator(t, u, p):
    th, q, d = u
    command = clip(-20, p.kp * (p.r - th) - 1.5 * q, 20)
    return q, -1.2 * q - 2 * th + 1.6 * d, clip(-25, (command - d) / 0.05, 25)


add(
    "elevator with limits of angle and rate",
    "saturation",
    rates={
        "th": "q",
        "q": "-1.2*q - 2*th + 1.6*d",
        "d": "Max(-25, Min(25, (Max(-20, Min(20, kp*(r - th) - 1.5*q)) - d)/0.05))",
    },
    initial={"th": 0, "q": 0, "d": 0},
    box={"kp": (2, 4), "r": (3, 10)},
    end=4,
    reference=kinked(_elevator, lambda p: (0, 0, 0)),
    hard=True,
)


def _valve(t, u, p):
    (h,) = u
    return ((0.04 * clip(0, p.K * (p.r - h), 1) - 0.02 * sqrt(h)) / 0.5,)


add(
    "level control with a valve",
    "saturation",
    rates={"h": "(0.04*Max(0, Min(1, K*(r - h))) - 0.02*sqrt(h))/0.5"},
    initial={"h": 0.2},
    box={"K": (2, 8), "r": (0.5, 1.2)},
    end=60,
    reference=kinked(_valve, lambda p: (0.2,)),
)

# -- relays ---------------------------------------------------------------------------------------

spelled(
    "filled up to one",
    "rest",
    {
        "Heaviside": {"rates": {"x": "k*Heaviside(1 - x)"}},
        "Piecewise": {"rates": {"x": "Piecewise((k, x < 1), (0, True))"}},
        "sign": {"rates": {"x": "k*(1 + sign(1 - x))/2"}},
    },
    initial={"x": "x0"},
    box={"k": (0.5, 2), "x0": (0, 0.8)},
    end=1.5,
    reference=lambda p, times: np.minimum(p.x0 + p.k * times, 1.0)[None],
)


def _heated(p, times):
    # C = 200 J/K, G = 20 W/K: warms up from 20 °C, then held at the set point.
    hot = 20 + p.P / 20
    reach = 10 * np.log((hot - 20) / (hot - p.Ts))
    return np.where(times < reach, hot + (20 - hot) * np.exp(-times / 10), p.Ts)[None]


add(
    "heater without hysteresis",
    "relay",
    rates={"T": "(Piecewise((P, T < Ts), (0, True)) - 20*(T - 20))/200"},
    initial={"T": 20},
    box={"P": (1500, 2500), "Ts": (40, 60)},
    end=20,
    reference=_heated,
)


def _thruster(sign):
    def rates(t, u, p):
        return u[1], -p.a * sign

    return rates


def _line(u):
    return u[0] + u[1]


def _fired(sign):
    """On the line at which the thruster fires: slides where it pushes back across it."""

    def mode(t, u, p):
        return f"slide {sign}" if abs(u[1]) < p.a else sign

    return mode


spelled(
    "thrusters with a dead zone",
    "relay",
    {
        "Piecewise": {
            "rates": {
                "th": "w",
                "w": "-a*Piecewise((1, th + w > 0.05), (-1, th + w < -0.05), (0, True))",
            }
        },
        "signs": {
            "rates": {"th": "w", "w": "-a*(sign(th + w - 0.05) + sign(th + w + 0.05))/2"},
        },
    },
    initial={"th": "th0", "w": 0},
    box={"a": (0.018, 0.022), "th0": (0.14, 0.16)},
    end=12,
    reference=machine(
        {
            "+": Mode(_thruster(1), (Exit(lambda t, u, p: _line(u) - 0.05, "off"),)),
            "-": Mode(_thruster(-1), (Exit(lambda t, u, p: -0.05 - _line(u), "off"),)),
            "off": Mode(
                _thruster(0),
                (
                    Exit(lambda t, u, p: 0.05 - _line(u), _fired("+")),
                    Exit(lambda t, u, p: 0.05 + _line(u), _fired("-")),
                ),
            ),
            "slide +": Mode(lambda t, u, p: (u[1], -u[1])),
            "slide -": Mode(lambda t, u, p: (u[1], -u[1])),
        },
        "+",
        lambda p: (p.th0, 0),
    ),
    hard=True,
)


def _reached(t, u, p):
    if abs(u[1]) < p.c:
        return "slide"
    return "+" if u[1] > 0 else "-"


add(
    "sliding mode control",
    "relay",
    rates={"x": "v", "v": "-sign(x + c*v)"},
    initial={"x": "x0", "v": 0},
    box={"x0": (0.8, 1.2), "c": (0.3, 0.6)},
    end=6,
    reference=machine(
        {
            "+": Mode(
                lambda t, u, p: (u[1], -1), (Exit(lambda t, u, p: u[0] + p.c * u[1], _reached),)
            ),
            "-": Mode(
                lambda t, u, p: (u[1], 1), (Exit(lambda t, u, p: -u[0] - p.c * u[1], _reached),)
            ),
            "slide": Mode(lambda t, u, p: (u[1], -u[1] / p.c)),
        },
        "+",
        lambda p: (p.x0, 0),
    ),
)


def _lags(power):
    def rates(t, u, p):
        x, y, z = u
        return power - x, 2 * (x - y), 2 * (y - z)

    return rates


add(
    "relay autotuning",
    "relay",
    rates={"x": "sign(r - z) - x", "y": "2*(x - y)", "z": "2*(y - z)"},
    initial={"x": 0, "y": 0, "z": 0},
    box={"r": (0.2, 0.4)},
    end=8,
    reference=machine(
        {
            "up": Mode(_lags(1), (Exit(lambda t, u, p: p.r - u[2], "down"),)),
            "down": Mode(_lags(-1), (Exit(lambda t, u, p: u[2] - p.r, "up"),)),
        },
        "up",
        lambda p: (0, 0, 0),
    ),
)

# -- dead zones -----------------------------------------------------------------------------------


def _dead(e, d):
    return e - clip(-d, e, d)


spelled(
    "valve with a dead band",
    "dead zone",
    {
        "Max and Min": {"rates": {"x": "2*(Max(0, e - d) + Min(0, e + d))"}},
        "Piecewise": {"rates": {"x": "2*Piecewise((e - d, e > d), (e + d, e < -d), (0, True))"}},
        "clipped off": {"rates": {"x": "2*(e - Max(-d, Min(d, e)))"}},
    },
    initial={"x": 0},
    box={"k": (3, 5), "d": (0.1, 0.3)},
    end=8,
    definitions={"e": "k*(sin(t)/2 - x)"},
    reference=kinked(lambda t, u, p: (2 * _dead(p.k * (sin(t) / 2 - u[0]), p.d),), lambda p: (0,)),
)


def _gear(t, u, p):
    a, v, b, w = u
    torque = 40 * _dead(a - b, p.gap)
    return v, 2 * sin(2 * t) - 0.5 * v - torque, w, (torque - 0.4 * w) / 2


add(
    "gear with play",
    "dead zone",
    rates={
        "a": "v",
        "v": "2*sin(2*t) - v/2 - M",
        "b": "w",
        "w": "(M - 0.4*w)/2",
    },
    initial={"a": 0, "v": 0, "b": 0, "w": 0},
    box={"gap": (0.05, 0.1)},
    end=5,
    definitions={
        "M": "40*Piecewise((a - b - gap, a - b > gap), (a - b + gap, a - b < -gap), (0, True))"
    },
    reference=kinked(_gear, lambda p: (0, 0, 0, 0)),
    hard=True,
)

# -- friction -------------------------------------------------------------------------------------

# A block on a spring, 9.81 m/s² times the coefficient of friction, that swings until it sticks.
spelled(
    "block on a spring",
    "friction",
    {
        "sign": {"rates": {"x": "v", "v": "-9*x - 9.81*mu*sign(v)"}},
        "Piecewise": {
            "rates": {
                "x": "v",
                "v": "-9*x - Piecewise((9.81*mu, v > 0), (-9.81*mu, v < 0), (0, True))",
            }
        },
    },
    initial={"x": "x0", "v": 0},
    box={"mu": (0.25, 0.35), "x0": (1.5, 2)},
    end=3,
    reference=friction(
        lambda t, u, p: (u[1], -9 * u[0]),
        [(1, lambda u, p: u[1], lambda u, p: 9.81 * p.mu)],
        lambda p: (p.x0, 0),
    ),
)

add(
    "motor with dry friction from rest",
    "friction",
    rates={"i": "(V - i - 0.05*w)/0.005", "w": "(0.05*i - Tf*sign(w) - 1e-4*w)/2e-4"},
    initial={"i": 0, "w": 0},
    box={"V": (6, 12), "Tf": (0.01, 0.03)},
    end=0.1,
    reference=friction(
        lambda t, u, p: ((p.V - u[0] - 0.05 * u[1]) / 0.005, (0.05 * u[0] - 1e-4 * u[1]) / 2e-4),
        [(1, lambda u, p: u[1], lambda u, p: p.Tf / 2e-4)],
        lambda p: (0, 0),
    ),
)


def _positioned(t, u, p):
    th, w = u
    volts = clip(-24, p.kp * (1 - th) - 0.8 * w, 24)
    return w, (0.05 * volts - 0.002 * w) / 0.004


add(
    "positioning with friction and saturation",
    "friction",
    rates={
        "th": "w",
        "w": "(0.05*Max(-24, Min(24, kp*(1 - th) - 0.8*w)) - Tf*sign(w) - 0.002*w)/0.004",
    },
    initial={"th": 0, "w": 0},
    box={"kp": (15, 40), "Tf": (0.02, 0.04)},
    end=1,
    reference=friction(
        _positioned, [(1, lambda u, p: u[1], lambda u, p: p.Tf / 0.004)], lambda p: (0, 0)
    ),
    hard=True,
)


def _stribeck(u, p):
    slip = abs(u[1] - p.belt)
    return 0.6 + 0.4 * exp(-slip / 0.2)


add(
    "stick and slip on a belt",
    "friction",
    rates={"x": "v", "v": "-x - (0.6 + 0.4*exp(-Abs(v - belt)/0.2))*sign(v - belt)"},
    initial={"x": 0, "v": 0},
    box={"belt": (0.3, 0.5)},
    end=12,
    reference=friction(
        lambda t, u, p: (u[1], -u[0]),
        [(1, lambda u, p: u[1] - p.belt, _stribeck)],
        lambda p: (0, 0),
    ),
    hard=True,
)


def _incline(p, times):
    g, mu = 9.81, 0.3
    up, down = g * (sin(p.al) + mu * cos(p.al)), max(0.0, g * (sin(p.al) - mu * cos(p.al)))
    top = p.v0 / up
    late = np.maximum(times - top, 0.0)
    early = np.minimum(times, top)
    return np.array(
        [p.v0 * early - up * early**2 / 2 - down * late**2 / 2, p.v0 - up * early - down * late]
    )


add(
    "block shot up an incline",
    "friction",
    rates={"s": "v", "v": "-9.81*sin(al) - 0.3*9.81*cos(al)*sign(v)"},
    initial={"s": 0, "v": "v0"},
    box={"v0": (3, 5), "al": (0.2, 0.5)},
    end=1.5,
    reference=_incline,
)

add(
    "sledge that pulls a second one",
    "friction",
    rates={
        "x": "v",
        "v": "F - 4*(x - y) - 0.4*sign(v) - 0.3*v",
        "y": "w",
        "w": "4*(x - y) - mu*sign(w) - 0.3*w",
    },
    initial={"x": 0, "v": 0, "y": 0, "w": 0},
    box={"F": (1.6, 2), "mu": (0.5, 0.8)},
    end=3,
    reference=friction(
        lambda t, u, p: (
            u[1],
            p.F - 4 * (u[0] - u[2]) - 0.3 * u[1],
            u[3],
            4 * (u[0] - u[2]) - 0.3 * u[3],
        ),
        [
            (1, lambda u, p: u[1], lambda u, p: 0.4),
            (3, lambda u, p: u[3], lambda u, p: p.mu),
        ],
        lambda p: (0, 0, 0, 0),
    ),
    hard=True,
)

# -- limits that hold a state ---------------------------------------------------------------------


def _depleted(p, times):
    eaten = p.k * np.where(times < 2, 0.5 * times, 1.0 + 1.5 * (times - 2))
    product = np.minimum(eaten, p.S0)
    return np.array([p.S0 - product, product])


# A substrate, turned over by an enzyme of which more is added after two hours, until it is gone.
spelled(
    "depleted substrate",
    "rest",
    {
        "while there is some": {
            "rates": {
                "S": "-Piecewise((k*e, S > 0), (0, True))",
                "P": "Piecewise((k*e, S > 0), (0, True))",
                "e": "0",
            }
        },
        "none once it is gone": {
            "rates": {
                "S": "-Piecewise((0, S <= 0), (k*e, True))",
                "P": "Piecewise((0, S <= 0), (k*e, True))",
                "e": "0",
            }
        },
    },
    initial={"S": "S0", "P": 0, "e": 0.5},
    box={"k": (0.5, 1.5), "S0": (2, 3)},
    end=5,
    jumps={2: {"e": "e + 1"}},
    reference=_depleted,
    compared=("S", "P"),
)


def _clipped(p, times):
    reach = np.arcsin(1 / p.k)
    rising = p.k * np.sin(times)
    return np.where(
        times < reach, rising, np.where(times < pi / 2, 1.0, 1 + p.k * (np.sin(times) - 1))
    )[None]


add(
    "reservoir that leaves its limit later",
    "rest",
    rates={"x": "Piecewise((0, (x >= 1) & (cos(t) > 0)), (k*cos(t), True))"},
    initial={"x": 0},
    box={"k": (1.2, 2)},
    end=5,
    reference=_clipped,
)


def _net(t, h, p):
    return p.a + 0.5 * sin(t) - 0.3 * h


# A tank that overflows at one metre until less flows in than out.
spelled(
    "overflowing tank",
    "rest",
    {
        "condition": {"rates": {"h": "Piecewise((0, (h >= 1) & (net > 0)), (net, True))"}},
        "Min at the brim": {"rates": {"h": "Piecewise((Min(0, net), h >= 1), (net, True))"}},
    },
    initial={"h": "h0"},
    box={"a": (0.3, 0.5), "h0": (0.3, 0.8)},
    end=10,
    definitions={"net": "a + sin(t)/2 - 0.3*h"},
    reference=machine(
        {
            "free": Mode(
                lambda t, u, p: (_net(t, u[0], p),),
                (Exit(lambda t, u, p: 1 - u[0], "full", lambda t, u, p: (1.0,)),),
            ),
            "full": Mode(lambda t, u, p: (0.0,), (Exit(lambda t, u, p: _net(t, 1.0, p), "free"),)),
        },
        "free",
        lambda p: (p.h0,),
    ),
)


def _supply(t, p):
    return p.a * max(0.0, sin(t)) - 0.4


add(
    "cistern that runs dry",
    "rest",
    rates={"h": "Piecewise((0, (h <= 0) & (net < 0)), (net, True))"},
    initial={"h": "h0"},
    box={"a": (0.8, 1.2), "h0": (0.3, 0.6)},
    end=9,
    definitions={"net": "a*Max(0, sin(t)) - 0.4"},
    reference=machine(
        {
            "free": Mode(
                lambda t, u, p: (_supply(t, p),),
                (Exit(lambda t, u, p: u[0], "dry", lambda t, u, p: (0.0,)),),
            ),
            "dry": Mode(lambda t, u, p: (0.0,), (Exit(lambda t, u, p: -_supply(t, p), "free"),)),
        },
        "free",
        lambda p: (p.h0,),
    ),
    hard=True,
)


def _error(t, u, p):
    return (p.r if t < 6 else 0.3) - u[0]


def _clamped(held):
    def rates(t, u, p):
        return (1.2 * u[1] - u[0]) / 0.5, 0.0 if held else _error(t, u, p)

    return rates


add(
    "integrator clamped at both ends",
    "rest",
    rates={
        "x": "(1.2*q - x)/0.5",
        "q": "Piecewise((0, (q >= 1) & (e > 0)), (0, (q <= -1) & (e < 0)), (e, True))",
    },
    initial={"x": 0, "q": 0},
    box={"r": (1.3, 1.8)},
    end=9,
    definitions={"e": "Piecewise((r, t < 6), (0.3, True)) - x"},
    reference=machine(
        {
            "free": Mode(
                _clamped(False),
                (
                    Exit(lambda t, u, p: 1 - u[1], "held", lambda t, u, p: (u[0], 1.0)),
                    Exit(lambda t, u, p: 1 + u[1], "never"),
                ),
            ),
            "held": Mode(_clamped(True), (Exit(_error, "free"),)),
        },
        lambda t, u, p: "held" if u[1] >= 1 and _error(t, u, p) > 0 else "free",
        lambda p: (0, 0),
        lambda p: (6,),
    ),
    hard=True,
)


def _upper(h, p):
    return p.Q - 0.3 * sqrt(h)


add(
    "upper tank that overflows into a lower one",
    "rest",
    rates={
        "g": "Piecewise((0, (g >= 1) & (net > 0)), (net, True))",
        "h": "0.3*sqrt(g) + Piecewise((net, (g >= 1) & (net > 0)), (0, True)) - 0.4*sqrt(h)",
    },
    initial={"g": "g0", "h": 0.2},
    box={"Q": (0.4, 0.6), "g0": (0.3, 0.7)},
    end=6,
    definitions={"net": "Q - 0.3*sqrt(g)"},
    reference=machine(
        {
            "filling": Mode(
                lambda t, u, p: (_upper(u[0], p), 0.3 * sqrt(u[0]) - 0.4 * sqrt(u[1])),
                (Exit(lambda t, u, p: 1 - u[0], "full", lambda t, u, p: (1.0, u[1])),),
            ),
            "full": Mode(lambda t, u, p: (0.0, p.Q - 0.4 * sqrt(u[1]))),
        },
        "filling",
        lambda p: (p.g0, 0.2),
    ),
)


def _pushed(t, u, p):
    return p.F * cos(t) - 0.5 * u[1]


add(
    "piston held by its end stop",
    "rest",
    rates={"x": "Piecewise((0, (x >= 1) & (v > 0)), (v, True))", "v": "F*cos(t) - v/2"},
    initial={"x": 0, "v": 0},
    box={"F": (1, 1.5)},
    end=5,
    reference=machine(
        {
            "free": Mode(
                lambda t, u, p: (u[1], _pushed(t, u, p)),
                (Exit(lambda t, u, p: 1 - u[0], "held", lambda t, u, p: (1.0, u[1])),),
            ),
            "held": Mode(
                lambda t, u, p: (0.0, _pushed(t, u, p)), (Exit(lambda t, u, p: u[1], "free"),)
            ),
        },
        "free",
        lambda p: (0, 0),
    ),
)

add(
    "tank that drains by Torricelli's law",
    "rest",
    rates={"h": "-c*sqrt(Max(h, 0))"},
    initial={"h": "h0"},
    box={"c": (0.4, 0.6), "h0": (0.5, 1)},
    end=4,
    reference=lambda p, times: np.maximum(sqrt(p.h0) - p.c * times / 2, 0.0)[None] ** 2,
)

# -- time switches --------------------------------------------------------------------------------


def _filled(rate, k, since):
    """What a constant inflow, lost at the rate k, adds up to after a time."""
    return rate / k * -np.expm1(-k * np.maximum(since, 0.0))


# Inflow on at 3, and off at a time that may come before.
spelled(
    "on at three, off at a",
    "time switch",
    {
        "Heaviside": {"rates": {"x": "Heaviside(t - 3) - Heaviside(t - a) - k*x"}},
        "Piecewise": {
            "rates": {
                "x": "Piecewise((1, t > 3), (0, True)) - Piecewise((1, t > a), (0, True)) - k*x"
            }
        },
        "events": {
            "rates": {"x": "r - k*x", "r": "0"},
            "initial": {"x": 0, "r": 0},
            "events": [
                {"when": "t - 3", "direction": "rising", "then": {"r": "r + 1"}, "name": "on"},
                {"when": "t - a", "direction": "rising", "then": {"r": "r - 1"}, "name": "off"},
            ],
        },
    },
    initial={"x": 0},
    box={"a": (2, 4), "k": (0.5, 1)},
    end=6,
    compared=("x",),
    reference=lambda p, times: (_filled(1, p.k, times - 3) - _filled(1, p.k, times - p.a))[None],
)

spelled(
    "pulse around a",
    "time switch",
    {
        "distance": {"rates": {"x": "Piecewise((1, Abs(t - a) < 1), (0, True)) - k*x"}},
        "between": {"rates": {"x": "Piecewise((1, (t > a - 1) & (t < a + 1)), (0, True)) - k*x"}},
        "Heaviside": {"rates": {"x": "Heaviside(t - a + 1) - Heaviside(t - a - 1) - k*x"}},
        "events": {
            "rates": {"x": "r - k*x", "r": "0"},
            "initial": {"x": 0, "r": 0},
            "events": [
                {"when": "t - a + 1", "direction": "rising", "then": {"r": "1"}, "name": "on"},
                {"when": "t - a - 1", "direction": "rising", "then": {"r": "0"}, "name": "off"},
            ],
        },
    },
    initial={"x": 0},
    box={"a": (2, 4), "k": (0.5, 1)},
    end=8,
    compared=("x",),
    reference=lambda p, times: (
        _filled(1, p.k, times - p.a + 1) - _filled(1, p.k, times - p.a - 1)
    )[None],
)


def _infused(t, u, p):
    x, y = u
    inflow = sum(100 / p.D for a in (0, 2) if a + p.lag < t < a + p.lag + p.D)
    return inflow - p.ke * x - p.kp * x + 0.5 * y, p.kp * x - 0.5 * y


# Two infusions of unknown lag and length, which overlap where they last longer than two hours.
spelled(
    "overlapping infusions",
    "time switch",
    {
        "Piecewise": {
            "definitions": {
                "inflow": "Piecewise((100/D, (t > lag) & (t < lag + D)), (0, True))"
                " + Piecewise((100/D, (t > 2 + lag) & (t < 2 + lag + D)), (0, True))"
            }
        },
        "Heaviside": {
            "definitions": {
                "inflow": "100/D*(Heaviside(t - lag) - Heaviside(t - lag - D)"
                " + Heaviside(t - 2 - lag) - Heaviside(t - 2 - lag - D))"
            }
        },
        "events": {
            "rates": {"x": "r - ke*x - kp*x + y/2", "y": "kp*x - y/2", "r": "0"},
            "initial": {"x": 0, "y": 0, "r": 0},
            "events": [
                {"when": f"t - lag - {at}", "direction": "rising", "then": {"r": f"r {by}"}}
                for at, by in (
                    ("0", "+ 100/D"),
                    ("D", "- 100/D"),
                    ("2", "+ 100/D"),
                    ("2 - D", "- 100/D"),
                )
            ],
        },
    },
    rates={"x": "inflow - ke*x - kp*x + y/2", "y": "kp*x - y/2"},
    initial={"x": 0, "y": 0},
    box={"ke": (0.2, 0.4), "kp": (0.3, 0.6), "lag": (0.2, 1), "D": (1, 3)},
    end=10,
    compared=("x", "y"),
    reference=kinked(
        _infused,
        lambda p: (0, 0),
        lambda p: (p.lag, p.lag + p.D, 2 + p.lag, 2 + p.lag + p.D),
    ),
    hard=True,
)


def _limited(t, u, p):
    return (min(1, p.k * ((0 if t < 1 else 2) - u[0])),)


spelled(
    "stepwise set point within a limit",
    "nested",
    {
        "Piecewise": {"rates": {"x": "Min(1, k*(Piecewise((0, t < 1), (2, True)) - x))"}},
        "Heaviside": {"rates": {"x": "Min(1, k*(2*Heaviside(t - 1) - x))"}},
    },
    initial={"x": "x0"},
    box={"k": (0.5, 2), "x0": (0, 0.5)},
    end=5,
    reference=kinked(_limited, lambda p: (p.x0,), lambda p: (1,)),
)


def _oven(t, u, p):
    goal = 30 if t < p.a else (80 if t < 3 * p.a else 50)
    return ((100 * clip(0, 0.1 * (goal - u[0]), 1) - (u[0] - 20)) / p.tau,)


add(
    "oven with a programme of steps",
    "time switch",
    rates={"T": "(100*Max(0, Min(1, (goal - T)/10)) - (T - 20))/tau"},
    initial={"T": 20},
    box={"a": (4, 6), "tau": (8, 12)},
    end=30,
    definitions={"goal": "Piecewise((30, t < a), (80, t < 3*a), (50, True))"},
    reference=kinked(_oven, lambda p: (20,), lambda p: (p.a, 3 * p.a)),
)

add(
    "chopper with a duty cycle",
    "time switch",
    rates={"i": "(Piecewise((24, Mod(t, 1) < d), (0, True)) - 2*i)/L"},
    initial={"i": 0},
    box={"d": (0.3, 0.6), "L": (1, 2)},
    end=5,
    reference=kinked(
        lambda t, u, p: (((24 if t % 1 < p.d else 0) - 2 * u[0]) / p.L,),
        lambda p: (0,),
        lambda p: [n + share for n in range(5) for share in (0, p.d)],
    ),
)

# -- nested conditions, guards, events beside switches --------------------------------------------


def _goal(t):
    return 2.0 if t < 4 else 4.0


def _feeding(t, u, p):
    if u[0] < _goal(t) - 1e-9:
        return "feed"
    return "hold" if u[0] <= _goal(t) + 1e-9 else "starve"


add(
    "feeding up to a level that depends on time",
    "nested",
    rates={"S": "Piecewise((F, S < Piecewise((2, t < 4), (4, True))), (0, True)) - m*S"},
    initial={"S": 0.5},
    box={"F": (2, 3), "m": (0.2, 0.4)},
    end=8,
    reference=machine(
        {
            "feed": Mode(
                lambda t, u, p: (p.F - p.m * u[0],),
                (Exit(lambda t, u, p: _goal(t) - u[0], "hold", lambda t, u, p: (_goal(t),)),),
            ),
            "hold": Mode(lambda t, u, p: (0.0,)),
        },
        _feeding,
        lambda p: (0.5,),
        lambda p: (4,),
    ),
)


def _stirred(t, u, p):
    volume, mass = u
    used = 0.4 * volume * (mass / volume) ** 2 if volume > 0 else 0.0
    return p.F, p.F * p.c - used


add(
    "tank that is empty at the start",
    "nested",
    rates={"V": "F", "m": "F*c - Piecewise((0.4*V*(m/V)**2, V > 0), (0, True))"},
    initial={"V": 0, "m": 0},
    box={"F": (0.5, 1), "c": (1, 3)},
    end=5,
    reference=kinked(_stirred, lambda p: (0, 0)),
)


def _spun(t, u, p):
    w, q = u
    return (10 * clip(-12, p.Kp * (100 - w) + p.Ki * q, 12) - w) / 0.2, 100 - w


add(
    "speed control that marks when it has settled",
    "nested",
    rates={"w": "(10*Max(-12, Min(12, Kp*(100 - w) + Ki*q)) - w)/0.2", "q": "100 - w"},
    initial={"w": 0, "q": 0},
    box={"Kp": (0.3, 0.5), "Ki": (0.8, 1.2)},
    end=2,
    events=[{"when": "Abs(w - 100) - 2", "direction": "falling", "name": "settled"}],
    reference=kinked(_spun, lambda p: (0, 0)),
    hard=True,
)


def _air(t):
    return 5 * sin(0.5 * t) - 1


def _snow(t, u, p):
    if _air(t) <= 0:
        return "snow"
    return "melt" if u[0] > 0 else "bare"


add(
    "snow that falls, melts and is gone",
    "nested",
    rates={
        "S": "Piecewise((p, air <= 0), (Piecewise((-c*air, S > 0), (0, True)), True))",
    },
    initial={"S": 3},
    box={"p": (0.8, 1.2), "c": (0.5, 0.8)},
    end=20,
    definitions={"air": "5*sin(t/2) - 1"},
    reference=machine(
        {
            "snow": Mode(lambda t, u, p: (p.p,), (Exit(lambda t, u, p: -_air(t), _snow),)),
            "melt": Mode(
                lambda t, u, p: (-p.c * _air(t),),
                (
                    Exit(lambda t, u, p: u[0], "bare", lambda t, u, p: (0.0,)),
                    Exit(lambda t, u, p: _air(t), "snow"),
                ),
            ),
            "bare": Mode(lambda t, u, p: (0.0,), (Exit(lambda t, u, p: _air(t), "snow"),)),
        },
        _snow,
        lambda p: (3.0,),
        lambda p: [
            turn
            for n in range(2)
            for turn in (4 * pi * n + 2 * np.arcsin(0.2), 4 * pi * n + 2 * (pi - np.arcsin(0.2)))
        ],
    ),
    hard=True,
)


def _gain(far):
    def rates(t, u, p):
        return u[1], -p.K * far * (u[0] - 1) - 2 * u[1]

    return rates


add(
    "gains by the size of the error",
    "nested",
    rates={
        "x": "v",
        "v": "K*gain*(1 - x) - 2*v",
    },
    definitions={
        "e": "Abs(x - 1)",
        "gain": "Piecewise((1, e > 0.5), (Piecewise((2, e > 0.1), (4, True)), True))",
    },
    initial={"x": 0, "v": 0},
    box={"K": (3, 5)},
    end=4,
    reference=machine(
        {
            "far": Mode(_gain(1), (Exit(lambda t, u, p: abs(u[0] - 1) - 0.5, "middle"),)),
            "middle": Mode(
                _gain(2),
                (
                    Exit(lambda t, u, p: 0.5 - abs(u[0] - 1), "far"),
                    Exit(lambda t, u, p: abs(u[0] - 1) - 0.1, "near"),
                ),
            ),
            "near": Mode(_gain(4), (Exit(lambda t, u, p: 0.1 - abs(u[0] - 1), "middle"),)),
        },
        "far",
        lambda p: (0, 0),
    ),
    hard=True,
)
