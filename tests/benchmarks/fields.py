"""Fields: what a system of many entries costs, section by section.

``python tests/benchmarks/fields.py [section ...]`` runs the sections that are named, or all.

- ``compile``: 100,000 equations written as two fields, from the problem to the system
- ``heat40``, ``heat100``, ``heat200``, ``block``, ``cable``, ``cable_at_rest``, ``brusselator``,
  ``burgers``, ``convection``, ``beam``: solves by modes, each in a process of its own, beside
  trajectories of SciPy's BDF with the sparse Jacobian and modes by hand of five of them
- ``processes``: full trajectories by one process and by two
- ``pymor``: heat on 100 x 100 cells and the block by modes of pyMOR, also in their sections

The beam needs scikit-fem; its reference trajectories are those of rankone at a tolerance of their
own, since SciPy takes no mass matrix.
"""

import itertools
import resource
import runpy
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import scipy.integrate
import scipy.sparse as ss
import sympy as sp

import rankone as ro
from rankone.compiler.field_lowering import field_system
from rankone.support.tasks import open_pool
from rankone.trajectories.fields.field_trajectories import (
    FieldIntegration,
    field_sizes,
    field_trajectory,
)
from tests.benchmarks.field_peers import by_pymor

EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "fields"
SIDE = 224  # Cells on a side of the square: two fields have 100,352 entries


def laplacian(side):
    """Second differences on a square of cells, with no flux through its sides."""
    ones = np.ones(side)
    line = ss.diags_array([ones[1:], -2.0 * ones, ones[1:]], offsets=(-1, 0, 1)).tolil()
    line[0, 0] = line[-1, -1] = -1.0
    one = ss.eye_array(side)
    return ss.csr_array(ss.kron(line, one) + ss.kron(one, line)) * side**2


def brusselator(side):
    """Two fields with diffusion and a cubic reaction."""
    t, A, B, D = sp.symbols("t A B D")
    n = side**2
    u, v = ro.field("u", n), ro.field("v", n)
    matrix = laplacian(side)
    start = np.random.default_rng(0).random(n)
    return ro.Problem(
        {
            u: D * ro.apply(matrix, u) + A - (B + 1) * u + u**2 * v,
            v: 8 * D * ro.apply(matrix, v) + B * u - u**2 * v,
        },
        (t, 0, 1),
        {A: (1, 2), B: (2, 3)},
        {u: A + ro.apply(start, 1), v: 1.0},
        constants={D: 1e-3},
    )


def seconds(build):
    """What a call returns, and the processor time it took."""
    began = time.process_time()
    made = build()
    return made, time.process_time() - began


def compile_section():
    """The time from arrays to a system, with and without the comparison with the tree."""
    brusselator(8)  # imports
    problem, building = seconds(lambda: brusselator(SIDE))
    _, plain = seconds(lambda: field_system(problem, check=False))
    system, checked = seconds(lambda: field_system(problem))
    print(f"{system.size} equations in two fields, processor time")
    print(f"  problem {building:.2f} s, system {plain:.2f} s, comparison {checked - plain:.2f} s")
    print(f"  together {building + checked:.2f} s (bar: 2 s), text of {len(system.source)} letters")


# --- solves ------------------------------------------------------------------------------------


def second_differences(n, spacing):
    """Second differences on a line that ends at zero, and central first ones."""
    second = ss.diags_array([1.0, -2.0, 1.0], offsets=(-1, 0, 1), shape=(n, n)) / spacing**2
    first = ss.diags_array([-1.0, 1.0], offsets=(-1, 1), shape=(n, n)) / (2.0 * spacing)
    return ss.csr_array(second), ss.csr_array(first)


def square(side):
    """Coordinates of the cells of a square, and operators along each of its sides."""
    x = (np.arange(side) + 1.0) / (side + 1)
    one = ss.eye_array(side)
    second, first = second_differences(side, 1.0 / (side + 1))
    along_x = [ss.csr_array(ss.kron(line, one)) for line in (second, first)]
    along_y = [ss.csr_array(ss.kron(one, line)) for line in (second, first)]
    return (*np.meshgrid(x, x, indexing="ij"), along_x, along_y)


