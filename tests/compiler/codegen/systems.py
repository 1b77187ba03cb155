"""Separated forms written by hand, for tests of the code generation alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import sympy as sp

from rankone.problem.forms import Coordinate, Factor, SeparatedForm, State, Term

t = sp.Symbol("t")
Separated = tuple[float, Mapping[sp.Symbol, sp.Expr], Sequence[str]]
"""A term: coefficient, factor of each coordinate it depends on, names of the states multiplied."""


def separated(
    rhs: Mapping[str, Sequence[Separated]],
    parameters: Mapping[sp.Symbol, tuple[float, float]] | None = None,
    initial: Mapping[str, sp.Expr] | None = None,
    horizon: float = 1.0,
) -> SeparatedForm:
    """The form of ``u' = rhs``; initial values are one or a function of one parameter."""
    states = list(rhs)
    coordinates = [Coordinate("t", t, 0.0, horizon)]
    coordinates += [Coordinate(p.name, p, *box) for p, box in (parameters or {}).items()]
    factors: list[list[sp.Expr]] = [[sp.Integer(1)] for _ in coordinates]

    def rows(expressions: Mapping[sp.Symbol, sp.Expr]) -> tuple[int, ...]:
        for known, coordinate in zip(factors, coordinates, strict=True):
            expression = expressions.get(coordinate.symbol, sp.Integer(1))
            if expression not in known:
                known.append(expression)
        return tuple(
            known.index(expressions.get(coordinate.symbol, sp.Integer(1)))
            for known, coordinate in zip(factors, coordinates, strict=True)
        )

    terms = []
    for c, right in enumerate(rhs.values()):
        terms.append(Term(c, 1.0, rows({}), (c,), derivative=1))
        for coefficient, expressions, monomial in right:
            indices = tuple(sorted(states.index(state) for state in monomial))
            terms.append(Term(c, -coefficient, rows(expressions), indices))
    starts = []
    for name, value in (initial or {}).items():
        symbols = value.free_symbols
        starts.append(Term(states.index(name), 1.0, rows(dict.fromkeys(symbols, value))))
    return SeparatedForm(
        tuple(coordinates),
        tuple(State(name, sp.Function(name)(t)) for name in states),
        tuple(tuple(Factor(j, e) for e in known) for j, known in enumerate(factors)),
        tuple(terms),
        tuple(starts),
    )


def decay() -> SeparatedForm:
    """u' = -k u, u(0) = 1."""
    k = sp.Symbol("k")
    return separated(
        {"u": [(-1.0, {k: k}, ["u"])]}, {k: (0.5, 5)}, {"u": sp.Integer(1)}, horizon=2.0
    )


def lotka_volterra() -> SeparatedForm:
    """x' = x (1.5 - y), y' = -y (3 - x), both initial values free."""
    x0, y0 = sp.symbols("x0 y0")
    return separated(
        {
            "x": [(1.5, {}, ["x"]), (-1.0, {}, ["x", "y"])],
            "y": [(-3.0, {}, ["y"]), (1.0, {}, ["x", "y"])],
        },
        {x0: (8, 12), y0: (4, 6)},
        {"x": x0, "y": y0},
        horizon=6.0,
    )


def driven() -> SeparatedForm:
    """A cubic, explicit time and three signatures, with names that are not identifiers."""
    rate, start = sp.symbols("lambda x_{0}")
    return separated(
        {
            "x": [
                (-1.0, {rate: sp.exp(-rate)}, ["x", "x", "x"]),
                (0.5, {t: sp.sin(t)}, ["y"]),
                (0.25, {t: sp.sin(t)}, []),
            ],
            "y": [
                (1.0, {rate: rate, t: sp.cos(t) ** 2}, ["x", "x", "y"]),
                (-2.0, {}, ["y"]),
                (1 / 3, {rate: rate}, ["x"]),
            ],
        },
        {rate: (1, 2), start: (0, 1)},
        {"x": start, "y": sp.Integer(1)},
        horizon=2.0,
    )


def kirchhoff() -> SeparatedForm:
    """A rigid body in a perfect fluid (six states, twelve monomials): many quadratic terms."""
    mass, added, inertia = (2.0, 2.5, 3.0), (1.0, 1.5, 2.0), (0.4, 0.6, 0.9)
    rhs: dict[str, list[Separated]] = {f"v{i}": [] for i in range(3)}
    rhs |= {f"o{i}": [] for i in range(3)}
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        rhs[f"v{i}"].append((mass[j] / mass[i], {}, [f"v{j}", f"o{k}"]))
        rhs[f"v{i}"].append((-mass[k] / mass[i], {}, [f"v{k}", f"o{j}"]))
        rhs[f"o{i}"].append(((inertia[j] - inertia[k]) / inertia[i], {}, [f"o{j}", f"o{k}"]))
        rhs[f"o{i}"].append(((added[j] - added[k]) / inertia[i], {}, [f"v{j}", f"v{k}"]))
    rhs["v2"].append((-0.5 / 3, {}, []))
    starts = sp.symbols("a:6")
    return separated(
        rhs,
        dict.fromkeys(starts, (0.5, 1.0)),
        dict(zip(rhs, starts, strict=True)),
        horizon=3.0,
    )


def constant_and_zero() -> SeparatedForm:
    """One equation without a right-hand side, one constant, one that starts at zero."""
    return separated({"a": [], "b": [(2.5, {}, [])], "c": [(-1.0, {}, ["a"])]})


REFERENCE = {
    "decay": decay,
    "lotka_volterra": lotka_volterra,
    "driven": driven,
    "kirchhoff": kirchhoff,
    "constant_and_zero": constant_and_zero,
}
