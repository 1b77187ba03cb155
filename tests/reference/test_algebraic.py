"""Algebraic equations against trajectories that know nothing of them.

The references are ordinary equations in fewer coordinates, or solve for the others by bisection.
"""

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, root

import rankone as ro

t = sp.Symbol("t")
RTOL = 1e-6


def functions(names):
    return [sp.Function(name)(t) for name in names.split()]


def integrated(rates, times, start):
    """States (n, T) of an ordinary system."""
    options = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-13, "t_eval": times}
    return solve_ivp(lambda s, states: rates(s, *states), times[[0, -1]], start, **options).y


def check(problem, reference, points=12, solution=None):
    """Compare a solution, and one trajectory, with reference(times, **parameters) by name."""
    times = np.linspace(*problem.time[1:], 31)
    solution = ro.solve(problem, rtol=RTOL) if solution is None else solution
    assert solution.success, solution.message
    assert solution.outcome.measured.constraint_drift <= RTOL
    assert solution.outcome.measured.constraint_drift <= solution.error
    names = [symbol.name for symbol in problem.parameters]
    box = np.array(list(problem.parameters.values()))
    drawn = np.random.default_rng(27).uniform(box[:, 0], box[:, 1], (points, len(box)))
    exact = [reference(times, **dict(zip(names, point, strict=True))) for point in drawn]
    for unknown in problem.unknowns:
        name = unknown.func.__name__
        size = max(np.abs(states[name]).max() for states in exact)
        for point, states in zip(drawn, exact, strict=True):
            at = dict(zip(names, point, strict=True))
            assert np.abs(solution[name](times, at) - states[name]).max() <= 5 * RTOL * size, name
    trajectory = problem.trajectory(times, dict(zip(names, drawn[0], strict=True)), rtol=1e-9)
    for unknown in problem.unknowns:
        states = exact[0][unknown.func.__name__]
        np.testing.assert_allclose(
            trajectory[unknown], states, rtol=0, atol=1e-6 * np.abs(states).max()
        )
    return solution


def pendulum():
    x, y, lam = functions("x y lam")
    m, a, length = sp.symbols("m a L")
    start = {x: length * sp.sin(a), y: -length * sp.cos(a), x.diff(t): 0, y.diff(t): 0}
    return ro.Problem(
        [
            sp.Eq(m * x.diff(t, 2), -lam * x),
            sp.Eq(m * y.diff(t, 2), -lam * y - 9.81 * m),
            sp.Eq(0, x**2 + y**2 - length**2),
        ],
        (t, 0, 2),
        {m: (1, 2), a: (0.5, 1), length: (1, 1.5)},
        start,
    )


def of_pendulum(times, m, a, L):
    """By its angle."""
    angle, speed = integrated(lambda _, q, w: [w, -9.81 / L * np.sin(q)], times, [a, 0])
    force = m * (9.81 * np.cos(angle) / L + speed**2)
    return {"x": L * np.sin(angle), "y": -L * np.cos(angle), "lam": force}


@pytest.mark.slow
def test_a_pendulum_in_cartesian_coordinates():
    check(pendulum(), of_pendulum)


def test_a_pendulum_over_many_periods_stays_on_its_circle():
    """Without a return to the constraint, it drifts quadratically."""
    problem = ro.Problem(
        pendulum().equations, (t, 0, 40), {}, dict(pendulum().initial), constants=_fixed()
    )
    times = np.linspace(0, 40, 81)
    x, y, _ = problem.trajectory(times, rtol=1e-7).values
    assert np.abs(x**2 + y**2 - 1).max() < 2e-6


def _fixed():
    m, a, length = sp.symbols("m a L")
    return {m: 1, a: 1, length: 1}


@pytest.mark.slow
def test_a_circuit_with_a_diode():
    """The current through the diode follows from the voltage of its node by no formula."""
    R, C, Is = sp.symbols("R C I_s")
    stored, node, current = functions("stored node current")
    problem = ro.Problem(
        [
            sp.Eq(C * stored.diff(t), current - stored / 2),
            sp.Eq(0, (sp.sin(3 * t) - node) / R - current),
            sp.Eq(current, Is * (sp.exp(4 * (node - stored)) - 1)),
        ],
        (t, 0, 2),
        {R: (0.5, 1.5), C: (0.5, 1), Is: (0.01, 0.03)},
        {stored: 0, node: 0},
    )

    def reference(times, R, C, I_s):
        def node_at(s, v):
            left = lambda u: (np.sin(3 * s) - u) / R - I_s * (np.exp(4 * (u - v)) - 1)  # noqa: E731
            return brentq(left, -5, 5, xtol=1e-15, rtol=1e-15)

        def rates(s, v):
            return [((np.sin(3 * s) - node_at(s, v)) / R - v / 2) / C]

        (v,) = integrated(rates, times, [0])
        u = np.array([node_at(*pair) for pair in zip(times, v, strict=True)])
        return {"stored": v, "node": u, "current": (np.sin(3 * times) - u) / R}

    check(problem, reference, points=5)


