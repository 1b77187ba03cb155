"""Generated functions of random expressions against values with 400 digits."""

import random

import mpmath
import numpy as np
import sympy as sp

import rankone as ro
from rankone.compiler.codegen.output_expressions import output_formulas
from tests.compiler.codegen.random_expressions import sample

__all__ = ["KINDS", "check", "check_part"]

KINDS = ("rates", "starts", "jumps", "outputs")
"""Where an expression may stand."""
TOLERANCE = 1e-10
"""Largest relative error over the condition."""
POINTS = 2
PART = 20
"""Expressions of one part."""
t = sp.Symbol("t")


def batch(first, count):
    """Samples with variables of their own, ``x0``, ``y0``, ..., and what they are at points."""
    samples = [sample(seed) for seed in range(first, first + count)]
    draw = random.Random(first)
    points = [
        [{v: draw.uniform(*ends) for v, ends in s.ranges.items()} for s in samples]
        for _ in range(POINTS)
    ]
    return samples, points


def written(samples, x, y):
    """The expressions in other variables; every second one has decimal numbers."""
    expressions = []
    for i, s in enumerate(samples):
        own = dict(zip(s.ranges, (x[i], y[i]), strict=True))
        expressions.append(s.expression(exact=i % 2 == 0).xreplace(own))
    return expressions


def middle(ends):
    return sp.Rational(repr(0.5 * (ends[0] + ends[1])))


def compiled(samples, kind):
    """A problem with the samples as rates, initial values or values after a jump."""
    n = len(samples)
    functions = [sp.Function(f"x{i}")(t) for i in range(n)]
    first, second = sp.symbols(f"a:{n}", real=True), sp.symbols(f"b:{n}", real=True)
    ends = [tuple(s.ranges.values()) for s in samples]
    box = {second[i]: ends[i][1] for i in range(n)}
    start = {functions[i]: middle(ends[i][0]) for i in range(n)}
    rates, jumps = [-u for u in functions], None
    if kind == "rates":
        rates = written(samples, functions, second)
    elif kind == "starts":
        box |= {first[i]: ends[i][0] for i in range(n)}
        start = dict(zip(functions, written(samples, first, second), strict=True))
    else:
        jumps = {0.5: dict(zip(functions, written(samples, functions, second), strict=True))}
    equations = [sp.Eq(u.diff(t), rate) for u, rate in zip(functions, rates, strict=True)]
    return ro.compile(ro.Problem(equations, (t, 0, 1), box, start, jumps=jumps)).system


def computed(kind, samples, points):
    """For each point the values of the samples, and their derivatives where there are any."""
    n = len(samples)
    columns = [np.array([list(p.values()) for p in at]).T for at in points]
    if kind == "outputs":
        yield from outputs(samples, columns)
        return
    system = compiled(samples, kind)
    with np.errstate(all="ignore"):
        for x, y in columns:
            if kind == "rates":
                yield system.rhs(0.0, x, y), np.diagonal(system.jacobian(0.0, x, y))
            elif kind == "starts":
                yield system.initial(np.concatenate([y, x])[:, None])[:, 0], None
            else:
                yield np.ravel(system.jumps.jumped(0, x, y))[:n], None


def outputs(samples, columns):
    """Values of the samples as outputs of a solution."""
    n = len(samples)
    rhs = {f"x{i}": "0*b0" for i in range(n)}
    box = {f"b{i}": tuple(s.ranges.values())[1] for i, s in enumerate(samples)}
    start = {
        f"x{i}": float(middle(s.ranges[min(s.ranges, key=str)])) for i, s in enumerate(samples)
    }
    metadata = ro.compile(ro.Problem.from_strings(rhs, start, box, (0, 1))).metadata()
    functions = [sp.Function(f"x{i}")(t) for i in range(n)]
    expressions = written(samples, functions, sp.symbols(f"b:{n}"))
    for x, y in columns:
        made = {f"q{i}": e for i, e in enumerate(expressions)}
        points = np.zeros(1), y[:, None], x[:, None]
        asked = output_formulas(made, metadata, (0.0, 1.0), points).over(metadata.box, (0.0, 1.0))
        order = [source.row for source in asked.sources]
        with np.errstate(all="ignore"):
            values = asked.values(np.zeros((1, 1)), x[order, None, None], y[:, None], [])
        yield np.array([float(np.ravel(v)[0]) for v in values]), None


def check(kind, first, count):
    samples, points = batch(first, count)
    compared = set()
    for at, found in zip(points, computed(kind, samples, points), strict=True):
        for wanted, values in zip(((), "x"), found, strict=True):
            for i, s in enumerate(samples) if values is not None else ():
                variables = [v for v in s.ranges if str(v) in wanted]
                exact, condition = s.value(at[i], *variables)
                if condition == mpmath.inf:
                    continue
                error = abs(mpmath.mpf(float(values[i])) - exact) / abs(exact)
                said = f"{kind} {first + i}{variables}: {s.template}, {s.numbers} at {at[i]}"
                assert error <= TOLERANCE * condition, said
                compared.add(i)
    assert len(compared) >= 0.6 * count  # the others are below what is compared


def check_part(part):
    """Check the expressions of a part: rates in two parts of five."""
    check(KINDS[(0, 1, 0, 2, 3)[part % 5]], PART * part, PART)
