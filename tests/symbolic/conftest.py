"""The reference problems of DESIGN section 4, as the tests of the front end need them."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import sympy as sp

from rankone.symbolic import Problem

t = sp.Symbol("t")


def decay() -> Problem:
    k = sp.Symbol("k")
    u = sp.Function("u")(t)
    return Problem([sp.Eq(u.diff(t) + k * u, 0)], (t, 0, 2), {k: (0.5, 5)}, {u: 1}, "decay")


def linear() -> Problem:
    k = sp.Symbol("k")
    u = sp.Function("u")(t)
    return Problem([sp.Eq(k * (u.diff(t) + 1), 10)], (t, 0, 5), {k: (1, 10)}, {u: 0})


def free_fall() -> Problem:
    drag = sp.Symbol("C_D")
    u = sp.Function("u")(t)
    rho, area, mass, gravity = 1.2, 0.1, 1, 9.81
    rhs = sp.Rational(1, 2) * rho * area * drag * u**2 / mass - gravity
    return Problem([sp.Eq(u.diff(t), rhs)], (t, 0, 3), {drag: (0.1, 1.5)}, {u: 0})


def coupled() -> Problem:
    start = sp.symbols("a1:4")
    u1, u2, u3 = (sp.Function(f"u{i}")(t) for i in (1, 2, 3))
    return Problem(
        [
            sp.Eq(u1.diff(t) + u2 * u3, 1),
            sp.Eq(u2.diff(t) + u1 * u3, 2),
            sp.Eq(u3.diff(t) + u1 * u2, 3),
        ],
        (t, 0, 0.5),
        dict.fromkeys(start, (0.5, 1.5)),
        dict(zip((u1, u2, u3), start, strict=True)),
    )


def lotka_volterra() -> Problem:
    x0, y0 = sp.symbols("x0 y0")
    x, y = sp.Function("x")(t), sp.Function("y")(t)
    return Problem(
        [sp.Eq(x.diff(t), x * (1.5 - y)), sp.Eq(y.diff(t), -y * (3 - x))],
        (t, 0, 6),
        {x0: (8, 12), y0: (4, 6)},
        {x: x0, y: y0},
    )


def kirchhoff() -> Problem:
    start = sp.symbols("a0:6")
    u = sp.Matrix([sp.Function(f"u{i}")(t) for i in range(3)])
    w = sp.Matrix([sp.Function(f"w{i}")(t) for i in range(3)])
    mass, added = sp.diag(2, 2.5, 3), sp.diag(1, 1.5, 2)
    inertia, force = sp.diag(0.4, 0.6, 0.9), sp.Matrix([0, 0, -0.5])
    linear = mass * u.diff(t) - (mass * u).cross(w) - force
    angular = inertia * w.diff(t) - (inertia * w).cross(w) - (added * u).cross(u)
    return Problem(
        [*linear, *angular],
        (t, 0, 1),
        dict.fromkeys(start, (0.5, 1)),
        dict(zip([*u, *w], start, strict=True)),
    )


def chain() -> Problem:
    rates = sp.symbols("k1:11")
    x = [sp.Function(f"x{i}")(t) for i in range(1, 11)]
    inflow = [0, *(k * state for k, state in zip(rates, x, strict=True))]
    return Problem(
        [sp.Eq(x[i].diff(t), inflow[i] - rates[i] * x[i]) for i in range(10)],
        (t, 0, 5),
        dict.fromkeys(rates, (0.7, 1.3)),
        {state: int(i == 0) for i, state in enumerate(x)},
    )


REFERENCE: dict[str, Callable[[], Problem]] = {
    build.__name__: build
    for build in (decay, linear, free_fall, coupled, lotka_volterra, kirchhoff, chain)
}


@pytest.fixture(params=REFERENCE, ids=str)
def reference_problem(request: pytest.FixtureRequest) -> Problem:
    return REFERENCE[request.param]()


@pytest.fixture
def reference() -> dict[str, Callable[[], Problem]]:
    return REFERENCE