def buffer():
    """An acid, to which a base is added."""
    base, H, A, HA, OH = functions("base H A HA OH")
    Ka, total, q = sp.symbols("K_a total q")
    return ro.Problem(
        [
            sp.Eq(base.diff(t), q),
            sp.Eq(H * A, Ka * HA),
            sp.Eq(total, A + HA),
            sp.Eq(H + base, OH + A),
            sp.Eq(H * OH, sp.Rational(1, 10**6)),
        ],
        (t, 0, 1),
        {Ka: (0.05, 0.1), total: (1, 2), q: (0.3, 0.6)},
        {base: 0.1, H: 0.3, OH: 1e-6},
    )


@pytest.mark.slow
def test_the_equilibrium_of_a_buffer():
    def reference(times, K_a, total, q):
        base = 0.1 + q * times

        def left(h, b):
            return h + b - 1e-6 / h - total * K_a / (K_a + h)

        h = np.array([brentq(left, 1e-12, 5, (b,), xtol=1e-18, rtol=1e-15) for b in base])
        acid = total * K_a / (K_a + h)
        return {"base": base, "H": h, "A": acid, "HA": total - acid, "OH": 1e-6 / h}

    check(buffer(), reference)


@pytest.mark.parametrize("method", ["cross", "train"])
def test_methods_find_guessed_unknowns_at_the_start(method):
    """x' = -k z with z**3 + z = x, so that t = log(z0/z)/k + 3 (z0**2 - z**2)/(2 k)."""
    x, z, w = functions("x z w")
    k = sp.Symbol("k")
    problem = ro.Problem(
        [sp.Eq(x.diff(t), -k * z), sp.Eq(0, z**3 + z - x), sp.Eq(w, z + x**2)],
        (t, 0, 2),
        {k: (1, 2)},
        {x: 1 + k, z: 1},
    )
    solution = ro.solve(problem, rtol=RTOL, method=method)
    assert solution.success
    for value in (1.0, 1.4, 2.0):
        first = brentq(lambda z, v=value: z**3 + z - 1 - v, 0, 2, xtol=1e-15)
        last = solution[z](2.0, k=value)
        passed = (np.log(first / last) + 1.5 * (first**2 - last**2)) / value
        assert passed == pytest.approx(2.0, abs=1e-5)
        expected = [last**3 + last, last, last + (last**3 + last) ** 2]
        np.testing.assert_allclose(solution(2.0, k=value), expected, rtol=2e-5)


def slider_crank():
    """A crank at an angle th, a rod at ph, a slider at x; the joints push with l1 and l2."""
    th, ph, x, l1, l2 = functions("th ph x l1 l2")
    r, length, m = sp.symbols("r l m")
    side = r * sp.sqrt(2) / 2
    turning = -2 * side / sp.sqrt(length**2 - side**2)
    return ro.Problem(
        [
            sp.Eq(th.diff(t, 2) / 2, 1 + l1 * r * sp.sin(th) - l2 * r * sp.cos(th)),
            sp.Eq(ph.diff(t, 2) / 10, l1 * length * sp.sin(ph) - l2 * length * sp.cos(ph)),
            sp.Eq(m * x.diff(t, 2), l1),
            sp.Eq(x, r * sp.cos(th) + length * sp.cos(ph)),
            sp.Eq(0, r * sp.sin(th) + length * sp.sin(ph)),
        ],
        (t, 0, 2),
        {r: (0.4, 0.6), length: (1.5, 2), m: (0.5, 1)},
        {
            th: sp.pi / 4,
            ph: -sp.asin(side / length),
            x: side + sp.sqrt(length**2 - side**2),
            th.diff(t): 2,
            ph.diff(t): turning,
            x.diff(t): side * (turning - 2),
        },
    )


