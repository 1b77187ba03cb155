"""Random fields against trajectories that share nothing with the library's.

``python -m tests.honesty.random_fields [count] [seed]`` draws graphs and grids of 200 to 2,000
entries, and every sixth time of up to 5,000, with diffusion and saturating, cubic or exponential
terms, some with two fields, a mass matrix, a moving source or a shape that a parameter scales;
solves each by its modes; and compares all entries at 21 times of random points with SciPy's LSODA,
or DOP853 where there are many, on rates that are written here.
"""

import sys
import time

import numpy as np
import scipy.integrate
import scipy.sparse as ss
import sympy as sp

import rankone as ro

POINTS, TIMES = 5, 21
LARGE = 6  # Every so many are large
DENSE = 2500  # States up to which an integrator may hold a dense Jacobian
BORDERLINE = 1.1  # True error over the tolerance up to which a success counts as borderline


def grid(generator, large):
    """Diffusion on a rectangle with no flux through its sides."""
    a, b = generator.integers(*((36, 71) if large else (12, 36)), 2)
    lines = []
    for n in (a, b):
        line = ss.diags_array([1.0, -2.0, 1.0], offsets=(-1, 0, 1), shape=(n, n)).tolil()
        line[0, 0] = line[-1, -1] = -1.0
        lines.append(ss.csr_array(line))
    return ss.csr_array(ss.kron(lines[0], ss.eye_array(b)) + ss.kron(ss.eye_array(a), lines[1]))


def graph(generator, large):
    """Diffusion on a random graph, of four neighbours in the mean."""
    n = int(generator.integers(*((1200, 5000) if large else (200, 1200))))
    ends = generator.integers(0, n, (2, 2 * n))
    once = ss.csr_array((np.ones(2 * n), ends), shape=(n, n))
    weights = ss.csr_array(((once + once.T) > 0).astype(float))
    weights.setdiag(0.0)
    return ss.csr_array(weights - ss.diags_array(weights.sum(axis=1)))


TERMS = {
    "saturating": (lambda u, a: -a * u / (1 + u**2), lambda u, a: -a * u / (1 + u**2)),
    "cubic": (lambda u, a: a * (u - u**3), lambda u, a: a * (u - u**3)),
    "exponential": (lambda u, a: a * sp.exp(-u), lambda u, a: a * np.exp(-u)),
}


def drawn(seed):
    """A problem, and its rates and initial values as functions of NumPy."""
    generator = np.random.default_rng(seed)
    matrix = (grid if generator.random() < 0.5 else graph)(generator, seed % LARGE == 0)
    n, t = matrix.shape[0], sp.Symbol("t")
    count = int(generator.integers(1, 5))
    symbols = sp.symbols(f"p0:{count}")
    box = {}
    for symbol in symbols:
        middle, width = generator.uniform(0.5, 1.5), generator.uniform(0.05, 0.4)
        box[symbol] = (middle * (1 - width), middle * (1 + width))
    D, name = generator.uniform(0.02, 0.5), str(generator.choice(list(TERMS)))
    shape = np.convolve(generator.standard_normal(n + 20), np.ones(21) / 21, "valid")
    shape = shape / np.abs(shape).max()
    source, symbolic, numeric = generator.random(n), *TERMS[name]
    two, moving, massive = (generator.random(3) < (0.35, 0.4, 0.25)).tolist()

    def p(values, k):
        return values[k] if k < len(values) else 1.0

    u, v = ro.field("u", n), ro.field("v", n)
    wave = sp.cos(3 * t) if moving else 1
    rate = D * p(symbols, 0) * ro.apply(matrix, u) + symbolic(u, p(symbols, 1))
    rate += ro.apply(source, p(symbols, 2) * wave)
    rates, initial = {u: rate}, {u: ro.apply(0.5 + 0.5 * shape, p(symbols, 3))}
    if two:
        rates = {u: rate - v, v: 0.5 * (u - v) + 0.1 * D * ro.apply(matrix, v)}
        initial[v] = 0.0
    weights = generator.uniform(0.5, 2.0, n) if massive else np.ones(n)
    mass = {"mass": {u: ss.diags_array(weights)}} if massive else {}
    horizon = float(generator.uniform(0.5, 3.0))
    problem = ro.Problem(rates, (t, 0, horizon), box, initial, **mass)

    def force(time, states, values):
        a, b = states[:n], states[n:]
        here = D * p(values, 0) * (matrix @ a) + numeric(a, p(values, 1))
        here += source * p(values, 2) * (np.cos(3 * time) if moving else 1.0)
        if not two:
            return here / weights
        there = 0.5 * (a - b) + 0.1 * D * (matrix @ b)
        return np.concatenate([(here - b) / weights, there])

    def start(values):
        own = (0.5 + 0.5 * shape) * p(values, 3)
        return np.concatenate([own, np.zeros(n)]) if two else own

    kind = f"{name}, {n} x {1 + two}, {count} parameters" + ", mass" * massive + ", moving" * moving
    return problem, force, start, kind


def true_error(solution, problem, force, start, seed, rtol):
    """The largest error at random points and two corners, relative to each field's size."""
    bounds = np.array([*problem.parameters.values()])
    shares = np.random.default_rng(seed + 1000).random((POINTS, len(bounds)))
    shares[0], shares[1] = 0.0, 1.0
    times = np.linspace(*problem.time[1:], TIMES)
    n, worst = problem.fields[0].size, 0.0
    size = n * len(problem.fields)
    for share in shares:
        values = bounds[:, 0] + share * np.ptp(bounds, axis=1)
        exact = scipy.integrate.solve_ivp(
            force,
            problem.time[1:],
            start(values),
            args=(values,),
            rtol=1e-3 * rtol,
            atol=1e-4 * rtol,
            t_eval=times,
            method="LSODA" if size <= DENSE else "DOP853",
        ).y
        named = dict(zip((symbol.name for symbol in problem.parameters), values, strict=True))
        ours = solution(times, named)
        for k, scale in enumerate(solution.modes.scales):
            rows = slice(k * n, (k + 1) * n)
            worst = max(worst, float(np.abs(ours[rows] - exact[rows]).max() / scale))
    return worst


def main(count=60, seed=0):
    """Draw, solve, compare, and print a line for each."""
    totals = dict.fromkeys(("solved", "borderline", "WRONG", "refused"), 0)
    for k in range(seed, seed + count):
        problem, *written, kind = drawn(k)
        rtol = 1e-3 if k % 2 else 1e-4
        began = time.process_time()
        solution = ro.solve(problem, rtol=rtol, method="reduced")
        seconds = time.process_time() - began
        verdict, error = "refused", np.nan
        if solution.success:
            error = true_error(solution, problem, *written, k, rtol)
            verdict = "solved" if error <= rtol else "borderline"
            verdict = "WRONG" if error > BORDERLINE * rtol else verdict
        totals[verdict] += 1
        print(
            f"{k:4d} {verdict:10s} rtol {rtol:g} claimed {solution.error:.1e} true {error:.1e} "
            f"{solution.modes.trajectories:3d} trajectories {seconds:5.1f} s  {kind}"
            + ("" if solution.success else f": {solution.message}"),
            flush=True,
        )
    print(", ".join(f"{name} {number}" for name, number in totals.items()))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
