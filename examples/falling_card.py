"""A falling, spinning card in two dimensions, with quadratic drag and lift.

The model is the quasi-steady one of Andersen, Pesavento & Wang, "Analysis of transitions between
fluttering, tumbling and steady descent of falling cards", J. Fluid Mech. 541 (2005), for a thin
card of half-width a and mass m per unit of span in a fluid of density rho. With u the velocity
along the card, v across it and w the spin, V = sqrt(u^2 + v^2),

    m u'         = (m + m_a) v w - rho G v - m g sin(theta) - F u
    (m + m_a) v' = -m u w        + rho G u - m g cos(theta) - F v
    (I + I_a) w' = -m_a u v - torque

with the added mass m_a = pi rho a^2 and inertia I_a = m_a a^2 / 8. The circulation
G = 2 a (C_R a w - C_L u v / V) gives the lift, C_L sin(2 alpha) at the angle of attack alpha. The
drag coefficient is C_edge along the card and C_D across it, F = rho a (C_edge u^2 + C_D v^2) / V.
Their torque has the kink (mu1 + mu2 |w|) w; here it is mu sqrt(w^2 + (U/a)^2) w with
U = sqrt(m g / (pi rho a)), which has no kink and a value between theirs for mu1 = mu2 = 0.2.

The card is thrown horizontally. Asked: its flight for every drag and lift coefficient, speed,
angle and spin at the start. ``--page FILE.html`` writes a page that animates it, ``--picture
FILE.png`` a picture (which needs Matplotlib).
"""

from __future__ import annotations

import argparse
import io
import math
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import sympy as sp

import rankone as ro

RTOL = 1e-3
TEMPLATE = Path(__file__).with_name("falling_card.html.in")

a, density, gravity = 0.15, 1.2, 9.81  # m, kg/m^3, m/s^2
m = 2 * a * 1.0  # kg/m: board of 1 kg/m^2
added = math.pi * density * a**2
inertia = m * a**2 / 3 + added * a**2 / 8
C_edge, C_R, mu = 0.4, math.pi, 0.3
rate = math.sqrt(m * gravity / (math.pi * density * a)) / a  # U / a in 1/s

t, C_D, C_L, speed, angle, spin = sp.symbols("t C_D C_L speed angle spin")
x, y, theta, u, v, w = (sp.Function(name)(t) for name in ("x", "y", "theta", "u", "v", "w"))

size = sp.sqrt(u**2 + v**2)
lift = 2 * density * a * (C_R * a * w - C_L * u * v / size)
drag = density * a * (C_edge * u**2 + C_D * v**2) / size
torque = mu * added * a**2 * sp.sqrt(w**2 + rate**2) * w

problem = ro.Problem(
    equations=[
        sp.Eq(x.diff(t), u * sp.cos(theta) - v * sp.sin(theta)),
        sp.Eq(y.diff(t), u * sp.sin(theta) + v * sp.cos(theta)),
        sp.Eq(theta.diff(t), w),
        sp.Eq(
            m * u.diff(t),
            (m + added) * v * w - lift * v - m * gravity * sp.sin(theta) - drag * u,
        ),
        sp.Eq(
            (m + added) * v.diff(t),
            -m * u * w + lift * u - m * gravity * sp.cos(theta) - drag * v,
        ),
        sp.Eq(inertia * w.diff(t), -added * u * v - torque),
    ],
    time=(t, 0, 1.5),
    parameters={
        C_D: (1.8, 2.4),
        C_L: (1.0, 1.4),
        speed: (1.2, 1.8),
        angle: (-0.5, -0.1),
        spin: (3, 7),
    },
    initial={
        x: 0,
        y: 0,
        theta: angle,
        u: speed * sp.cos(angle),
        v: -speed * sp.sin(angle),
        w: spin,
    },
    units={t: "s", speed: "m/s", angle: "rad", spin: "rad/s"}
    | {x: "m", y: "m", theta: "rad", u: "m/s", v: "m/s", w: "rad/s"},
    name="falling card",
)


