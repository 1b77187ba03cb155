"""Published systems of ordinary differential equations, with uncertain parameters.

Every entry has the system twice: in SymPy, as a user would write it, and in NumPy by hand for
independent trajectories. Boxes are of the size the literature discusses, or 10 to 30 per cent about
its values; horizons are such that trajectories from the whole box stay comparable. Citations are of
the model; values, boxes and horizons are ours unless the citation says "values".

Kinds: *polynomial* and *rational* in the unknowns (a coefficient may be any function),
*transcendental* (sines, exponentials, roots, real powers), *nonsmooth* (kinks in the unknowns),
*forced* (explicit time), *stiff*, *steep* (in the parameters).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp

from rankone import Problem
from tests.reference.measure import Array, Independent

__all__ = ["KINDS", "PUBLISHED", "Published"]

KINDS = ("polynomial", "rational", "transcendental", "nonsmooth", "forced", "stiff", "steep")

Expressions = list[Any]
Rows = list[Array]


@dataclass(frozen=True)
class Published:
    """A published system.

    Attributes
    ----------
    name : str
    kind : str
        One of KINDS.
    citation : str
    unknowns : tuple of str
    parameters : mapping of str to (float, float)
    symbolic : callable
        ``symbolic(t, u, p)`` in SymPy: for each unknown its right-hand side (or an equation, if
        the derivatives are given implicitly) and the list of initial values.
    independent : Independent
        The same in NumPy.
    """

    name: str
    kind: str
    citation: str
    unknowns: tuple[str, ...]
    parameters: Mapping[str, tuple[float, float]]
    symbolic: Callable[[Any, Any, Any], tuple[Expressions, Expressions]]
    independent: Independent

    def problem(self) -> Problem:
        """The problem in SymPy."""
        t = sp.Symbol("t")
        u = [sp.Function(name)(t) for name in self.unknowns]
        p = [sp.Symbol(name) for name in self.parameters]
        rates, initial = self.symbolic(t, u, p)
        return Problem(
            equations=[
                rate if isinstance(rate, sp.Eq) else sp.Eq(state.diff(t), rate, evaluate=False)
                for state, rate in zip(u, rates, strict=True)
            ],
            time=(t, self.independent.start, self.independent.end),
            parameters=dict(zip(p, self.parameters.values(), strict=True)),
            initial=dict(zip(u, initial, strict=True)),
            name=self.name,
        )


PUBLISHED: dict[str, Published] = {}


def _publish(
    name: str,
    kind: str,
    citation: str,
    symbolic: Callable[[Any, Any, Any], tuple[Expressions, Expressions]],
    rhs: Callable[[float, Array, Array], Rows],
    initial: Callable[[Array], list[Array | float]],
    *,
    unknowns: str,
    box: Mapping[str, tuple[float, float]],
    end: float,
    sizes: tuple[float, ...],
    stiff: bool = False,
    start: float = 0.0,
) -> None:
    assert name not in PUBLISHED
    assert kind in KINDS
    independent = Independent(rhs, initial, tuple(box.values()), end, sizes, stiff, start)
    PUBLISHED[name] = Published(
        name, kind, citation, tuple(unknowns.split()), box, symbolic, independent
    )


# -- mechanics ------------------------------------------------------------------------------------


def _pendulum(t, u, p):
    (angle, speed), (g, c, start) = u, p
    return [speed, -g * sp.sin(angle) - c * speed], [start, 0]


def _pendulum_rhs(t, u, p):
    return [u[1], -p[0] * np.sin(u[0]) - p[1] * u[1]]


_publish(
    "pendulum",
    "transcendental",
    "S. H. Strogatz, Nonlinear Dynamics and Chaos, Perseus 1994, section 6.7 (damped pendulum)",
    _pendulum,
    _pendulum_rhs,
    lambda p: [p[2], 0.0],
    unknowns="theta omega",
    box={"g": (9.0, 10.5), "c": (0.1, 0.5), "a": (0.5, 2.5)},
    end=4.0,
    sizes=(2.5, 6.0),
)


def _three_pendula(t, u, p):
    (a1, a2, a3, w1, w2, w3), (g, k, c, s1, s3) = u, p
    rates = [
        w1,
        w2,
        w3,
        -g * sp.sin(a1) + k * (a2 - a1) - c * w1,
        -g * sp.sin(a2) + k * (a1 - 2 * a2 + a3) - c * w2,
        -g * sp.sin(a3) + k * (a2 - a3) - c * w3,
    ]
    return rates, [s1, 0, s3, 0, 0, 0]


def _three_pendula_rhs(t, u, p):
    angle, speed = u[:3], u[3:]
    stretch = np.diff(angle, axis=0)
    spring = np.stack([stretch[0], stretch[1] - stretch[0], -stretch[1]])
    return [*speed, *(-p[0] * np.sin(angle) + p[1] * spring - p[2] * speed)]


_publish(
    "three_pendula",
    "transcendental",
    "J. R. Taylor, Classical Mechanics, University Science Books 2005, section 11.6 (three "
    "coupled pendulums; there for small angles)",
    _three_pendula,
    _three_pendula_rhs,
    lambda p: [p[3], 0.0, p[4], 0.0, 0.0, 0.0],
    unknowns="a1 a2 a3 w1 w2 w3",
    box={"g": (9.3, 10.3), "k": (1.0, 2.0), "c": (0.05, 0.2), "s1": (0.5, 1.5), "s3": (-0.5, 0.5)},
    end=3.0,
    sizes=(1.5, 1.0, 1.0, 4.0, 2.0, 2.0),
)


def _double_pendulum(t, u, p):
    (a, b, v, w), (ratio, a0, b0) = u, p
    g = 9.81
    upper = (1 + ratio) * v.diff(t) + ratio * sp.cos(a - b) * w.diff(t)
    lower = sp.cos(a - b) * v.diff(t) + w.diff(t)
    return [
        v,
        w,
        sp.Eq(upper, -ratio * w**2 * sp.sin(a - b) - (1 + ratio) * g * sp.sin(a)),
        sp.Eq(lower, v**2 * sp.sin(a - b) - g * sp.sin(b)),
    ], [a0, b0, 0, 0]


def _double_pendulum_rhs(t, u, p):
    a, b, v, w = u
    m, g = p[0], 9.81
    cos, sin = np.cos(a - b), np.sin(a - b)
    first = -m * w**2 * sin - (1.0 + m) * g * np.sin(a)
    second = v**2 * sin - g * np.sin(b)
    determinant = 1.0 + m - m * cos**2
    return [
        v,
        w,
        (first - m * cos * second) / determinant,
        ((1.0 + m) * second - cos * first) / determinant,
    ]


_publish(
    "double_pendulum",
    "transcendental",
    "L. D. Landau and E. M. Lifshitz, Mechanics, 3rd ed., Pergamon 1976, section 5, problem 1",
    _double_pendulum,
    _double_pendulum_rhs,
    lambda p: [p[1], p[2], 0.0, 0.0],
    unknowns="a b v w",
    box={"m": (0.4, 0.6), "a0": (0.5, 0.9), "b0": (0.5, 0.9)},
    end=2.0,
    sizes=(0.9, 1.0, 3.0, 4.0),
)


def _vertical_throw(t, u, p):
    (v, _), (k, v0) = u, p
    return [-9.81 - k * v * sp.Abs(v), v], [v0, 0]


def _vertical_throw_rhs(t, u, p):
    return [-9.81 - p[0] * np.sign(u[0]) * u[0] ** 2, u[0]]


_publish(
    "vertical_throw",
    "nonsmooth",
    "J. R. Taylor, Classical Mechanics, University Science Books 2005, section 2.4 (quadratic "
    "air resistance, up and down)",
    _vertical_throw,
    _vertical_throw_rhs,
    lambda p: [p[1], 0.0],
    unknowns="v h",
    box={"k": (0.01, 0.05), "v0": (15.0, 25.0)},
    end=4.0,
    sizes=(25.0, 25.0),
)


def _projectile(t, u, p):
    (_, _, v, w), (k, speed, angle) = u, p
    drag = -k * sp.sqrt(v**2 + w**2)
    return [v, w, drag * v, drag * w - 9.81], [0, 0, speed * sp.cos(angle), speed * sp.sin(angle)]


def _projectile_rhs(t, u, p):
    velocity = u[2:]
    drag = -p[0] * np.hypot(*velocity)
    return [*velocity, drag * velocity[0], drag * velocity[1] - 9.81]


_publish(
    "projectile",
    "transcendental",
    "G. W. Parker, Projectile motion with air resistance quadratic in the speed, Am. J. Phys. 45 "
    "(1977) 606-610",
    _projectile,
    _projectile_rhs,
    lambda p: [0.0, 0.0, p[1] * np.cos(p[2]), p[1] * np.sin(p[2])],
    unknowns="x y v w",
    box={"k": (0.006, 0.01), "v0": (25.0, 35.0), "a0": (0.7, 1.0)},
    end=3.5,
    sizes=(60.0, 30.0, 25.0, 30.0),
)


def _fall(t, u, p):
    (v, _), (g, k) = u, p
    return [g - k * v**2, v], [0, 0]


def _fall_rhs(t, u, p):
    return [p[0] - p[1] * u[0] * u[0], u[0]]


_publish(
    "fall",
    "polynomial",
    "J. R. Taylor, Classical Mechanics, University Science Books 2005, section 2.4 (fall from "
    "rest with quadratic air resistance)",
    _fall,
    _fall_rhs,
    lambda p: [0.0, 0.0],
    unknowns="v y",
    box={"g": (9.7, 9.9), "k": (0.05, 0.15)},
    end=4.0,
    sizes=(14.0, 40.0),
)


def _resonance(t, u, p):
    (x, v), (damping, frequency) = u, p
    return [v, -x - 2 * damping * v + sp.cos(frequency * t)], [0, 0]


def _resonance_rhs(t, u, p):
    return [u[1], np.cos(p[1] * t) - u[0] - 2.0 * p[0] * u[1]]


_publish(
    "resonance",
    "forced",
    "L. D. Landau and E. M. Lifshitz, Mechanics, 3rd ed., Pergamon 1976, section 26 (forced "
    "oscillations under friction)",
    _resonance,
    _resonance_rhs,
    lambda p: [0.0, 0.0],
    unknowns="x v",
    box={"d": (0.05, 0.15), "w": (0.6, 1.4)},
    end=30.0,
    sizes=(8.0, 8.0),
)


def _kepler(t, u, p):
    (x, y, v, w), (e, mass) = u, p
    cubed = (x**2 + y**2) ** sp.Rational(3, 2)
    return [v, w, -mass * x / cubed, -mass * y / cubed], [
        1 - e,
        0,
        0,
        sp.sqrt(mass * (1 + e) / (1 - e)),
    ]


def _kepler_rhs(t, u, p):
    distance = np.hypot(u[0], u[1])
    return [u[2], u[3], *(-p[1] * u[:2] / distance**3)]


_publish(
    "kepler",
    "transcendental",
    "E. Hairer, C. Lubich and G. Wanner, Geometric Numerical Integration, 2nd ed., Springer "
    "2006, section I.2 (Kepler problem)",
    _kepler,
    _kepler_rhs,
    lambda p: [1.0 - p[0], 0.0, 0.0, np.sqrt(p[1] * (1.0 + p[0]) / (1.0 - p[0]))],
    unknowns="x y v w",
    box={"e": (0.0, 0.5), "m": (0.9, 1.1)},
    end=6.283185307179586,
    sizes=(1.5, 1.0, 1.0, 1.5),
)


def _rigid_body(t, u, p):
    (a, b, c), (i, j, k) = u, p
    return [(j - k) / i * b * c, (k - i) / j * c * a, (i - j) / k * a * b], [1, 0.2, 0.2]


def _rigid_body_rhs(t, u, p):
    return list(np.cross(p * u, u, axis=0) / p)


_publish(
    "rigid_body",
    "polynomial",
    "L. D. Landau and E. M. Lifshitz, Mechanics, 3rd ed., Pergamon 1976, section 36 (Euler's "
    "equations)",
    _rigid_body,
    _rigid_body_rhs,
    lambda p: [1.0, 0.2, 0.2],
    unknowns="a b c",
    box={"i": (0.9, 1.1), "j": (1.8, 2.2), "k": (2.8, 3.2)},
    end=8.0,
    sizes=(1.0, 0.6, 0.6),
)


def _kirchhoff(t, u, p):
    v, w = sp.Matrix(u[:3]), sp.Matrix(u[3:])
    mass, added, inertia = sp.diag(2, 2.5, 3), sp.diag(1, 1.5, 2), sp.diag(0.4, 0.6, 0.9)
    linear = (mass * v).cross(w) + sp.Matrix([0, 0, -0.5])
    angular = (inertia * w).cross(w) + (added * v).cross(v)
    equations = [
        *(sp.Eq(a, b) for a, b in zip(mass * v.diff(t), linear)),
        *(sp.Eq(a, b) for a, b in zip(inertia * w.diff(t), angular)),
    ]
    return equations, list(p)


def _kirchhoff_rhs(t, u, p):
    (v1, v2, v3), (w1, w2, w3) = u[:3], u[3:]
    return [
        (2.5 * v2 * w3 - 3.0 * v3 * w2) / 2.0,
        (3.0 * v3 * w1 - 2.0 * v1 * w3) / 2.5,
        (2.0 * v1 * w2 - 2.5 * v2 * w1 - 0.5) / 3.0,
        (-0.3 * w2 * w3 - 0.5 * v2 * v3) / 0.4,
        (0.5 * w3 * w1 + 1.0 * v3 * v1) / 0.6,
        (-0.2 * w1 * w2 - 0.5 * v1 * v2) / 0.9,
    ]


_publish(
    "kirchhoff",
    "polynomial",
    "H. Lamb, Hydrodynamics, 6th ed., Cambridge University Press 1932, chapter VI (a solid in an "
    "ideal fluid, after G. Kirchhoff, J. reine angew. Math. 71 (1870) 237-262)",
    _kirchhoff,
    _kirchhoff_rhs,
    list,
    unknowns="v1 v2 v3 w1 w2 w3",
    box=dict.fromkeys(("a1", "a2", "a3", "b1", "b2", "b3"), (0.5, 1.0)),
    end=1.0,
    sizes=(1.0,) * 6,
)


def _duffing(t, u, p):
    (x, v), (damping, cubic, frequency) = u, p
    return [v, 0.3 * sp.cos(frequency * t) - damping * v - x - cubic * x**3], [0.5, 0]


def _duffing_rhs(t, u, p):
    force = 0.3 * np.cos(p[2] * t)
    return [u[1], force - p[0] * u[1] - u[0] * (1.0 + p[1] * u[0] ** 2)]


_publish(
    "duffing",
    "forced",
    "G. Duffing, Erzwungene Schwingungen bei veränderlicher Eigenfrequenz, Vieweg 1918",
    _duffing,
    _duffing_rhs,
    lambda p: [0.5, 0.0],
    unknowns="x v",
    box={"d": (0.15, 0.25), "b": (0.1, 0.3), "w": (0.8, 1.3)},
    end=20.0,
    sizes=(1.5, 1.5),
)


def _mathieu(t, u, p):
    (x, v), (a, q) = u, p
    return [v, -(a - 2 * q * sp.cos(2 * t)) * x], [1, 0]


def _mathieu_rhs(t, u, p):
    return [u[1], (2.0 * p[1] * np.cos(2.0 * t) - p[0]) * u[0]]


_publish(
    "mathieu",
    "forced",
    "N. W. McLachlan, Theory and Application of Mathieu Functions, Oxford 1947, chapter II "
    "(canonical form)",
    _mathieu,
    _mathieu_rhs,
    lambda p: [1.0, 0.0],
    unknowns="x v",
    box={"a": (0.8, 1.2), "q": (0.1, 0.4)},
    end=10.0,
    sizes=(3.0, 3.0),
)


def _double_well(t, u, p):
    (x, v), (damping, start) = u, p
    return [v, x - x**3 - damping * v], [start, 0]


def _double_well_rhs(t, u, p):
    return [u[1], u[0] * (1.0 - u[0] ** 2) - p[0] * u[1]]


_publish(
    "double_well",
    "polynomial",
    "J. Guckenheimer and P. Holmes, Nonlinear Oscillations, Dynamical Systems, and Bifurcations "
    "of Vector Fields, Springer 1983, section 2.2 (here unforced and below the separatrix)",
    _double_well,
    _double_well_rhs,
    lambda p: [p[1], 0.0],
    unknowns="x v",
    box={"d": (0.1, 0.3), "a": (0.6, 1.3)},
    end=10.0,
    sizes=(1.3, 0.6),
)


def _henon_heiles(t, u, p):
    (x, y, v, w), (y0, v0, w0) = u, p
    return [v, w, -x - 2 * x * y, -y - x**2 + y**2], [0, y0, v0, w0]


def _henon_heiles_rhs(t, u, p):
    x, y = u[:2]
    return [u[2], u[3], -x * (1.0 + 2.0 * y), y * (y - 1.0) - x * x]


_publish(
    "henon_heiles",
    "polynomial",
    "M. Hénon and C. Heiles, The applicability of the third integral of motion: some numerical "
    "experiments, Astron. J. 69 (1964) 73-79",
    _henon_heiles,
    _henon_heiles_rhs,
    lambda p: [0.0, p[0], p[1], p[2]],
    unknowns="x y v w",
    box={"y0": (0.0, 0.2), "v0": (0.25, 0.35), "w0": (-0.1, 0.1)},
    end=10.0,
    sizes=(0.4, 0.4, 0.4, 0.4),
)


def _piecewise_oscillator(t, u, p):
    (x, v), (stiffness, frequency) = u, p
    contact = stiffness * sp.Max(x - 0.5, 0)
    return [v, sp.cos(frequency * t) - 0.2 * v - x - contact], [0, 0]


def _piecewise_oscillator_rhs(t, u, p):
    contact = np.where(u[0] > 0.5, p[0] * (u[0] - 0.5), 0.0)
    return [u[1], np.cos(p[1] * t) - 0.2 * u[1] - u[0] - contact]


_publish(
    "piecewise_oscillator",
    "nonsmooth",
    "S. W. Shaw and P. J. Holmes, A periodically forced piecewise linear oscillator, J. Sound "
    "Vib. 90 (1983) 129-155",
    _piecewise_oscillator,
    _piecewise_oscillator_rhs,
    lambda p: [0.0, 0.0],
    unknowns="x v",
    box={"k": (1.0, 2.0), "w": (0.9, 1.1)},
    end=10.0,
    sizes=(2.0, 2.0),
)


def _bouc_wen(t, u, p):
    (x, v, z), (n, beta) = u, p
    hysteresis = v - beta * sp.Abs(v) * sp.Abs(z) ** (n - 1) * z - 0.3 * v * sp.Abs(z) ** n
    return [v, sp.sin(t) - 0.1 * v - 0.5 * x - 0.5 * z, hysteresis], [0, 0, 0]


def _bouc_wen_rhs(t, u, p):
    x, v, z = u
    power = np.abs(z) ** p[0]
    return [
        v,
        np.sin(t) - 0.1 * v - 0.5 * (x + z),
        v - power * (p[1] * np.abs(v) * np.sign(z) + 0.3 * v),
    ]


_publish(
    "bouc_wen",
    "nonsmooth",
    "Y.-K. Wen, Method for random vibration of hysteretic systems, J. Eng. Mech. Div. ASCE 102 "
    "(1976) 249-263",
    _bouc_wen,
    _bouc_wen_rhs,
    lambda p: [0.0, 0.0, 0.0],
    unknowns="x v z",
    box={"n": (1.5, 2.5), "beta": (0.4, 0.6)},
    end=10.0,
    sizes=(3.0, 2.0, 1.2),
)


# -- circuits, tanks, fluids ----------------------------------------------------------------------


def _rlc(t, u, p):
    (charge, current), (resistance, inductance, frequency) = u, p
    voltage = 110 * sp.sin(frequency * t) - resistance * current - 100 * charge
    return [current, voltage / inductance], [0, 0]


def _rlc_rhs(t, u, p):
    return [u[1], (110.0 * np.sin(p[2] * t) - p[0] * u[1] - u[0] / 0.01) / p[1]]


_publish(
    "rlc",
    "forced",
    "E. Kreyszig, Advanced Engineering Mathematics, 10th ed., Wiley 2011, section 2.9 (RLC "
    "circuit)",
    _rlc,
    _rlc_rhs,
    lambda p: [0.0, 0.0],
    unknowns="q i",
    box={"r": (8.0, 12.0), "l": (0.08, 0.12), "w": (25.0, 40.0)},
    end=0.6,
    sizes=(0.4, 12.0),
)


def _josephson(t, u, p):
    (phase, voltage), (bias, damping) = u, p
    return [voltage, bias - damping * voltage - sp.sin(phase)], [0, 0]


def _josephson_rhs(t, u, p):
    return [u[1], p[0] - np.sin(u[0]) - p[1] * u[1]]


_publish(
    "josephson",
    "transcendental",
    "D. E. McCumber, Effect of ac impedance on dc voltage-current characteristics of "
    "superconductor weak-link junctions, J. Appl. Phys. 39 (1968) 3113-3118",
    _josephson,
    _josephson_rhs,
    lambda p: [0.0, 0.0],
    unknowns="phi v",
    box={"i": (1.2, 1.6), "d": (0.8, 1.2)},
    end=8.0,
    sizes=(10.0, 2.0),
)


def _chua(t, u, p):
    (x, y, z), (alpha, beta) = u, p
    diode = -0.68 * x - 0.295 * (sp.Abs(x + 1) - sp.Abs(x - 1))
    return [alpha * (y - x - diode), x - y + z, -beta * y], [0.5, 0, 0]


def _chua_rhs(t, u, p):
    x, y, z = u
    inner, outer = -1.27 * x, -0.68 * x - 0.59 * np.sign(x)
    return [p[0] * (y - x - np.where(np.abs(x) < 1.0, inner, outer)), x - y + z, -p[1] * y]


_publish(
    "chua",
    "nonsmooth",
    "T. Matsumoto, A chaotic attractor from Chua's circuit, IEEE Trans. Circuits Syst. 31 (1984) "
    "1055-1058",
    _chua,
    _chua_rhs,
    lambda p: [0.5, 0.0, 0.0],
    unknowns="x y z",
    box={"alpha": (8.5, 9.5), "beta": (13.5, 15.0)},
    end=2.5,
    sizes=(2.5, 0.5, 3.0),
)


def _quadruple_tank(t, u, p):
    split1, split2, v1, v2 = p
    f1, f2, f3, f4 = (
        area * sp.sqrt(2 * 981 * h) for area, h in zip((0.071, 0.057, 0.071, 0.057), u)
    )
    k1, k2 = 3.33, 3.35
    return [
        (f3 - f1 + split1 * k1 * v1) / 28,
        (f4 - f2 + split2 * k2 * v2) / 32,
        ((1 - split2) * k2 * v2 - f3) / 28,
        ((1 - split1) * k1 * v1 - f4) / 32,
    ], [12.4, 12.7, 1.8, 1.4]


def _quadruple_tank_rhs(t, u, p):
    out = np.array([0.071, 0.057, 0.071, 0.057])[:, None] * np.sqrt(2.0 * 981.0 * u)
    first, second = 3.33 * p[2], 3.35 * p[3]
    inflow = np.stack([p[0] * first, p[1] * second, second - p[1] * second, first - p[0] * first])
    inflow[:2] += out[2:]
    return list((inflow - out) / np.array([28.0, 32.0, 28.0, 32.0])[:, None])


_publish(
    "quadruple_tank",
    "transcendental",
    "K. H. Johansson, The quadruple-tank process: a multivariable laboratory process with an "
    "adjustable zero, IEEE Trans. Control Syst. Technol. 8 (2000) 456-465 (values)",
    _quadruple_tank,
    _quadruple_tank_rhs,
    lambda p: [12.4, 12.7, 1.8, 1.4],
    unknowns="h1 h2 h3 h4",
    box={"g1": (0.6, 0.75), "g2": (0.55, 0.65), "v1": (2.7, 3.3), "v2": (2.7, 3.3)},
    end=200.0,
    sizes=(15.0, 15.0, 2.0, 2.0),
)


def _stommel(t, u, p):
    (warm, salt), (eta, start) = u, p
    flow = 1 + sp.Abs(warm - salt)
    return [3 - warm * flow, eta - salt * (flow - 0.7)], [1, start]


def _stommel_rhs(t, u, p):
    flow = np.abs(u[0] - u[1])
    return [3.0 - u[0] * (1.0 + flow), p[0] - u[1] * (0.3 + flow)]


_publish(
    "stommel",
    "nonsmooth",
    "H. Stommel, Thermohaline convection with two stable regimes of flow, Tellus 13 (1961) 224-230",
    _stommel,
    _stommel_rhs,
    lambda p: [1.0, p[1]],
    unknowns="x y",
    box={"e": (0.8, 1.1), "s": (1.4, 2.0)},
    end=4.0,
    sizes=(2.0, 2.0),
)


def _blasius(t, u, p):
    (f, slope, shear), (suction, wall) = u, p
    return [slope, shear, -f * shear / 2], [suction, 0, wall]


def _blasius_rhs(t, u, p):
    return [u[1], u[2], -0.5 * u[0] * u[2]]


_publish(
    "blasius",
    "polynomial",
    "H. Blasius, Grenzschichten in Flüssigkeiten mit kleiner Reibung, Z. Math. Phys. 56 (1908) "
    "1-37",
    _blasius,
    _blasius_rhs,
    lambda p: [p[0], 0.0, p[1]],
    unknowns="f g h",
    box={"s": (-0.1, 0.1), "a": (0.25, 0.4)},
    end=6.0,
    sizes=(5.0, 1.0, 0.4),
)


def _lane_emden(t, u, p):
    (theta, slope), (n,) = u, p
    start = sp.Rational(1, 10)
    value = 1 - start**2 / 6 + n * start**4 / 120
    return [slope, -2 * slope / t - theta**n], [value, -start / 3 + n * start**3 / 30]


def _lane_emden_rhs(t, u, p):
    return [u[1], -(2.0 / t) * u[1] - u[0] ** p[0]]


_publish(
    "lane_emden",
    "transcendental",
    "S. Chandrasekhar, An Introduction to the Study of Stellar Structure, University of Chicago "
    "Press 1939, chapter IV (Lane-Emden equation, from t = 0.1 by its series)",
    _lane_emden,
    _lane_emden_rhs,
    lambda p: [1.0 - 0.01 / 6 + p[0] * 1e-4 / 120, -0.1 / 3 + p[0] * 1e-3 / 30],
    unknowns="theta phi",
    box={"n": (1.5, 3.5)},
    end=2.5,
    sizes=(1.0, 0.4),
    start=0.1,
)


# -- chaotic and oscillating textbook systems, short ----------------------------------------------


def _lorenz(t, u, p):
    (x, y, z), (sigma, rho, beta) = u, p
    return [sigma * (y - x), x * (rho - z) - y, x * y - beta * z], [1, 1, 1]


def _lorenz_rhs(t, u, p):
    x, y, z = u
    return [p[0] * y - p[0] * x, p[1] * x - x * z - y, x * y - p[2] * z]


_publish(
    "lorenz",
    "polynomial",
    "E. N. Lorenz, Deterministic nonperiodic flow, J. Atmos. Sci. 20 (1963) 130-141, equations "
    "(25)-(27)",
    _lorenz,
    _lorenz_rhs,
    lambda p: [1.0, 1.0, 1.0],
    unknowns="x y z",
    box={"sigma": (9.0, 11.0), "rho": (26.0, 30.0), "beta": (2.4, 2.9)},
    end=1.0,
    sizes=(20.0, 25.0, 45.0),
)


def _roessler(t, u, p):
    (x, y, z), (a, b, c) = u, p
    return [-y - z, x + a * y, b + z * (x - c)], [1, 1, 0]


def _roessler_rhs(t, u, p):
    x, y, z = u
    return [-(y + z), x + p[0] * y, p[1] + x * z - p[2] * z]


_publish(
    "roessler",
    "polynomial",
    "O. E. Rössler, An equation for continuous chaos, Phys. Lett. A 57 (1976) 397-398",
    _roessler,
    _roessler_rhs,
    lambda p: [1.0, 1.0, 0.0],
    unknowns="x y z",
    box={"a": (0.15, 0.25), "b": (0.15, 0.25), "c": (5.0, 6.0)},
    end=10.0,
    sizes=(5.0, 5.0, 0.1),
)


def _brusselator(t, u, p):
    (x, y), (a, b) = u, p
    return [a + x**2 * y - (b + 1) * x, b * x - x**2 * y], [1, 1]


def _brusselator_rhs(t, u, p):
    reaction = u[0] * (p[1] - u[0] * u[1])
    return [p[0] - u[0] - reaction, reaction]


_publish(
    "brusselator",
    "polynomial",
    "I. Prigogine and R. Lefever, Symmetry breaking instabilities in dissipative systems II, J. "
    "Chem. Phys. 48 (1968) 1695-1700",
    _brusselator,
    _brusselator_rhs,
    lambda p: [1.0, 1.0],
    unknowns="x y",
    box={"a": (0.9, 1.1), "b": (2.2, 2.8)},
    end=8.0,
    sizes=(3.0, 4.0),
)


def _fitzhugh_nagumo(t, u, p):
    (v, w), (current, a, b) = u, p
    return [v - v**3 / 3 - w + current, 0.08 * (v + a - b * w)], [-1, 1]


def _fitzhugh_nagumo_rhs(t, u, p):
    return [u[0] * (1.0 - u[0] ** 2 / 3.0) - u[1] + p[0], (u[0] + p[1] - p[2] * u[1]) * 0.08]


_publish(
    "fitzhugh_nagumo",
    "polynomial",
    "R. FitzHugh, Impulses and physiological states in theoretical models of nerve membrane, "
    "Biophys. J. 1 (1961) 445-466 (values a = 0.7, b = 0.8, c**-2 = 0.08 in the usual scaling)",
    _fitzhugh_nagumo,
    _fitzhugh_nagumo_rhs,
    lambda p: [-1.0, 1.0],
    unknowns="v w",
    box={"i": (0.45, 0.6), "a": (0.65, 0.75), "b": (0.75, 0.85)},
    end=25.0,
    sizes=(2.0, 1.5),
)


def _selkov(t, u, p):
    (x, y), (a, b) = u, p
    return [-x + a * y + x**2 * y, b - a * y - x**2 * y], [0.5, 1]


def _selkov_rhs(t, u, p):
    flux = (p[0] + u[0] ** 2) * u[1]
    return [flux - u[0], p[1] - flux]


_publish(
    "selkov",
    "polynomial",
    "E. E. Sel'kov, Self-oscillations in glycolysis, Eur. J. Biochem. 4 (1968) 79-86",
    _selkov,
    _selkov_rhs,
    lambda p: [0.5, 1.0],
    unknowns="x y",
    box={"a": (0.06, 0.1), "b": (0.5, 0.7)},
    end=15.0,
    sizes=(2.0, 3.0),
)


def _kuramoto(t, u, p):
    coupling, spread, start = p
    frequency = (-spread, 0, spread)
    rates = [
        w + coupling / 3 * sum(sp.sin(other - own) for other in u) for own, w in zip(u, frequency)
    ]
    return rates, [start, 0, -2 * start]


def _kuramoto_rhs(t, u, p):
    order = np.exp(1j * u).mean(axis=0)
    pull = p[0] * np.imag(order * np.exp(-1j * u))
    return list(pull + p[1] * np.array([-1.0, 0.0, 1.0])[:, None])


_publish(
    "kuramoto",
    "transcendental",
    "Y. Kuramoto, Chemical Oscillations, Waves, and Turbulence, Springer 1984, chapter 5 (here "
    "three oscillators)",
    _kuramoto,
    _kuramoto_rhs,
    lambda p: [p[2], 0.0, -2.0 * p[2]],
    unknowns="a b c",
    box={"k": (1.0, 2.0), "s": (0.1, 0.5), "a0": (0.3, 0.8)},
    end=8.0,
    sizes=(1.0, 1.0, 1.5),
)


# -- neurons --------------------------------------------------------------------------------------


def _hopfield(t, u, p):
    (x, y), (weight, gain, drive) = u, p
    return [
        -x + weight * sp.tanh(gain * y) + drive,
        -y + weight * sp.tanh(gain * x),
    ], [1, 0.5]


def _hopfield_rhs(t, u, p):
    x, y = p[0] * np.tanh(p[1] * u[::-1]) - u
    return [x + p[2], y]


_publish(
    "hopfield",
    "transcendental",
    "J. J. Hopfield, Neurons with graded response have collective computational properties like "
    "those of two-state neurons, Proc. Natl. Acad. Sci. USA 81 (1984) 3088-3092",
    _hopfield,
    _hopfield_rhs,
    lambda p: [1.0, 0.5],
    unknowns="x y",
    box={"w": (1.0, 2.0), "g": (1.0, 2.0), "i": (0.0, 0.2)},
    end=8.0,
    sizes=(2.0, 2.0),
)


def _ctrnn(t, u, p):
    (x, y), (weight, bias) = u, p

    def fired(value):
        return 1 / (1 + sp.exp(-value))

    a, b = fired(x + bias), fired(y - 1.75)
    return [-x + weight * a - b, -y + a + weight * b], [1, 0]


def _ctrnn_rhs(t, u, p):
    a = 0.5 + 0.5 * np.tanh(0.5 * (u[0] + p[1]))
    b = 0.5 + 0.5 * np.tanh(0.5 * (u[1] - 1.75))
    return [p[0] * a - b - u[0], a + p[0] * b - u[1]]


_publish(
    "ctrnn",
    "transcendental",
    "R. D. Beer, On the dynamics of small continuous-time recurrent neural networks, Adaptive "
    "Behavior 3 (1995) 469-509",
    _ctrnn,
    _ctrnn_rhs,
    lambda p: [1.0, 0.0],
    unknowns="x y",
    box={"w": (4.2, 4.8), "b": (-2.9, -2.6)},
    end=8.0,
    sizes=(1.0, 4.0),
)


def _wilson_cowan(t, u, p):
    (e, i), (drive, excitation) = u, p

    def response(x, a, theta):
        return 1 / (1 + sp.exp(-a * (x - theta))) - 1 / (1 + sp.exp(a * theta))

    return [
        -e + (1 - e) * response(excitation * e - 12 * i + drive, 1.3, 4),
        -i + (1 - i) * response(15 * e - 3 * i, 2, 3.7),
    ], [0.1, 0.05]


def _wilson_cowan_rhs(t, u, p):
    e, i = u
    excited = 1.3 * (p[1] * e - 12.0 * i + p[0] - 4.0)
    inhibited = 2.0 * (15.0 * e - 3.0 * i - 3.7)
    first = 0.5 * np.tanh(excited / 2) + 0.5 * np.tanh(1.3 * 4.0 / 2)
    second = 0.5 * np.tanh(inhibited / 2) + 0.5 * np.tanh(2.0 * 3.7 / 2)
    return [(1.0 - e) * first - e, (1.0 - i) * second - i]


_publish(
    "wilson_cowan",
    "transcendental",
    "H. R. Wilson and J. D. Cowan, Excitatory and inhibitory interactions in localized "
    "populations of model neurons, Biophys. J. 12 (1972) 1-24",
    _wilson_cowan,
    _wilson_cowan_rhs,
    lambda p: [0.1, 0.05],
    unknowns="e i",
    box={"p": (1.0, 1.5), "c": (15.0, 17.0)},
    end=8.0,
    sizes=(0.5, 0.3),
)


def _morris_lecar(t, u, p):
    (v, w), (current, calcium, leak) = u, p
    m = (1 + sp.tanh((v + 1.2) / 18)) / 2
    rest = (1 + sp.tanh((v - 2) / 30)) / 2
    ions = calcium * m * (v - 120) + 8 * w * (v + 84) + leak * (v + 60)
    return [(current - ions) / 20, 0.04 * sp.cosh((v - 2) / 60) * (rest - w)], [-60, 0.015]


def _morris_lecar_rhs(t, u, p):
    v, w = u
    m = 1.0 / (1.0 + np.exp(-(v + 1.2) / 9.0))
    rest = 1.0 / (1.0 + np.exp(-(v - 2.0) / 15.0))
    ions = p[1] * m * (v - 120.0) + 8.0 * w * (v + 84.0) + p[2] * (v + 60.0)
    return [(p[0] - ions) / 20.0, 0.04 * np.cosh((v - 2.0) / 60.0) * (rest - w)]


_publish(
    "morris_lecar",
    "transcendental",
    "C. Morris and H. Lecar, Voltage oscillations in the barnacle giant muscle fiber, Biophys. "
    "J. 35 (1981) 193-213 (below the threshold)",
    _morris_lecar,
    _morris_lecar_rhs,
    lambda p: [-60.0, 0.015],
    unknowns="v w",
    box={"i": (10.0, 40.0), "ca": (4.0, 4.8), "l": (1.8, 2.2)},
    end=100.0,
    sizes=(60.0, 0.2),
)


def _hodgkin_huxley(t, u, p):
    (v, m, h, n), (current, sodium, potassium) = u, p
    ions = sodium * m**3 * h * (v - 115) + potassium * n**4 * (v + 12) + 0.3 * (v - 10.613)
    m_on = 0.1 * (25 - v) / (sp.exp((25 - v) / 10) - 1)
    n_on = 0.01 * (10 - v) / (sp.exp((10 - v) / 10) - 1)
    h_off = 1 / (sp.exp((30 - v) / 10) + 1)
    return [
        current - ions,
        m_on * (1 - m) - 4 * sp.exp(-v / 18) * m,
        0.07 * sp.exp(-v / 20) * (1 - h) - h_off * h,
        n_on * (1 - n) - 0.125 * sp.exp(-v / 80) * n,
    ], [0, 0.0529, 0.5961, 0.3177]


def _hodgkin_huxley_rhs(t, u, p):
    v, m, h, n = u
    a, b = 2.5 - 0.1 * v, 1.0 - 0.1 * v
    m_on, n_on = a / np.expm1(a), 0.1 * b / np.expm1(b)
    h_off = 1.0 / (1.0 + np.exp(3.0 - 0.1 * v))
    sodium, potassium = p[1] * m**3 * h * (115.0 - v), p[2] * n**4 * (-12.0 - v)
    return [
        p[0] + sodium + potassium + 0.3 * (10.613 - v),
        m_on - (m_on + 4.0 * np.exp(-v / 18.0)) * m,
        0.07 * np.exp(-v / 20.0) * (1.0 - h) - h_off * h,
        n_on - (n_on + 0.125 * np.exp(-v / 80.0)) * n,
    ]


_publish(
    "hodgkin_huxley",
    "transcendental",
    "A. L. Hodgkin and A. F. Huxley, A quantitative description of membrane current and its "
    "application to conduction and excitation in nerve, J. Physiol. 117 (1952) 500-544 (values; "
    "below the threshold)",
    _hodgkin_huxley,
    _hodgkin_huxley_rhs,
    lambda p: [0.0, 0.0529, 0.5961, 0.3177],
    unknowns="v m h n",
    box={"i": (0.2, 1.0), "na": (114.0, 126.0), "k": (34.5, 37.5)},
    end=15.0,
    sizes=(3.0, 0.08, 0.6, 0.4),
)


# -- populations and epidemics --------------------------------------------------------------------


def _allee(t, u, p):
    (x,), (rate, threshold, start) = u, p
    return [rate * x * (1 - x) * (x / threshold - 1)], [start]


def _allee_rhs(t, u, p):
    return [p[0] / p[1] * u[0] * (1.0 - u[0]) * (u[0] - p[1])]


_publish(
    "allee",
    "polynomial",
    "F. Courchamp, T. Clutton-Brock and B. Grenfell, Inverse density dependence and the Allee "
    "effect, Trends Ecol. Evol. 14 (1999) 405-410",
    _allee,
    _allee_rhs,
    lambda p: [p[2]],
    unknowns="x",
    box={"r": (0.8, 1.2), "a": (0.2, 0.3), "s": (0.4, 0.6)},
    end=6.0,
    sizes=(1.0,),
)


def _gompertz(t, u, p):
    (x,), (rate, capacity, start) = u, p
    return [-rate * x * sp.log(x / capacity)], [start]


def _gompertz_rhs(t, u, p):
    return [p[0] * u[0] * (np.log(p[1]) - np.log(u[0]))]


_publish(
    "gompertz",
    "transcendental",
    "A. K. Laird, Dynamics of tumour growth, Br. J. Cancer 18 (1964) 490-502",
    _gompertz,
    _gompertz_rhs,
    lambda p: [p[2]],
    unknowns="x",
    box={"a": (0.15, 0.25), "k": (800.0, 1200.0), "s": (1.0, 10.0)},
    end=20.0,
    sizes=(1000.0,),
)


def _richards(t, u, p):
    (x,), (rate, shape, start) = u, p
    return [rate * x * (1 - x**shape)], [start]


def _richards_rhs(t, u, p):
    return [-p[0] * u[0] * np.expm1(p[1] * np.log(u[0]))]


_publish(
    "richards",
    "transcendental",
    "F. J. Richards, A flexible growth function for empirical use, J. Exp. Bot. 10 (1959) 290-301",
    _richards,
    _richards_rhs,
    lambda p: [p[2]],
    unknowns="x",
    box={"r": (0.8, 1.2), "n": (0.5, 3.0), "s": (0.05, 0.15)},
    end=6.0,
    sizes=(1.0,),
)


def _ontogenetic(t, u, p):
    (m,), (a, exponent, start) = u, p
    return [a * m**exponent - 0.05 * m], [start]


def _ontogenetic_rhs(t, u, p):
    return [p[0] * np.exp(p[1] * np.log(u[0])) - 0.05 * u[0]]


_publish(
    "ontogenetic_growth",
    "transcendental",
    "G. B. West, J. H. Brown and B. J. Enquist, A general model for ontogenetic growth, Nature "
    "413 (2001) 628-631 (there with the exponent 3/4; free here, with von Bertalanffy's 2/3 "
    "inside)",
    _ontogenetic,
    _ontogenetic_rhs,
    lambda p: [p[2]],
    unknowns="m",
    box={"a": (0.2, 0.3), "n": (0.65, 0.76), "s": (0.5, 2.0)},
    end=60.0,
    sizes=(300.0,),
)


def _sir(t, u, p):
    (s, i, _), (contact, recovery, start) = u, p
    return [-contact * s * i, contact * s * i - recovery * i, recovery * i], [1 - start, start, 0]


def _sir_rhs(t, u, p):
    infected, recovered = p[0] * u[0] * u[1], p[1] * u[1]
    return [-infected, infected - recovered, recovered]


_publish(
    "sir",
    "polynomial",
    "W. O. Kermack and A. G. McKendrick, A contribution to the mathematical theory of epidemics, "
    "Proc. R. Soc. Lond. A 115 (1927) 700-721",
    _sir,
    _sir_rhs,
    lambda p: [1.0 - p[2], p[2], 0.0],
    unknowns="s i r",
    box={"b": (0.4, 0.6), "g": (0.15, 0.25), "e": (0.005, 0.02)},
    end=30.0,
    sizes=(1.0, 0.4, 1.0),
)


def _seir(t, u, p):
    (s, e, i, _), (contact, onset, recovery) = u, p
    return [
        -contact * s * i,
        contact * s * i - onset * e,
        onset * e - recovery * i,
        recovery * i,
    ], [
        0.99,
        0.01,
        0,
        0,
    ]


def _seir_rhs(t, u, p):
    flows = np.stack([p[0] * u[0] * u[2], p[1] * u[1], p[2] * u[2]])
    return [-flows[0], flows[0] - flows[1], flows[1] - flows[2], flows[2]]


_publish(
    "seir",
    "polynomial",
    "R. M. Anderson and R. M. May, Infectious Diseases of Humans, Oxford University Press 1991 "
    "(compartments with latency)",
    _seir,
    _seir_rhs,
    lambda p: [0.99, 0.01, 0.0, 0.0],
    unknowns="s e i r",
    box={"b": (0.8, 1.2), "k": (0.2, 0.3), "g": (0.2, 0.3)},
    end=30.0,
    sizes=(1.0, 0.3, 0.3, 1.0),
)


def _saturated_sir(t, u, p):
    (s, i), (contact, saturation) = u, p
    infected = contact * s * i / (1 + saturation * i)
    return [-infected, infected - 0.2 * i], [0.98, 0.02]


def _saturated_sir_rhs(t, u, p):
    infected = p[0] * u[0] / (1.0 / u[1] + p[1])
    return [-infected, infected - u[1] / 5.0]


_publish(
    "saturated_sir",
    "rational",
    "V. Capasso and G. Serio, A generalization of the Kermack-McKendrick deterministic epidemic "
    "model, Math. Biosci. 42 (1978) 43-61",
    _saturated_sir,
    _saturated_sir_rhs,
    lambda p: [0.98, 0.02],
    unknowns="s i",
    box={"b": (0.6, 1.0), "a": (1.0, 5.0)},
    end=25.0,
    sizes=(1.0, 0.3),
)


def _lotka_volterra(t, u, p):
    (x, y), (a, b, c, d) = u, p
    return [x * (a - b * y), -y * (c - d * x)], [10, 5]


def _lotka_volterra_rhs(t, u, p):
    met = u[0] * u[1]
    return [p[0] * u[0] - p[1] * met, p[3] * met - p[2] * u[1]]


_publish(
    "lotka_volterra",
    "polynomial",
    "V. Volterra, Fluctuations in the abundance of a species considered mathematically, Nature "
    "118 (1926) 558-560",
    _lotka_volterra,
    _lotka_volterra_rhs,
    lambda p: [10.0, 5.0],
    unknowns="x y",
    box={"a": (0.9, 1.1), "b": (0.09, 0.11), "c": (1.35, 1.65), "d": (0.07, 0.08)},
    end=8.0,
    sizes=(40.0, 20.0),
)


def _rosenzweig_macarthur(t, u, p):
    (x, y), (growth, capacity, death) = u, p
    eaten = x * y / (1 + x)
    return [growth * x * (1 - x / capacity) - eaten, eaten - death * y], [1, 0.5]


def _rosenzweig_macarthur_rhs(t, u, p):
    share = u[0] / (1.0 + u[0])
    return [p[0] * u[0] - p[0] / p[1] * u[0] ** 2 - share * u[1], (share - p[2]) * u[1]]


_publish(
    "rosenzweig_macarthur",
    "rational",
    "M. L. Rosenzweig and R. H. MacArthur, Graphical representation and stability conditions of "
    "predator-prey interactions, Am. Nat. 97 (1963) 209-223",
    _rosenzweig_macarthur,
    _rosenzweig_macarthur_rhs,
    lambda p: [1.0, 0.5],
    unknowns="x y",
    box={"r": (0.8, 1.2), "k": (2.5, 3.5), "m": (0.4, 0.5)},
    end=20.0,
    sizes=(3.0, 2.0),
)


def _holling_tanner(t, u, p):
    (x, y), (growth, saturation, breeding) = u, p
    return [
        growth * x * (1 - x / 10) - 1.5 * x * y / (x + saturation),
        breeding * y * (1 - 2 * y / x),
    ], [5, 1]


def _holling_tanner_rhs(t, u, p):
    x, y = u
    eaten = 1.5 * y / (1.0 + p[1] / x)
    return [p[0] * x * (10.0 - x) / 10.0 - eaten, p[2] * (y - 2.0 * y**2 / x)]


_publish(
    "holling_tanner",
    "rational",
    "J. T. Tanner, The stability and the intrinsic growth rates of prey and predator "
    "populations, Ecology 56 (1975) 855-867",
    _holling_tanner,
    _holling_tanner_rhs,
    lambda p: [5.0, 1.0],
    unknowns="x y",
    box={"r": (0.8, 1.2), "d": (1.0, 2.0), "s": (0.2, 0.4)},
    end=15.0,
    sizes=(8.0, 4.0),
)


def _competition(t, u, p):
    (x, y), (first, second, rate) = u, p
    return [x * (1 - x - first * y), rate * y * (1 - y - second * x)], [0.1, 0.1]


def _competition_rhs(t, u, p):
    x, y = u
    return [x - x * x - p[0] * x * y, p[2] * (y - y * y - p[1] * x * y)]


_publish(
    "competition",
    "polynomial",
    "J. D. Murray, Mathematical Biology I, 3rd ed., Springer 2002, section 3.5 (competition "
    "models)",
    _competition,
    _competition_rhs,
    lambda p: [0.1, 0.1],
    unknowns="x y",
    box={"a": (0.4, 0.6), "b": (0.5, 0.7), "r": (0.8, 1.2)},
    end=15.0,
    sizes=(1.0, 1.0),
)


def _budworm(t, u, p):
    (x,), (rate, capacity, start) = u, p
    return [rate * x * (1 - x / capacity) - x**2 / (1 + x**2)], [start]


def _budworm_rhs(t, u, p):
    return [p[0] * u[0] - p[0] * u[0] ** 2 / p[1] - 1.0 + 1.0 / (1.0 + u[0] ** 2)]


_publish(
    "budworm",
    "rational",
    "D. Ludwig, D. D. Jones and C. S. Holling, Qualitative analysis of insect outbreak systems: "
    "the spruce budworm and forest, J. Anim. Ecol. 47 (1978) 315-332",
    _budworm,
    _budworm_rhs,
    lambda p: [p[2]],
    unknowns="x",
    box={"r": (0.5, 0.6), "k": (10.0, 12.0), "s": (5.0, 9.0)},
    end=20.0,
    sizes=(10.0,),
)


# -- chemistry ------------------------------------------------------------------------------------


def _enzyme(t, u, p):
    (s, e, c, _), (on, off, turnover, enzyme) = u, p
    bound = on * s * e - off * c
    return [-bound, turnover * c - bound, bound - turnover * c, turnover * c], [5, enzyme, 0, 0]


def _enzyme_rhs(t, u, p):
    flows = np.stack([p[0] * u[0] * u[1], p[1] * u[2], p[2] * u[2]])
    table = np.array([[-1.0, 1.0, 0.0], [-1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [0.0, 0.0, 1.0]])
    return list(table @ flows)


_publish(
    "enzyme",
    "polynomial",
    "L. Michaelis and M. L. Menten, Die Kinetik der Invertinwirkung, Biochem. Z. 49 (1913) "
    "333-369 (mass action: J. D. Murray, Mathematical Biology I, Springer 2002, chapter 6)",
    _enzyme,
    _enzyme_rhs,
    lambda p: [5.0, p[3], 0.0, 0.0],
    unknowns="s e c p",
    box={"kf": (0.8, 1.2), "kr": (0.4, 0.6), "kc": (0.25, 0.35), "e0": (0.8, 1.2)},
    end=15.0,
    sizes=(5.0, 1.0, 1.0, 4.0),
)


def _michaelis_menten(t, u, p):
    (s, _), (fastest, half, start) = u, p
    rate = fastest * s / (half + s)
    return [-rate, rate], [start, 0]


def _michaelis_menten_rhs(t, u, p):
    rate = p[0] * (1.0 - p[1] / (p[1] + u[0]))
    return [-rate, rate]


_publish(
    "michaelis_menten",
    "rational",
    "L. Michaelis and M. L. Menten, Die Kinetik der Invertinwirkung, Biochem. Z. 49 (1913) 333-369",
    _michaelis_menten,
    _michaelis_menten_rhs,
    lambda p: [p[2], 0.0],
    unknowns="s p",
    box={"v": (0.8, 1.2), "k": (0.3, 0.6), "s0": (1.5, 2.5)},
    end=3.0,
    sizes=(2.5, 2.5),
)


def _cstr(t, u, p):
    (x, y), (damkoehler, heat, cooling) = u, p
    rate = damkoehler * (1 - x) * sp.exp(y / (1 + y / 20))
    return [-x + rate, -y + heat * rate - cooling * y], [0, 0]


def _cstr_rhs(t, u, p):
    rate = p[0] * np.exp(20.0 * u[1] / (20.0 + u[1])) * (1.0 - u[0])
    return [rate - u[0], p[1] * rate - (1.0 + p[2]) * u[1]]


_publish(
    "cstr",
    "transcendental",
    "A. Uppal, W. H. Ray and A. B. Poore, On the dynamic behavior of continuous stirred tank "
    "reactors, Chem. Eng. Sci. 29 (1974) 967-985",
    _cstr,
    _cstr_rhs,
    lambda p: [0.0, 0.0],
    unknowns="x y",
    box={"da": (0.1, 0.14), "b": (6.0, 8.0), "c": (1.3, 1.7)},
    end=6.0,
    sizes=(0.8, 2.5),
)


def _cstr_cooled(t, u, p):
    (c, temperature), (coolant, feed) = u, p
    rate = 7.2e10 * sp.exp(-8750 / temperature) * c
    warmed = 5e4 / 239 * rate + 5e4 / 23900 * (coolant - temperature)
    return [feed - c - rate, 350 - temperature + warmed], [0.5, 350]


def _cstr_cooled_rhs(t, u, p):
    rate = np.exp(np.log(7.2e10) - 8750.0 / u[1]) * u[0]
    heat = 5e4 * rate * 100.0 + 5e4 * (p[0] - u[1]) + 100.0 * 239.0 * (350.0 - u[1])
    return [p[1] - u[0] - rate, heat / (100.0 * 239.0)]


_publish(
    "cstr_cooled",
    "transcendental",
    "D. E. Seborg, T. F. Edgar and D. A. Mellichamp, Process Dynamics and Control, 2nd ed., "
    "Wiley 2004, chapter 2 (nonisothermal stirred tank; values)",
    _cstr_cooled,
    _cstr_cooled_rhs,
    lambda p: [0.5, 350.0],
    unknowns="c temp",
    box={"tc": (285.0, 295.0), "cf": (0.95, 1.0)},
    end=3.0,
    sizes=(1.0, 350.0),
)


def _semenov(t, u, p):
    (theta,), (heat, activation) = u, p
    return [heat * sp.exp(theta / (1 + activation * theta)) - theta], [0]


def _semenov_rhs(t, u, p):
    return [np.exp(np.log(p[0]) + u[0] / (1.0 + p[1] * u[0])) - u[0]]


_publish(
    "semenov",
    "transcendental",
    "N. Semenoff, Zur Theorie des Verbrennungsprozesses, Z. Phys. 48 (1928) 571-582 (subcritical)",
    _semenov,
    _semenov_rhs,
    lambda p: [0.0],
    unknowns="theta",
    box={"d": (0.2, 0.32), "e": (0.0, 0.1)},
    end=8.0,
    sizes=(0.7,),
)


def _van_de_vusse(t, u, p):
    (a, b), (flow, first, third) = u, p
    return [flow * (10 - a) - first * a - third * a**2, -flow * b + first * a - 100 * b], [3, 1.12]


def _van_de_vusse_rhs(t, u, p):
    used = p[1] * u[0]
    return [10.0 * p[0] - p[0] * u[0] - used - p[2] * u[0] ** 2, used - (p[0] + 100.0) * u[1]]


_publish(
    "van_de_vusse",
    "polynomial",
    "J. G. van de Vusse, Plug-flow type reactor versus tank reactor, Chem. Eng. Sci. 19 (1964) "
    "994-997",
    _van_de_vusse,
    _van_de_vusse_rhs,
    lambda p: [3.0, 1.12],
    unknowns="a b",
    box={"f": (25.0, 45.0), "k1": (45.0, 55.0), "k3": (9.0, 11.0)},
    end=0.1,
    sizes=(3.0, 1.1),
)


def _lindemann(t, u, p):
    (a, b, _), (on, off, decay) = u, p
    return [
        -on * a**2 + off * a * b,
        on * a**2 - off * a * b - decay * b,
        decay * b,
    ], [1, 0, 0]


def _lindemann_rhs(t, u, p):
    excited = u[0] * (p[0] * u[0] - p[1] * u[1])
    return [-excited, excited - p[2] * u[1], p[2] * u[1]]


_publish(
    "lindemann",
    "polynomial",
    "F. A. Lindemann et al., Discussion on the radiation theory of chemical action, Trans. "
    "Faraday Soc. 17 (1922) 598-606",
    _lindemann,
    _lindemann_rhs,
    lambda p: [1.0, 0.0, 0.0],
    unknowns="a b p",
    box={"k1": (0.8, 1.2), "k2": (8.0, 12.0), "k3": (0.8, 1.2)},
    end=10.0,
    sizes=(1.0, 0.1, 1.0),
)


def _flame(t, u, p):
    (y,), (start, rate) = u, p
    return [rate * (y**2 - y**3)], [start]


def _flame_rhs(t, u, p):
    return [p[1] * u[0] * u[0] * (1.0 - u[0])]


_publish(
    "flame",
    "steep",
    "L. F. Shampine, I. Gladwell and S. Thompson, Solving ODEs with MATLAB, Cambridge University "
    "Press 2003 (flame propagation, after R. E. O'Malley)",
    _flame,
    _flame_rhs,
    lambda p: [p[0]],
    unknowns="y",
    box={"d": (0.018, 0.022), "k": (0.95, 1.05)},
    end=100.0,
    sizes=(1.0,),
    stiff=True,
)


# -- biochemistry, genes, physiology, pharmacokinetics --------------------------------------------


def _hill_gene(t, u, p):
    (x, y), (decay, loss, n) = u, p
    return [y - decay * x, x**n / (1 + x**n) - loss * y], [1.5, 1]


def _hill_gene_rhs(t, u, p):
    return [u[1] - p[0] * u[0], 1.0 / (1.0 + u[0] ** -p[2]) - p[1] * u[1]]


_publish(
    "hill_gene",
    "transcendental",
    "J. S. Griffith, Mathematics of cellular control processes II: positive feedback to one "
    "gene, J. Theor. Biol. 20 (1968) 209-216 (with the exponent of A. V. Hill, J. Physiol. 40 "
    "(1910) iv-vii, free)",
    _hill_gene,
    _hill_gene_rhs,
    lambda p: [1.5, 1.0],
    unknowns="x y",
    box={"a": (0.4, 0.5), "b": (0.6, 0.75), "n": (2.0, 4.0)},
    end=10.0,
    sizes=(3.0, 1.5),
)


def _toggle(t, u, p):
    (x, y), (first, second, n) = u, p
    return [first / (1 + y**n) - x, second / (1 + x**n) - y], [2, 0.5]


def _toggle_rhs(t, u, p):
    x, y = p[:2] / (1.0 + u[::-1] ** p[2]) - u
    return [x, y]


_publish(
    "toggle",
    "transcendental",
    "T. S. Gardner, C. R. Cantor and J. J. Collins, Construction of a genetic toggle switch in "
    "Escherichia coli, Nature 403 (2000) 339-342",
    _toggle,
    _toggle_rhs,
    lambda p: [2.0, 0.5],
    unknowns="x y",
    box={"a": (8.0, 12.0), "b": (8.0, 12.0), "n": (2.0, 3.0)},
    end=8.0,
    sizes=(12.0, 1.0),
)


def _goodwin(t, u, p):
    (x, y, z), (strength, n, loss) = u, p
    return [strength / (1 + z**n) - loss * x, x - loss * y, y - loss * z], [0.5, 0.5, 0.5]


def _goodwin_rhs(t, u, p):
    made = p[0] * (1.0 - u[2] ** p[1] / (1.0 + u[2] ** p[1]))
    return [source - p[2] * state for source, state in zip((made, u[0], u[1]), u)]


_publish(
    "goodwin",
    "transcendental",
    "B. C. Goodwin, Oscillatory behavior in enzymatic control processes, Adv. Enzyme Regul. 3 "
    "(1965) 425-438",
    _goodwin,
    _goodwin_rhs,
    lambda p: [0.5, 0.5, 0.5],
    unknowns="x y z",
    box={"a": (0.8, 1.2), "n": (8.0, 11.0), "k": (0.45, 0.55)},
    end=20.0,
    sizes=(1.0, 1.5, 2.0),
)


def _repressilator(t, u, p):
    m, q = u[:3], u[3:]
    alpha, beta, n = p
    rates = [-m[i] + alpha / (1 + q[i - 1] ** n) + 0.216 for i in range(3)]
    rates += [-beta * (q[i] - m[i]) for i in range(3)]
    return rates, [0, 0, 0, 5, 1, 15]


def _repressilator_rhs(t, u, p):
    messenger, protein = u[:3], u[3:]
    made = p[0] / (1.0 + np.roll(protein, 1, axis=0) ** p[2]) + 0.216
    return [*(made - messenger), *(p[1] * (messenger - protein))]


_publish(
    "repressilator",
    "transcendental",
    "M. B. Elowitz and S. Leibler, A synthetic oscillatory network of transcriptional "
    "regulators, Nature 403 (2000) 335-338 (values)",
    _repressilator,
    _repressilator_rhs,
    lambda p: [0.0, 0.0, 0.0, 5.0, 1.0, 15.0],
    unknowns="m1 m2 m3 q1 q2 q3",
    box={"a": (200.0, 230.0), "b": (4.5, 5.5), "n": (1.9, 2.1)},
    end=10.0,
    sizes=(100.0,) * 6,
)


def _gierer_meinhardt(t, u, p):
    (a, h), (rho, mu, nu) = u, p
    return [rho * a**2 / h - mu * a + 0.1, rho * a**2 - nu * h], [1, 1]


def _gierer_meinhardt_rhs(t, u, p):
    made = p[0] * u[0] ** 2
    return [made / u[1] - p[1] * u[0] + 0.1, made - p[2] * u[1]]


_publish(
    "gierer_meinhardt",
    "rational",
    "A. Gierer and H. Meinhardt, A theory of biological pattern formation, Kybernetik 12 (1972) "
    "30-39 (local kinetics)",
    _gierer_meinhardt,
    _gierer_meinhardt_rhs,
    lambda p: [1.0, 1.0],
    unknowns="a h",
    box={"rho": (0.9, 1.1), "mu": (0.9, 1.1), "nu": (1.1, 1.5)},
    end=8.0,
    sizes=(1.5, 1.5),
)


def _jak_stat(t, u, p):
    (x1, x2, x3, _), (k1, k2, k3, tau) = u, p
    receptor = t / tau * sp.exp(1 - t / tau)
    return [
        -k1 * x1 * receptor,
        k1 * x1 * receptor - k2 * x2**2,
        k2 * x2**2 / 2 - k3 * x3,
        k3 * x3,
    ], [1, 0, 0, 0]


def _jak_stat_rhs(t, u, p):
    scaled = t / p[3]
    phosphorylated = p[0] * u[0] * scaled * np.exp(1.0 - scaled)
    dimerised, imported = p[1] * u[1] * u[1], p[2] * u[2]
    return [
        -phosphorylated,
        phosphorylated - dimerised,
        0.5 * dimerised - imported,
        imported,
    ]


_publish(
    "jak_stat",
    "forced",
    "I. Swameye, T. G. Müller, J. Timmer, O. Sandra and U. Klingmüller, Identification of "
    "nucleocytoplasmic cycling as a remote sensor in cellular signaling by databased modeling, "
    "Proc. Natl. Acad. Sci. USA 100 (2003) 1028-1033 (without the delayed return; receptor input "
    "t/tau exp(1 - t/tau) instead of data)",
    _jak_stat,
    _jak_stat_rhs,
    lambda p: [1.0, 0.0, 0.0, 0.0],
    unknowns="x1 x2 x3 x4",
    box={"k1": (0.2, 0.3), "k2": (0.8, 1.2), "k3": (0.1, 0.15), "tau": (6.0, 10.0)},
    end=40.0,
    sizes=(1.0, 0.5, 0.4, 0.5),
)


def _mapk(t, u, p):
    k, kp, kk, kkp, kkpp, m, mp, mpp = u
    v1, inhibition, v2 = p
    r1 = v1 * k / ((1 + mpp / inhibition) * (10 + k))
    r2 = v2 * kp / (8 + kp)
    r3 = 0.025 * kp * kk / (15 + kk)
    r4 = 0.025 * kp * kkp / (15 + kkp)
    r5 = 0.75 * kkpp / (15 + kkpp)
    r6 = 0.75 * kkp / (15 + kkp)
    r7 = 0.025 * kkpp * m / (15 + m)
    r8 = 0.025 * kkpp * mp / (15 + mp)
    r9 = 0.5 * mpp / (15 + mpp)
    r10 = 0.5 * mp / (15 + mp)
    return [
        r2 - r1,
        r1 - r2,
        r6 - r3,
        r3 + r5 - r4 - r6,
        r4 - r5,
        r10 - r7,
        r7 + r9 - r8 - r10,
        r8 - r9,
    ], [90, 10, 280, 10, 10, 280, 10, 10]


def _mapk_rhs(t, u, p):
    half = 15.0 / (15.0 + u[2:])
    bound = 1.0 - half
    switched = p[0] / (1.0 + u[7] / p[1]) * u[0] / (10.0 + u[0]) - p[2] * u[1] / (8.0 + u[1])
    kinase, second = 0.025 * u[1], 0.025 * u[4]
    up1, up2 = kinase * bound[0] - 0.75 * bound[1], kinase * bound[1] - 0.75 * bound[2]
    up3, up4 = second * bound[3] - 0.5 * bound[4], second * bound[4] - 0.5 * bound[5]
    return [-switched, switched, -up1, up1 - up2, up2, -up3, up3 - up4, up4]


_publish(
    "mapk",
    "rational",
    "B. N. Kholodenko, Negative feedback and ultrasensitivity can bring about oscillations in "
    "the mitogen-activated protein kinase cascades, Eur. J. Biochem. 267 (2000) 1583-1588 "
    "(values)",
    _mapk,
    _mapk_rhs,
    lambda p: [90.0, 10.0, 280.0, 10.0, 10.0, 280.0, 10.0, 10.0],
    unknowns="k kp kk kkp kkpp m mp mpp",
    box={"v1": (2.3, 2.7), "ki": (8.0, 10.0), "v2": (0.22, 0.28)},
    end=600.0,
    sizes=(90.0, 90.0, 280.0, 100.0, 250.0, 280.0, 100.0, 250.0),
)


def _goldbeter_koshland(t, u, p):
    (x,), (ratio, half) = u, p
    return [ratio * (1 - x) / (half + 1 - x) - x / (half + x)], [0.5]


def _goldbeter_koshland_rhs(t, u, p):
    rest = 1.0 - u[0]
    return [p[0] * rest / (p[1] + rest) - u[0] / (p[1] + u[0])]


_publish(
    "goldbeter_koshland",
    "steep",
    "A. Goldbeter and D. E. Koshland, An amplified sensitivity arising from covalent "
    "modification in biological systems, Proc. Natl. Acad. Sci. USA 78 (1981) 6840-6844",
    _goldbeter_koshland,
    _goldbeter_koshland_rhs,
    lambda p: [0.5],
    unknowns="x",
    box={"r": (0.8, 1.25), "k": (0.05, 0.1)},
    end=10.0,
    sizes=(1.0,),
)


def _chemostat(t, u, p):
    (s, x), (fastest, half, dilution) = u, p
    growth = fastest * s / (half + s)
    return [dilution * (5 - s) - growth * x / 0.5, (growth - dilution) * x], [5, 0.1]


def _chemostat_rhs(t, u, p):
    made = p[0] * u[1] / (1.0 + p[1] / u[0])
    return [5.0 * p[2] - p[2] * u[0] - 2.0 * made, made - p[2] * u[1]]


_publish(
    "chemostat",
    "rational",
    "D. Herbert, R. Elsworth and R. C. Telling, The continuous culture of bacteria; a "
    "theoretical and experimental study, J. Gen. Microbiol. 14 (1956) 601-622 (growth after J. "
    "Monod)",
    _chemostat,
    _chemostat_rhs,
    lambda p: [5.0, 0.1],
    unknowns="s x",
    box={"m": (0.8, 1.2), "k": (0.2, 0.4), "d": (0.3, 0.5)},
    end=15.0,
    sizes=(5.0, 2.5),
)


def _andrews(t, u, p):
    (s, x), (fastest, inhibition, dilution) = u, p
    growth = fastest * s / (0.3 + s + s**2 / inhibition)
    return [dilution * (5 - s) - 2 * growth * x, (growth - dilution) * x], [1, 1.5]


def _andrews_rhs(t, u, p):
    made = p[0] * u[1] / (0.3 / u[0] + 1.0 + u[0] / p[1])
    return [p[2] * (5.0 - u[0]) - made - made, made - p[2] * u[1]]


_publish(
    "chemostat_inhibited",
    "rational",
    "J. F. Andrews, A mathematical model for the continuous culture of microorganisms utilizing "
    "inhibitory substrates, Biotechnol. Bioeng. 10 (1968) 707-723",
    _andrews,
    _andrews_rhs,
    lambda p: [1.0, 1.5],
    unknowns="s x",
    box={"m": (0.9, 1.1), "i": (3.0, 6.0), "d": (0.25, 0.35)},
    end=15.0,
    sizes=(1.0, 2.5),
)


def _one_compartment(t, u, p):
    (depot, c), (absorption, fastest, half) = u, p
    return [-absorption * depot, absorption * depot - fastest * c / (half + c)], [10, 0]


def _one_compartment_rhs(t, u, p):
    absorbed = p[0] * u[0]
    return [-absorbed, absorbed - p[1] * (1.0 - p[2] / (p[2] + u[1]))]


_publish(
    "one_compartment",
    "rational",
    "M. Gibaldi and D. Perrier, Pharmacokinetics, 2nd ed., Dekker 1982, chapter 7 (nonlinear "
    "pharmacokinetics; first-order absorption, Michaelis-Menten elimination)",
    _one_compartment,
    _one_compartment_rhs,
    lambda p: [10.0, 0.0],
    unknowns="a c",
    box={"ka": (1.0, 2.0), "v": (0.8, 1.2), "k": (1.0, 2.0)},
    end=12.0,
    sizes=(10.0, 9.0),
)


def _two_compartment(t, u, p):
    (c, tissue), (there, back, fastest, half) = u, p
    return [
        -there * c + back * tissue - fastest * c / (half + c),
        there * c - back * tissue,
    ], [10, 0]


def _two_compartment_rhs(t, u, p):
    exchanged = p[0] * u[0] - p[1] * u[1]
    return [-exchanged - p[2] / (1.0 + p[3] / u[0]), exchanged]


_publish(
    "two_compartment",
    "rational",
    "M. Gibaldi and D. Perrier, Pharmacokinetics, 2nd ed., Dekker 1982, chapters 2 and 7 (two "
    "compartments, Michaelis-Menten elimination)",
    _two_compartment,
    _two_compartment_rhs,
    lambda p: [10.0, 0.0],
    unknowns="c d",
    box={"k12": (0.4, 0.6), "k21": (0.2, 0.3), "v": (0.8, 1.2), "k": (1.0, 2.0)},
    end=12.0,
    sizes=(10.0, 4.0),
)


def _minimal_model(t, u, p):
    (glucose, action, insulin), (p1, p2, p3, secretion) = u, p
    return [
        -(p1 + action) * glucose + p1 * 90,
        -p2 * action + p3 * (insulin - 7),
        secretion * sp.Max(glucose - 100, 0) * t - 0.2 * (insulin - 7),
    ], [290, 0, 60]


def _minimal_model_rhs(t, u, p):
    glucose, action, insulin = u
    secreted = np.where(glucose > 100.0, p[3] * (glucose - 100.0) * t, 0.0)
    return [
        p[0] * (90.0 - glucose) - action * glucose,
        p[2] * (insulin - 7.0) - p[1] * action,
        secreted - 0.2 * insulin + 1.4,
    ]


_publish(
    "minimal_model",
    "nonsmooth",
    "R. N. Bergman, Y. Z. Ider, C. R. Bowden and C. Cobelli, Quantitative estimation of insulin "
    "sensitivity, Am. J. Physiol. 236 (1979) E667-E677; with insulin as restated by A. De "
    "Gaetano and O. Arino, J. Math. Biol. 40 (2000) 136-168",
    _minimal_model,
    _minimal_model_rhs,
    lambda p: [290.0, 0.0, 60.0],
    unknowns="g x i",
    box={"p1": (0.025, 0.035), "p2": (0.018, 0.022), "p3": (8e-6, 1.2e-5), "s": (0.003, 0.005)},
    end=180.0,
    sizes=(290.0, 0.02, 60.0),
)


# -- stiff ----------------------------------------------------------------------------------------

_POLLU_RATES = (
    *(0.35, 26.6, 1.23e4, 8.6e-4, 8.2e-4, 1.5e4, 1.3e-4, 2.4e4, 1.65e4, 9e3, 2.2e-2, 1.2e4, 1.88),
    *(1.63e4, 4.8e6, 3.5e-4, 1.75e-2, 1e8, 4.44e11, 1.24e3, 2.1, 5.78, 4.74e-2, 1.78e3, 3.12),
)
_POLLU_START = {2: 0.2, 4: 0.04, 7: 0.1, 8: 0.3, 9: 0.01, 17: 0.007}
_POLLU_REACTIONS = (  # species used, species made (with how many)
    ((1,), {2: 1, 3: 1}),
    ((2, 4), {1: 1}),
    ((5, 2), {6: 1, 1: 1}),
    ((7,), {5: 2, 8: 1}),
    ((7,), {8: 1}),
    ((7, 6), {5: 1, 8: 1}),
    ((9,), {5: 1, 8: 1, 10: 1}),
    ((9, 6), {11: 1}),
    ((11, 2), {1: 1, 10: 1, 12: 1}),
    ((11, 1), {13: 1}),
    ((13,), {11: 1, 1: 1}),
    ((10, 2), {1: 1, 14: 1}),
    ((14,), {7: 1, 5: 1}),
    ((1, 6), {15: 1}),
    ((3,), {4: 1}),
    ((4,), {16: 1}),
    ((4,), {3: 1}),
    ((16,), {6: 2}),
    ((16,), {3: 1}),
    ((17, 6), {18: 1, 5: 1}),
    ((19,), {2: 1}),
    ((19,), {1: 1, 3: 1}),
    ((1, 4), {19: 1}),
    ((19, 1), {20: 1}),
    ((20,), {19: 1, 1: 1}),
)


def _pollu(t, u, p):
    rates = list(_POLLU_RATES)
    rates[0], rates[1], rates[13] = p
    changes = [sp.Integer(0)] * 20
    for rate, (used, made) in zip(rates, _POLLU_REACTIONS):
        speed = rate * sp.Mul(*(u[i - 1] for i in used))
        for i in used:
            changes[i - 1] -= speed
        for i, many in made.items():
            changes[i - 1] += many * speed
    return changes, [_POLLU_START.get(i, 0) for i in range(1, 21)]


def _pollu_rhs(t, u, p):
    y = [None, *u]
    r1, r2, r14 = p[0] * y[1], p[1] * y[2] * y[4], p[2] * y[1] * y[6]
    r3, r4, r5, r6 = 1.23e4 * y[5] * y[2], 8.6e-4 * y[7], 8.2e-4 * y[7], 1.5e4 * y[7] * y[6]
    r7, r8, r9 = 1.3e-4 * y[9], 2.4e4 * y[9] * y[6], 1.65e4 * y[11] * y[2]
    r10, r11, r12 = 9e3 * y[11] * y[1], 2.2e-2 * y[13], 1.2e4 * y[10] * y[2]
    r13, r15, r16, r17 = 1.88 * y[14], 4.8e6 * y[3], 3.5e-4 * y[4], 1.75e-2 * y[4]
    r18, r19, r20 = 1e8 * y[16], 4.44e11 * y[16], 1.24e3 * y[17] * y[6]
    r21, r22, r23 = 2.1 * y[19], 5.78 * y[19], 4.74e-2 * y[1] * y[4]
    r24, r25 = 1.78e3 * y[19] * y[1], 3.12 * y[20]
    return [
        -r1 - r10 - r14 - r23 - r24 + r2 + r3 + r9 + r11 + r12 + r22 + r25,
        -r2 - r3 - r9 - r12 + r1 + r21,
        -r15 + r1 + r17 + r19 + r22,
        -r2 - r16 - r17 - r23 + r15,
        -r3 + 2.0 * r4 + r6 + r7 + r13 + r20,
        -r6 - r8 - r14 - r20 + r3 + 2.0 * r18,
        -r4 - r5 - r6 + r13,
        r4 + r5 + r6 + r7,
        -r7 - r8,
        -r12 + r7 + r9,
        -r9 - r10 + r8 + r11,
        r9,
        -r11 + r10,
        -r13 + r12,
        r14,
        -r18 - r19 + r16,
        -r20,
        r20,
        -r21 - r22 - r24 + r23 + r25,
        -r25 + r24,
    ]


_publish(
    "pollu",
    "stiff",
    "J. G. Verwer, Gauss-Seidel iteration for stiff ODEs from chemical kinetics, SIAM J. Sci. "
    "Comput. 15 (1994) 1243-1250 (values; problem POLLU of the Test Set for IVP Solvers)",
    _pollu,
    _pollu_rhs,
    lambda p: [_POLLU_START.get(i, 0.0) for i in range(1, 21)],
    unknowns=" ".join(f"y{i}" for i in range(1, 21)),
    box={"k1": (0.28, 0.42), "k2": (21.3, 31.9), "k14": (1.3e4, 1.96e4)},
    end=60.0,
    sizes=(
        *(0.06, 0.2, 4e-9, 0.04, 3e-7, 2e-7, 0.1, 0.3, 0.01, 1e-7),
        *(2e-8, 2e-3, 2e-4, 5e-5, 8e-3, 7e-18, 0.007, 1e-4, 3e-6, 3e-4),
    ),
    stiff=True,
)


def _e5(t, u, p):
    (y1, y2, y3, y4), (a, b, c) = u, p
    return [
        -a * y1 - b * y1 * y3,
        a * y1 - 1e6 * c * y2 * y3,
        a * y1 - b * y1 * y3 - 1e6 * c * y2 * y3 + c * y4,
        b * y1 * y3 - c * y4,
    ], [1.76e-3, 0, 0, 0]


def _e5_rhs(t, u, p):
    split, joined = p[0] * u[0], p[1] * u[0] * u[2]
    lost, back = 1e6 * p[2] * u[1] * u[2], p[2] * u[3]
    return [-split - joined, split - lost, split - lost - joined + back, joined - back]


_publish(
    "e5",
    "stiff",
    "W. H. Enright, T. E. Hull and B. Lindberg, Comparing numerical methods for stiff systems of "
    "O.D.E.s, BIT 15 (1975) 10-48, problem E5 (values)",
    _e5,
    _e5_rhs,
    lambda p: [1.76e-3, 0.0, 0.0, 0.0],
    unknowns="y1 y2 y3 y4",
    box={"a": (6.3e-10, 9.5e-10), "b": (0.9e7, 1.3e7), "c": (0.9e3, 1.36e3)},
    end=1000.0,
    sizes=(1.76e-3, 1.5e-10, 8e-12, 1.4e-10),
    stiff=True,
)


def _robertson(t, u, p):
    (y1, y2, y3), (k1, k2, k3) = u, p
    return [-k1 * y1 + k2 * y2 * y3, k1 * y1 - k2 * y2 * y3 - k3 * y2**2, k3 * y2**2], [1, 0, 0]


def _robertson_rhs(t, u, p):
    slow, back, fast = p[0] * u[0], p[1] * u[1] * u[2], p[2] * u[1] ** 2
    return [back - slow, slow - back - fast, fast]


_publish(
    "robertson_long",
    "stiff",
    "H. H. Robertson, The solution of a set of reaction rate equations, in J. Walsh (ed.), "
    "Numerical Analysis: An Introduction, Academic Press 1966, 178-182 (values)",
    _robertson,
    _robertson_rhs,
    lambda p: [1.0, 0.0, 0.0],
    unknowns="y1 y2 y3",
    box={"k1": (0.03, 0.05), "k2": (0.8e4, 1.2e4), "k3": (2e7, 4e7)},
    end=1e4,
    sizes=(1.0, 3e-5, 1.0),
    stiff=True,
)


def _hires(t, u, p):
    (y1, y2, y3, y4, y5, y6, y7, y8), (light, make, bind) = u, p
    return [
        -light * y1 + 0.43 * y2 + 8.32 * y3 + make,
        light * y1 - 8.75 * y2,
        -10.03 * y3 + 0.43 * y4 + 0.035 * y5,
        8.32 * y2 + light * y3 - 1.12 * y4,
        -1.745 * y5 + 0.43 * y6 + 0.43 * y7,
        -bind * y6 * y8 + 0.69 * y4 + 1.71 * y5 - 0.43 * y6 + 0.69 * y7,
        bind * y6 * y8 - 1.81 * y7,
        -bind * y6 * y8 + 1.81 * y7,
    ], [1, 0, 0, 0, 0, 0, 0, 0.0057]


def _hires_rhs(t, u, p):
    table = np.zeros((8, 8))
    table[0, 1:3] = 0.43, 8.32
    table[1, 1] = -8.75
    table[2, 2:5] = -10.03, 0.43, 0.035
    table[3, 1], table[3, 3] = 8.32, -1.12
    table[4, 4:7] = -1.745, 0.43, 0.43
    table[5, 3:7] = 0.69, 1.71, -0.43, 0.69
    table[6, 6], table[7, 6] = -1.81, 1.81
    rates = table @ u
    rates[[0, 1, 3]] += p[0] * np.stack([-u[0], u[0], u[2]])
    bound = p[2] * u[5] * u[7]
    rates[5:] += np.stack([-bound, bound, -bound])
    rates[0] += p[1]
    return list(rates)


_publish(
    "hires",
    "stiff",
    "E. Schäfer, A new approach to explain the 'high irradiance responses' of photomorphogenesis "
    "on the basis of phytochrome, J. Math. Biol. 2 (1975) 41-56 (values; problem HIRES of the "
    "Test Set for IVP Solvers)",
    _hires,
    _hires_rhs,
    lambda p: [1.0, *[0.0] * 6, 0.0057],
    unknowns="y1 y2 y3 y4 y5 y6 y7 y8",
    box={"k1": (1.6, 1.8), "s": (6e-4, 8e-4), "kp": (260.0, 300.0)},
    end=100.0,
    sizes=(1.0, 0.2, 0.06, 0.5, 0.3, 0.7, 0.006, 0.006),
    stiff=True,
)


def _van_der_pol(t, u, p):
    (x, v), (mu,) = u, p
    return [v, mu * (1 - x**2) * v - x], [2, 0]


def _van_der_pol_rhs(t, u, p):
    return [u[1], p[0] * u[1] - p[0] * u[0] ** 2 * u[1] - u[0]]


_publish(
    "van_der_pol",
    "stiff",
    "B. van der Pol, On relaxation-oscillations, Phil. Mag. 2 (1926) 978-992 (before the first "
    "jump)",
    _van_der_pol,
    _van_der_pol_rhs,
    lambda p: [2.0, 0.0],
    unknowns="x v",
    box={"mu": (80.0, 100.0)},
    end=50.0,
    sizes=(2.0, 0.02),
    stiff=True,
)


def _oregonator(t, u, p):
    (x, y, z), (s, q, w) = u, p
    return [s * (y - x * y + x - q * x**2), (z - y - x * y) / s, w * (x - z)], [1, 1228, 132]


def _oregonator_rhs(t, u, p):
    x, y, z = u
    return [
        p[0] * (y * (1.0 - x) + x * (1.0 - p[1] * x)),
        (z - y * (1.0 + x)) / p[0],
        p[2] * (x - z),
    ]


_publish(
    "oregonator",
    "stiff",
    "R. J. Field and R. M. Noyes, Oscillations in chemical systems IV: limit cycle behavior in a "
    "model of a real chemical reaction, J. Chem. Phys. 60 (1974) 1877-1884 (between two pulses)",
    _oregonator,
    _oregonator_rhs,
    lambda p: [1.0, 1228.0, 132.0],
    unknowns="x y z",
    box={"s": (70.0, 85.0), "q": (7.5e-6, 9.2e-6), "w": (0.145, 0.177)},
    end=60.0,
    sizes=(1.0, 1200.0, 132.0),
    stiff=True,
)


def _prothero_robinson(t, u, p):
    (y,), (rate, start) = u, p
    return [-rate * (y - sp.cos(t)) - sp.sin(t)], [start]


def _prothero_robinson_rhs(t, u, p):
    return [p[0] * (np.cos(t) - u[0]) - np.sin(t)]


_publish(
    "prothero_robinson",
    "stiff",
    "A. Prothero and A. Robinson, On the stability and accuracy of one-step methods for solving "
    "stiff systems of ordinary differential equations, Math. Comp. 28 (1974) 145-162 (a rate "
    "over two decades)",
    _prothero_robinson,
    _prothero_robinson_rhs,
    lambda p: [p[1]],
    unknowns="y",
    box={"l": (10.0, 1000.0), "s": (1.0, 1.5)},
    end=3.0,
    sizes=(1.0,),
    stiff=True,
)


def _davis_skodje(t, u, p):
    (x, y), (gap, start) = u, p
    return [-x, -gap * y + ((gap - 1) * x + gap * x**2) / (1 + x) ** 2], [start, 1]


def _davis_skodje_rhs(t, u, p):
    slow = u[0] / (1.0 + u[0])
    return [-u[0], p[0] * (slow - u[1]) - slow / (1.0 + u[0])]


_publish(
    "davis_skodje",
    "stiff",
    "M. J. Davis and R. T. Skodje, Geometric investigation of low-dimensional manifolds in "
    "systems approaching equilibrium, J. Chem. Phys. 111 (1999) 859-874 (the gap over two "
    "decades)",
    _davis_skodje,
    _davis_skodje_rhs,
    lambda p: [p[1], 1.0],
    unknowns="x y",
    box={"g": (3.0, 300.0), "s": (2.0, 4.0)},
    end=3.0,
    sizes=(4.0, 1.0),
    stiff=True,
)