def of_slider_crank(times, r, l, m):  # noqa: E741
    """By the angle of the crank alone, from the energy of all three bodies."""

    def linked(q):
        """Sine and cosine of the rod's angle, and the slopes of its angle and of the slider."""
        s = -r * np.sin(q) / l
        c = np.sqrt(1 - s**2)
        p1 = -r * np.cos(q) / (l * c)
        p2 = (r * np.sin(q) / l + s * p1**2) / c
        x1, x2 = -r * np.sin(q) - l * s * p1, -r * np.cos(q) - l * (c * p1**2 + s * p2)
        return s, c, p1, p2, x1, x2

    def acceleration(q, w):
        _, _, p1, p2, x1, x2 = linked(q)
        return (1 - w**2 * (0.1 * p1 * p2 + m * x1 * x2)) / (0.5 + 0.1 * p1**2 + m * x1**2)

    q, w = integrated(lambda _, q, w: [w, acceleration(q, w)], times, [np.pi / 4, 2])
    s, c, p1, p2, x1, x2 = linked(q)
    along = m * (x2 * w**2 + x1 * acceleration(q, w))
    across = (along * l * s - 0.1 * (p2 * w**2 + p1 * acceleration(q, w))) / (l * c)
    x = r * np.cos(q) + l * c
    return {"th": q, "ph": np.arcsin(s), "x": x, "l1": along, "l2": across}


@pytest.mark.slow
def test_a_slider_crank_here_and_in_a_standalone_solver(tmp_path):
    compiled = ro.compile(slider_crank())
    solution = compiled.solve(RTOL)
    check(compiled.problem, of_slider_crank, solution=solution)
    path = compiled.export(tmp_path / "slider.py", method="cross")
    names = {"__name__": "slider", "__file__": str(path)}
    exec(compile(path.read_text(), str(path), "exec"), names)
    options = {"parameters": {"r": (0.44, 0.46)}, "t_final": 0.5, "check": 8}
    there, here = names["solve"](RTOL, **options), compiled.solve(RTOL, **options)
    point = {"r": 0.45, "l": 1.7, "m": 0.8}
    np.testing.assert_array_equal(there(0.4, point), here(0.4, point))


def random_problem(seed):
    """One to three unknowns of either kind, with functions of all of them; and f, g."""
    rng = np.random.default_rng(seed)
    k, a = sp.symbols("k a")
    n, m = rng.integers(1, 4, 2)
    shapes = [sp.sin, sp.tanh, lambda e: e**2 / 4, sp.cos, lambda e: e]
    us = functions(" ".join(f"u{i}" for i in range(n)))
    zs = functions(" ".join(f"z{i}" for i in range(m)))

    def number():
        return sp.Rational(int(rng.integers(-9, 10)), 10)

    def terms():
        return sum(number() * shapes[rng.integers(5)](v) for v in (*us, *zs))

    f = [-u + terms() + k * number() + number() * sp.cos(2 * t) for u in us]
    g = [4 * z + z**3 * int(seed % 3 == 0) + terms() - a * number() - sp.sin(t) / 2 for z in zs]
    equations = [*(sp.Eq(u.diff(t), e) for u, e in zip(us, f, strict=True)), *g]
    initial = {**{u: number() for u in us}, **dict.fromkeys(zs, 0)}
    problem = ro.Problem(equations, (t, 0, 3), {k: (1, 2), a: (0.5, 1.5)}, initial)
    arguments = [t, k, a, *us, *zs]
    return problem, us, zs, sp.lambdify(arguments, f), sp.lambdify(arguments, g)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_random_systems_against_roots_at_every_step(seed):
    problem, us, zs, f, g = random_problem(seed)
    solution = ro.solve(problem, rtol=1e-5)
    assert solution.success, solution.message
    times = np.linspace(0, 3, 13)
    for k, a in ((1.0, 0.5), (1.7, 1.2)):
        guess = np.zeros(len(zs))

        def roots(s, states, k=k, a=a, guess=guess):
            found = root(lambda z: g(s, k, a, *states, *z), guess, tol=1e-13).x
            guess[:] = found
            return found

        rates = lambda s, *u, k=k, a=a, roots=roots: f(s, k, a, *u, *roots(s, u))  # noqa: E731
        states = integrated(rates, times, [float(problem.initial[u]) for u in us])
        guess[:] = 0.0
        others = np.array([roots(*pair) for pair in zip(times, states.T, strict=True)]).T
        for unknown, exact in zip([*us, *zs], [*states, *others], strict=True):
            size = max(np.abs(exact).max(), 1e-3)
            assert np.abs(solution[unknown](times, k=k, a=a) - exact).max() <= 5e-5 * size