def flights(solution: ro.Solution, count: int, times: np.ndarray, seed: int = 1) -> np.ndarray:
    """Position and angle at random parameters, shape (3, count, times)."""
    rng = np.random.default_rng(seed)
    points = {
        name: rng.uniform(lower, upper, (count, 1))
        for name, (lower, upper) in solution.parameters.items()
    }
    return solution(times, points)[:3]


def page(solution: ro.Solution) -> str:
    """A page that animates the card, in one file: the template, the solved model and its view."""
    with tempfile.TemporaryDirectory() as folder:
        model = solution.export(Path(folder) / "card.js").read_text(encoding="utf-8")
    places = flights(solution, 500, np.linspace(*solution.time, 31))[:2]
    left, bottom = places.min(axis=(1, 2)) - 1.4 * a
    right, top = places.max(axis=(1, 2)) + 1.4 * a
    text = TEMPLATE.read_text(encoding="utf-8")
    text = text.replace("@half@", repr(a))
    text = text.replace("@view@", f"[{left:.3f}, {right:.3f}, {bottom:.3f}, {top:.3f}]")
    return text.replace("@model@", model)


def picture(solution: ro.Solution, path: Path) -> None:
    """One flight as under a stroboscope, and where 400 others are at five times."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from PIL import Image

    middle = {name: 0.5 * sum(interval) for name, interval in solution.parameters.items()}
    figure, axes = plt.subplots(1, 2, figsize=(6.4, 6.6), layout="constrained", sharey=True)
    others = ({"angle": -0.48, "spin": 3.5}, {"angle": -0.15, "C_L": 1.35})
    for color, change in zip(("#2f5fa8", "#b3261e"), others):
        strobe = solution(np.linspace(*solution.time, 61), middle | change)[:3]
        axes[0].plot(*_edges(strobe), color=color, lw=1.1)
    times = np.linspace(0.15, solution.time[1], 5)
    for k, when in enumerate(times):
        cards = flights(solution, 400, np.array([when]))[..., 0]
        color = plt.get_cmap("viridis")(k / 5)
        axes[1].plot(*_edges(cards), color=color, lw=0.6, alpha=0.25)
        axes[1].annotate(f"{when:.2f} s", (1.1, cards[1].mean()), color=color)
    axes[0].set(title="two flights, every 25 ms", xlabel="x in m", ylabel="y in m")
    axes[1].set(title="400 cards of the box", xlabel="x in m", xlim=(-0.3, 1.5))
    axes[0].set_xlim(-0.3, 1.5)
    for one in axes:
        one.set_aspect("equal")
        one.spines[["top", "right"]].set_visible(False)
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=100)
    plt.close(figure)
    Image.open(buffer).convert("RGB").quantize(64).save(path, "png", optimize=True)


def _edges(cards: np.ndarray) -> np.ndarray:
    """Both ends of cards (3, n), as x and y of shape (2, n)."""
    along = a * np.stack([np.cos(cards[2]), np.sin(cards[2])])
    return np.stack([cards[:2] - along, cards[:2] + along], axis=1)


def main(arguments: Sequence[str] = ()) -> None:
    parser = argparse.ArgumentParser(description="A falling, spinning card.")
    parser.add_argument("--page", type=Path, metavar="FILE.html", help="write an animation")
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="write a picture")
    options = parser.parse_args(arguments)
    solution = ro.solve(problem, rtol=RTOL)
    print(solution)
    for lifting in (1.0, 1.2, 1.4):
        at = {"C_D": 2.1, "C_L": lifting, "speed": 1.5, "angle": -0.3, "spin": 5.0}
        far, high, turned = solution(1.5, at)[:3]
        print(f"after 1.5 s with C_L = {lifting}: x {far:.2f} m, y {high:.2f} m, {turned:.2f} rad")
    if options.page:
        options.page.write_text(page(solution), encoding="utf-8")
        print(f"wrote {options.page}")
    if options.picture:
        picture(solution, options.picture)
        print(f"wrote {options.picture}")


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])