def heat(side):
    """Two conductivities and a source."""
    t, kx, ky, q = sp.symbols("t kx ky q")
    x, y, (xx, _), (yy, _) = square(side)
    u = ro.field("u", side**2)
    source = 10.0 * np.exp(-20.0 * ((x - 0.3) ** 2 + (y - 0.4) ** 2))
    rate = kx * ro.apply(xx, u) + ky * ro.apply(yy, u) + ro.apply(source.ravel(), q)
    return ro.Problem({u: rate}, (t, 0, 0.1), dict.fromkeys((kx, ky, q), (0.5, 2)), {u: 0})


def block(side):
    """Nine blocks whose conductivities are known to a factor of two each way."""
    t, *k = sp.symbols("t k0:9")
    u, ends = ro.field("u", side**2), np.minimum(3 * np.arange(-1, side + 1) // side, 2).clip(0)
    steps = ss.diags_array([1.0, -1.0], offsets=(0, -1), shape=(side + 1, side)) * (side + 1)
    one, rate = ss.eye_array(side), ro.apply(np.ones(side**2), 1)
    across = [ss.csr_array(ss.kron(steps, one)), ss.csr_array(ss.kron(one, steps))]
    for i in range(3):
        for j in range(3):
            faces = 0.5 * ((ends[:-1] == i).astype(float) + (ends[1:] == i))
            others = 0.5 * ((ends[:-1] == j).astype(float) + (ends[1:] == j))
            inside, beside = ends[1:-1] == i, ends[1:-1] == j
            weights = [np.outer(faces, beside).ravel(), np.outer(inside, others).ravel()]
            pairs = zip(across, weights, strict=True)
            matrix = sum(-(d.T @ ss.diags_array(w) @ d) for d, w in pairs)
            rate += k[3 * i + j] * ro.apply(ss.csr_array(matrix), u)
    return ro.Problem({u: rate}, (t, 0, 0.1), dict.fromkeys(k, (0.5, 2, "log")), {u: 0})


def pulses(cells, box):
    """FitzHugh and Nagumo's equations, with a current at one end (Chaturantabut & Sorensen 2010).

    Those of epsilon, b, gamma, c and the strength of the current that are not in the box have the
    values of the paper.
    """
    t, *symbols = sp.symbols("t epsilon b gamma c current")
    usual = dict(zip(symbols, (0.015, 0.5, 2.0, 0.05, 1.0), strict=True))
    varied = [symbol for symbol in symbols if symbol.name in box]
    eps, b, gamma, c, current = (s if s in varied else usual[s] for s in symbols)
    v, w, spacing = ro.field("v", cells), ro.field("w", cells), 1.0 / (cells - 1)
    second = second_differences(cells, spacing)[0].tolil()
    second[0, 1] = second[-1, -2] = 2.0 / spacing**2
    end = np.zeros(cells)
    end[0] = 2.0 / spacing * 50_000
    along = eps * ro.apply(ss.csr_array(second), v)
    pulse = ro.apply(end, eps * current * t**3 * sp.exp(-15 * t))
    rates = {
        v: along + (v * (v - 0.1) * (1 - v) - w + c) / eps + pulse,
        w: b * v - gamma * w + c,
    }
    around = {symbol: (0.9 * usual[symbol], 1.1 * usual[symbol]) for symbol in varied}
    return ro.Problem(rates, (t, 0, 8), around, {v: 0, w: 0})


def cable(cells):
    """Pulses whose times differ over the box."""
    return pulses(cells, ("epsilon", "c", "current"))


def cable_at_rest(cells):
    """A box in a part of which pulses cease after the first one: it is refused."""
    return pulses(cells, ("b", "gamma", "c"))


def reaction(side):
    """A Brusselator that oscillates, on a torus."""
    t, a, b = sp.symbols("t A B")
    n = side**2
    u, v, line = ro.field("u", n), ro.field("v", n), second_differences(side, 1.0 / side)[0].tolil()
    line[0, -1] = line[-1, 0] = side**2
    one = ss.eye_array(side)
    matrix = ss.csr_array(ss.kron(line, one) + ss.kron(one, line))
    x = np.arange(side) / side
    x, y = np.meshgrid(x, x, indexing="ij")
    start = 1 + 0.3 * np.sin(2 * np.pi * x) * np.cos(2 * np.pi * y)
    rates = {
        u: 0.002 * ro.apply(matrix, u) + a - (b + 1) * u + u**2 * v,
        v: 0.001 * ro.apply(matrix, v) + b * u - u**2 * v,
    }
    initial = {u: start.ravel(), v: (2 + 0.2 * np.cos(2 * np.pi * x)).ravel()}
    return ro.Problem(rates, (t, 0, 5), {a: (0.9, 1.1), b: (1.5, 1.8)}, initial)


def burgers(cells):
    """Viscosity and amplitude."""
    t, nu, a = sp.symbols("t nu a")
    u, spacing = ro.field("u", cells), 1.0 / (cells + 1)
    second, first = second_differences(cells, spacing)
    rate = nu * ro.apply(second, u) - u * ro.apply(first, u)
    wave = np.sin(2 * np.pi * (np.arange(cells) + 1) * spacing)
    box = {nu: (0.01, 0.04), a: (0.5, 1)}
    return ro.Problem({u: rate}, (t, 0, 0.5), box, {u: ro.apply(wave, a)})


def convection(side):
    """Heat that is carried along, by a flow of variable speed and angle."""
    t, c, angle = sp.symbols("t c theta")
    x, y, (xx, dx), (yy, dy) = square(side)
    u = ro.field("u", side**2)
    rate = 0.02 * ro.apply(xx + yy, u)
    rate += -c * sp.cos(angle) * ro.apply(dx, u) - c * sp.sin(angle) * ro.apply(dy, u)
    start = np.exp(-60 * ((x - 0.3) ** 2 + (y - 0.5) ** 2)).ravel()
    return ro.Problem({u: rate}, (t, 0, 0.5), {c: (0.4, 0.8), angle: (-0.4, 0.4)}, {u: start})


def beam(elements):
    """A rubber beam that swings: the example."""
    made: ro.Problem = runpy.run_path(str(EXAMPLES / "beam.py"))["problem"](elements)
    return made


CASES = {
    "heat40": (heat, 40, 1e-3),
    "heat100": (heat, 100, 1e-4),
    "heat200": (heat, 200, 1e-4),
    "block": (block, 100, 1e-3),
    "cable": (cable, 512, 1e-4),
    "cable_at_rest": (cable_at_rest, 512, 1e-4),
    "brusselator": (reaction, 64, 1e-4),
    "burgers": (burgers, 1000, 1e-4),
    "convection": (convection, 100, 1e-4),
    "beam": (beam, 4, 1e-4),
}
BY_PYMOR = {"heat100": 5, "block": 20}  # Trajectories
POINTS, TIMES = 4, 41


def by_scipy(system, point, rtol, sizes, times):
    """A trajectory of SciPy's BDF with the sparse Jacobian."""
    own = system.at(point)
    if system.mass is not None:
        unknowns = [sizes[unknown.rows][0] for unknown in system.unknowns]
        how = np.array(unknowns), 0.01 * rtol, 0.01 * rtol, times
        trajectory = field_trajectory(system, point, *how)
        return np.concatenate([states.at(slice(None)) for states in trajectory.states])
    return scipy.integrate.solve_ivp(
        own.force,
        system.horizon,
        system.initial(point),
        method="BDF",
        jac=own.jacobian,
        rtol=rtol,
        atol=rtol * sizes,
        t_eval=times,
    ).y


def first_points(system, count=5):
    """The centre and corners."""
    lower, upper = np.array(system.box).T
    all_corners = np.array([*itertools.product((0.0, 1.0), repeat=len(lower))])
    at = np.random.default_rng(0).permutation(all_corners)[: count - 1]
    return [0.5 * (lower + upper), *(lower + at * (upper - lower))]


def further_points(system):
    """Points at which errors are measured."""
    lower, upper = np.array(system.box).T
    return lower + np.random.default_rng(7).random((POINTS, len(lower))) * (upper - lower)


def pymor_section(*names):
    """Linear fields by modes of pyMOR."""
    for name in names or BY_PYMOR:
        build, size, rtol = CASES[name]
        system = field_system(build(size))
        sizes = np.ones(system.size)
        lines = by_pymor(
            system,
            first_points(system, BY_PYMOR[name]),
            further_points(system),
            lambda point, times: by_scipy(system, point, 1e-3 * rtol, sizes, times),  # noqa: B023
        )
        print("\n".join(f"  {line}" for line in (f"{name}:", *lines)))


def by_hand(system, rtol, sizes, times):
    """Modes of five trajectories, at the centre and at corners."""
    points = first_points(system)
    columns = [by_scipy(system, point, 0.01 * rtol, sizes, times) for point in points]
    together = np.concatenate(columns, axis=1) / sizes[:, None]
    modes, values, _ = np.linalg.svd(together, full_matrices=False)
    return modes[:, values > 1e-6 * values[0]]


def solve_section(name):
    """One solve, and its error against trajectories of SciPy at points of their own."""
    build, size, rtol = CASES[name]
    problem, building = seconds(lambda: build(size))
    compiled, compiling = seconds(lambda: ro.compile(problem))
    solution, solving = seconds(lambda: compiled.solve(rtol, method="reduced"))
    system, bounds = compiled.system, np.array(compiled.system.box)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{system.size} entries, {len(bounds)} parameters, rtol {rtol:g}: {solution.message}")
    print(f"  {building + compiling:.2f} s of building and compiling, {solving:.1f} s of solving")
    modes = solution.modes
    print(f"  {peak:.0f} MB, {modes.trajectories} full trajectories, modes {modes.counts}")
    scales = np.where(np.array(solution.modes.scales) > 0.0, solution.modes.scales, 1.0)
    sizes = np.repeat(scales, [unknown.size for unknown in system.unknowns])
    times = np.linspace(*system.horizon, TIMES)
    _, one = seconds(lambda: by_scipy(system, bounds.mean(axis=1), 0.01 * rtol, sizes, times))
    modes, hand = seconds(lambda: by_hand(system, rtol, sizes, times))
    print(f"  a trajectory of SciPy {one:.2f} s")
    print(f"  modes of five by hand {hand:.1f} s, {modes.shape[1]} modes")
    if name in BY_PYMOR:
        pymor_section(name)
    if not solution.success:
        return
    points = further_points(system)
    worst = missed = 0.0
    for point in points:
        exact = by_scipy(system, point, 1e-3 * rtol, sizes, times)
        ours = solution(times, dict(zip(system.parameters, point, strict=True)))
        worst = max(worst, float((np.abs(ours - exact) / sizes[:, None]).max()))
        scaled = exact / sizes[:, None]
        missed = max(missed, float(np.abs(scaled - modes @ (modes.T @ scaled)).max()))
    print(f"  error at {POINTS} further points {worst:.1e}; modes by hand leave out {missed:.1e}")
    point = dict(zip(system.parameters, points[0], strict=True))
    solution(times[7], point)
    _, each = seconds(lambda: [solution(times[7], point) for _ in range(100)])
    print(f"  evaluation at a point {1e4 * each:.0f} us")


def processes_section():
    """Sixteen full trajectories by one process and by two, which are warm."""
    for name in ("heat100", "cable"):
        build, size, rtol = CASES[name]
        system = field_system(build(size))
        lower, upper = np.array(system.box).T
        points = lower + np.random.default_rng(0).random((16, len(lower))) * (upper - lower)
        how = field_sizes(system, points[:1]), 0.01 * rtol, 0.01 * rtol
        began = time.perf_counter()
        alone = FieldIntegration(system, *how, None, 0.0).trajectories(points)
        one = time.perf_counter() - began
        with open_pool(2) as pool:
            integration = FieldIntegration(system, *how, pool, 0.0)
            integration.trajectories(points[:2])
            began = time.perf_counter()
            shared = integration.trajectories(points)
            two = time.perf_counter() - began
        pairs = zip(alone, shared, strict=True)
        same = all(np.array_equal(a.states[0].numbers, b.states[0].numbers) for a, b in pairs)
        print(f"{name}: one {one:.2f} s, two {two:.2f} s, x {one / two:.2f}; the same: {same}")


SECTIONS = {
    "compile": compile_section,
    **{name: partial(solve_section, name) for name in CASES},
    "processes": processes_section,
    "pymor": pymor_section,
}

if __name__ == "__main__":
    names = sys.argv[1:] or list(SECTIONS)
    for name in names:
        print(f"== {name}", flush=True)
        if len(names) > 1:  # peaks are those of one section
            subprocess.run([sys.executable, __file__, name], check=True)
        else:
            SECTIONS[name]()
