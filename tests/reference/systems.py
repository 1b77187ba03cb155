"""The right-hand sides of the reference problems, written by hand from their statements."""

from __future__ import annotations

import numpy as np

from tests.reference.measure import Array, Independent

__all__ = ["INDEPENDENT"]


def _decay(t: float, u: Array, p: Array) -> list[Array]:
    return [-p[0] * u[0]]


def _linear(t: float, u: Array, p: Array) -> list[Array]:
    return [10.0 / p[0] - 1.0]


def _free_fall(t: float, u: Array, p: Array) -> list[Array]:
    return [0.5 * 1.2 * 0.1 * p[0] * u[0] ** 2 / 1.0 - 9.81]


def _coupled(t: float, u: Array, p: Array) -> list[Array]:
    return [1.0 - u[1] * u[2], 2.0 - u[0] * u[2], 3.0 - u[0] * u[1]]


def _lotka_volterra(t: float, u: Array, p: Array) -> list[Array]:
    return [u[0] * (1.5 - u[1]), -u[1] * (3.0 - u[0])]


def _kirchhoff(t: float, u: Array, p: Array) -> list[Array]:
    mass = np.array([2.0, 2.5, 3.0])[:, None]
    added = np.array([1.0, 1.5, 2.0])[:, None]
    inertia = np.array([0.4, 0.6, 0.9])[:, None]
    force = np.array([0.0, 0.0, -0.5])[:, None]
    v, w = u[:3], u[3:]
    linear = (np.cross(mass * v, w, axis=0) + force) / mass
    angular = (np.cross(inertia * w, w, axis=0) + np.cross(added * v, v, axis=0)) / inertia
    return [*linear, *angular]


def _robertson(t: float, u: Array, p: Array) -> list[Array]:
    slow, back, fast = p[0] * u[0], p[1] * u[1] * u[2], p[2] * u[1] ** 2
    return [back - slow, slow - back - fast, fast]


def _chain(t: float, u: Array, p: Array) -> list[Array]:
    flow = p * u
    return [-flow[0], *(flow[i - 1] - flow[i] for i in range(1, 10))]


def _pendulum(t: float, u: Array, p: Array) -> list[Array]:
    return [u[1], -p[1] * u[1] - p[0] * np.sin(u[0])]


def _doses(t: float, u: Array, p: Array) -> list[Array]:
    volume, largest, half, rate = p
    exchange = rate * u[0] - 0.25 * u[1]
    return [-largest * u[0] / (half + u[0]) / volume - exchange, exchange]


def _projectile(t: float, u: Array, p: Array) -> list[Array]:
    factor = 0.5 * 1.225 * np.pi * (0.04267 / 2) ** 2 / 0.04593 * np.hypot(u[2], u[3])
    drag, lift = factor * p[0], factor * p[1]
    return [u[2], u[3], -drag * u[2] - lift * u[3], -drag * u[3] + lift * u[2] - 9.81]


def _falling_card(t: float, z: Array, p: Array) -> list[Array]:
    """By angle of attack: drag against the velocity, lift C_L sin(2 attack) across it."""
    half, rho, mass = 0.15, 1.2, 0.3
    across, lift = p[0], p[1]
    _, _, angle, u, v, w = z
    added = np.pi * rho * half**2
    speed = np.hypot(u, v)
    attack = np.arctan2(v, u)
    drag = rho * half * speed**2 * (0.4 * np.cos(attack) ** 2 + across * np.sin(attack) ** 2)
    circulation = 2 * half * (np.pi * half * w - 0.5 * lift * speed * np.sin(2 * attack))
    along = -drag * np.cos(attack) - rho * circulation * v - 9.81 * mass * np.sin(angle)
    normal = -drag * np.sin(attack) + rho * circulation * u - 9.81 * mass * np.cos(angle)
    fast = np.hypot(w, np.sqrt(9.81 * mass / (np.pi * rho * half)) / half)
    moment = -added * u * v - 0.3 * np.pi * rho * half**4 * fast * w
    return [
        u * np.cos(angle) - v * np.sin(angle),
        u * np.sin(angle) + v * np.cos(angle),
        w,
        (along + (mass + added) * v * w) / mass,
        (normal - mass * u * w) / (mass + added),
        moment / (mass * (2 * half) ** 2 / 12 + np.pi * rho * half**4 / 8),
    ]


INDEPENDENT: dict[str, Independent] = {
    "decay": Independent(_decay, lambda p: [1.0], ((0.5, 5),), 2.0, (1.0,)),
    "linear": Independent(_linear, lambda p: [0.0], ((1, 10),), 5.0, (45.0,)),
    "free_fall": Independent(_free_fall, lambda p: [0.0], ((0.1, 1.5),), 3.0, (20.0,)),
    "coupled": Independent(_coupled, list, ((0.5, 1.5),) * 3, 0.5, (1.0,) * 3),
    "lotka_volterra": Independent(_lotka_volterra, list, ((8, 12), (4, 6)), 6.0, (10.0, 10.0)),
    "kirchhoff": Independent(_kirchhoff, list, ((0.5, 1),) * 6, 1.0, (1.0,) * 6),
    "kirchhoff_long": Independent(_kirchhoff, list, ((0.5, 1),) * 6, 3.0, (1.0,) * 6),
    "robertson": Independent(
        _robertson,
        lambda p: [1.0, 0.0, 0.0],
        ((0.03, 0.05), (0.8e4, 1.2e4), (2e7, 4e7)),
        40.0,
        (1.0, 3e-5, 0.3),
        stiff=True,
    ),
    "chain": Independent(
        _chain, lambda p: [1.0, *[0.0] * 9], ((0.7, 1.3),) * 10, 5.0, (1.0, *[0.3] * 9)
    ),
    "pendulum": Independent(
        _pendulum, lambda p: [p[2], 0.0], ((7, 13), (0.14, 0.26), (0.7, 1.3)), 5.0, (1.0, 3.0)
    ),
    "doses": Independent(
        _doses,
        lambda p: [100.0 / p[0], 0.0],
        ((25, 35), (8, 12), (2, 3), (0.2, 0.3)),
        72.0,
        (5.0, 2.0),
        jumps={12.0 * i: lambda u, p: [u[0] + 100.0 / p[0], u[1]] for i in range(1, 6)},
    ),
    "projectile": Independent(
        _projectile,
        lambda p: [0.0, 0.0, p[2] * np.cos(p[3]), p[2] * np.sin(p[3])],
        ((0.2, 0.3), (0.1, 0.2), (55, 70), (0.15, 0.35)),
        3.0,
        (100.0, 30.0, 60.0, 20.0),
    ),
    "falling_card": Independent(
        _falling_card,
        lambda p: [0.0, 0.0, p[3], p[2] * np.cos(p[3]), -p[2] * np.sin(p[3]), p[4]],
        ((1.8, 2.4), (1.0, 1.4), (1.2, 1.8), (-0.5, -0.1), (3, 7)),
        1.5,
        (1.0, 3.0, 3.0, 3.0, 3.0, 10.0),
    ),
}
