"""Algebraic equations: how they are reduced, what is refused, and trajectories of what is left."""

import pickle

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp

import rankone as ro
from rankone.problem.algebra.mass import Elimination, LinearRow
from rankone.share.commands.common import load_problem

t, k, m = sp.symbols("t k m")
x, y, z, w, lam, u, v = (sp.Function(name)(t) for name in ("x", "y", "z", "w", "lam", "u", "v"))
BOX = {k: (1, 2)}


def problem(*equations, initial, box=BOX, end=1, **options):
    return ro.Problem([sp.Eq(*sides) for sides in equations], (t, 0, end), box, initial, **options)


def pendulum():
    """A pendulum in x and y, of length k and mass 2, from rest at an angle of 0.8."""
    return problem(
        (2 * x.diff(t, 2), -lam * x),
        (2 * y.diff(t, 2), -lam * y - 2 * 9.81),
        (x**2 + y**2, k**2),
        initial={x: k * sp.sin(0.8), y: -k * sp.cos(0.8), x.diff(t): 0, y.diff(t): 0},
    )


def test_an_unknown_that_an_equation_gives_is_solved_for():
    solved = problem((x.diff(t), -k * z), (2 * z, x + sp.sin(t)), initial={x: k})
    assert solved.unknowns == (x, z)
    assert solved.reduction.solved == {z: x / 2 + sp.sin(t) / 2}
    assert not solved.reduction.guessed
    assert solved.initial == {x: k, z: k / 2}
    rates = dict(zip(solved.mass_form.leading, solved.mass_form.solved()[0], strict=True))
    half = (x + sp.sin(t)) / 2
    assert sp.expand(rates[x.diff(t)] + k * half) == 0
    assert sp.expand(rates[z.diff(t)] - (sp.cos(t) - k * half) / 2) == 0


def test_a_nonlinear_one_is_differentiated_once():
    """z' = -(g_x x' + s g) / g_z: it returns to g = 0 at a rate s."""
    guessed = problem((x.diff(t), -k * z), (z**3 + z, x), initial={x: 1, z: 0.5})
    assert guessed.reduction.guessed == (z,)
    (constraint,) = guessed.reduction.constraints
    assert (constraint.equation, constraint.order) == (2, 0)
    (_, rate), origins = guessed.mass_form.solved()
    g = z**3 + z - x
    expected = -(k * z + 20 * g) / (3 * z**2 + 1)
    assert sp.simplify(rate - expected) == 0
    assert origins == [1, None]


def test_the_constraint_of_a_pendulum_is_differentiated_twice():
    reduction = pendulum().reduction
    assert [c.name for c in reduction.constraints] == [
        "equation 3",
        "the first derivative of equation 3",
        "solved for lam(t)",
    ]
    on_circle = {k: 1, x: sp.sin(u), y: -sp.cos(u)}
    moving = {x.diff(t): w * sp.cos(u), y.diff(t): w * sp.sin(u)}
    force = reduction.solved[lam].xreplace(moving).xreplace(on_circle)
    assert sp.simplify(force - 2 * (w**2 + sp.Rational(981, 100) * sp.cos(u))) == 0


def test_first_order_mechanics_reduce_as_those_of_second_order():
    of_first_order = problem(
        (x.diff(t), u),
        (y.diff(t), v),
        (2 * u.diff(t), -lam * x),
        (2 * v.diff(t), -lam * y - 2 * 9.81),
        (x**2 + y**2, k**2),
        initial={x: k * sp.sin(0.8), y: -k * sp.cos(0.8), u: 0, v: 0},
    )
    times = np.linspace(0, 1, 7)
    ours = of_first_order.trajectory(times, k=1.5, rtol=1e-10)
    other = pendulum().trajectory(times, k=1.5, rtol=1e-10)
    for unknown in (x, y, lam):
        np.testing.assert_allclose(ours[unknown], other[unknown], rtol=1e-7, atol=1e-8)


def test_a_mass_matrix_with_a_row_of_zeros():
    """Two tanks whose levels stay equal: x' + y' = k with x = y."""
    tanks = problem((x.diff(t) + y.diff(t), k), (x, y), initial={x: 1, y: 1})
    trajectory = tanks.trajectory([0.5, 1.0], k=1.5)
    np.testing.assert_allclose(trajectory.values, [[1.375, 1.75]] * 2, rtol=1e-7)


@pytest.mark.parametrize(
    ("equations", "initial", "message"),
    [
        ([(x.diff(t), z)], {x: k}, "`z.t.` has no equation: .* or an algebraic one"),
        ([(x.diff(t), z), (z, x), (z, 2 * x)], {x: 1}, "3 equations for 2 unknowns"),
        ([(z, k)], {}, "nothing is differentiated"),
        ([(x.diff(t), z + w), (x, 1), (x, k)], {x: 1}, "structurally singular.* `z.t.`|`w.t.`"),
        ([(x.diff(t), k * z + w), (z + w, x), (2 * z + 2 * w, 2 * x)], {x: 1}, "are dependent"),
        ([(x.diff(t), k * z + w), (z + w, x), (z + w, x + 1)], {x: 1}, "contradict each other"),
        ([(x.diff(t), z), (x, k * sp.cos(t))], {x: 1}, "do not satisfy equation 2: .*at k ="),
        ([(x.diff(t, 2), z), (x, k)], {x: k, x.diff(t): 1}, "the first derivative of equation 2"),
        (
            [(x.diff(t), y), (y.diff(t), u), (u.diff(t), k * z), (x, sp.cos(t))],
            {x: 1, y: 0, u: -1},
            "equation 4: .*do not determine `z.t.`: its index is higher than 3",
        ),
        ([(x.diff(t), -k * z), (z**2, x)], {x: 1}, "no starting guess for `z.t.`"),
        ([(x.diff(t), -k * z), (z, sp.sign(x))], {x: 1}, "value of `z.t.` .*may jump"),
        (
            [(x.diff(t), -k * z), (z + z**3, x * sp.Piecewise((1, t < 0.5), (2, True)))],
            {x: 1, z: 1},
            "equation 2 is differentiated in time, .*may jump",
        ),
        ([(x.diff(t), -k * z), (z, x)], {z: 1}, "no initial value for `x.t.`"),
    ],
)
def test_what_is_not_solvable_says_why(equations, initial, message):
    with pytest.raises(ro.ProblemError, match=message):
        problem(*equations, initial=initial)


def test_steps_of_tables_and_impulses_at_times_of_parameters_are_refused():
    steps = ro.table([0, 1], [1, 2], kind="previous", name="steps")
    with pytest.raises(ro.ProblemError, match="may jump"):
        problem((x.diff(t), -k * z), (z, x + steps(t)), initial={x: 1})
    with pytest.raises(ro.ProblemError, match=r"equation 1: .*beside algebraic equations"):
        problem((x.diff(t), sp.DiracDelta(t - k / 4) - z), (z, x), initial={x: 1})


def test_a_table_in_an_equation_has_its_value_at_the_start():
    ramp = ro.table([0, 1], [1, 3], name="ramp")
    driven = problem((x.diff(t), -k * z), (z, x + ramp(t)), initial={x: 0})
    assert driven.initial[z] == 1


def test_a_guess_without_a_solution():
    lost = problem((x.diff(t), -k * z), (z**2, -x), initial={x: 1, z: 1})
    with pytest.raises(ro.ProblemError, match=r"no initial values of `z\(t\)`"):
        lost.trajectory(0.5, k=1.5)
    with pytest.raises(ro.ProblemError, match=r"of `z\(t\)` .*at k = "):
        ro.compile(lost)


def test_a_guess_chooses_among_solutions():
    for guess, sign in ((1, 1), (-1, -1)):
        squares = problem((x.diff(t), k), (z**2, x), initial={x: 4, z: guess})
        np.testing.assert_allclose(squares.trajectory([0, 1], k=1)[z], sign * np.sqrt([4, 5]))


def test_unknowns_with_guesses_are_not_put_into_each_other():
    """A ladder of diodes: solved one after the other, it is an exponential of exponentials."""
    nodes = [sp.Function(f"v{i}")(t) for i in range(4)]
    across = zip([1 + t, *nodes], nodes, [*nodes[1:], x], strict=False)
    currents = [((b - a) + (b - c), k * (1 - sp.exp(4 * b)) / 100) for a, b, c in across]
    ladder = problem(
        (x.diff(t), nodes[-1] - x), *currents, initial={x: 0, **dict.fromkeys(nodes, 0)}
    )
    assert set(ladder.reduction.guessed) == set(nodes)
    trajectory = ladder.trajectory([0.0, 0.5, 1.0], k=1.5, rtol=1e-10)
    values = [1 + trajectory.t, *(trajectory[node] for node in nodes), trajectory[x]]
    for a, b, c in zip(values, values[1:], values[2:], strict=False):
        np.testing.assert_allclose(2 * b - a - c, 0.015 * (1 - np.exp(4 * b)), atol=1e-8)


def test_what_is_solved_for_follows_resets():
    event = ro.Event(t - k / 4, then={x: x + 1}, name="dose")
    dosed = problem(
        (x.diff(t), -z), (z, x**2), initial={x: 1}, events=[event], jumps={0.8: {x: 2 * x}}
    )
    assert dosed.events[0].then == {x: x + 1, z: (x + 1) ** 2}
    times = np.array([0.1, 0.5, 0.7, 0.9])
    trajectory = dosed.trajectory(times, k=1.0, rtol=1e-10)
    after_dose = 1 / 1.25 + 1
    expected = [1 / 1.1, *(after_dose / (1 + after_dose * s) for s in (0.25, 0.45))]
    before = after_dose / (1 + after_dose * 0.55)
    expected.append(2 * before / (1 + 2 * before * 0.1))
    np.testing.assert_allclose(trajectory[x], expected, rtol=1e-8)
    np.testing.assert_allclose(trajectory[z], np.square(expected), rtol=1e-8)


@pytest.mark.parametrize(
    ("reset", "message"),
    [
        ({z: 1}, "the jump at 0.5 resets `z.t.`, which the algebraic equations determine"),
        ({x: 1}, "the jump at 0.5 resets `x.t.`, which equation 2 constrains"),
    ],
)
def test_resets_that_contradict_equations(reset, message):
    with pytest.raises(ro.ProblemError, match=message):
        problem((x.diff(t), -k * z), (z**3, x), initial={x: 1, z: 1}, jumps={0.5: reset})


def test_events_beside_guessed_unknowns_are_for_cross():
    event = ro.Event(t - k / 4, then={y: 2 * y}, name="dose")
    guessed = problem(
        (x.diff(t), -k * z),
        (y.diff(t), z),
        (z**3 + z, x),
        initial={x: 1, y: 1, z: 0.5},
        events=[event],
    )
    compiled = ro.compile(guessed)
    with pytest.raises(ro.OptionError, match="'train' takes no events beside guessed unknowns"):
        compiled.solve(1e-4, method="train")
    solution = compiled.solve(1e-5)
    trajectory = guessed.trajectory([0.2, 0.9], k=1.3)
    np.testing.assert_allclose(solution([0.2, 0.9], k=1.3), trajectory.values, atol=3e-5)


def test_printed_and_pickled():
    guessed = problem((x.diff(t), -k * z), (z**3 + z, x), (w, z + x), initial={x: 1, z: 0.5})
    assert "x(0) = 1, z(0) near 0.5\n" in repr(guessed)
    assert repr(pickle.loads(pickle.dumps(guessed))) == repr(guessed)
    system = ro.first_order(guessed)
    assert "0 = -x + z**3 + z  (equation 2)" in repr(system)
    assert "0 = w - x - z  (solved for w(t))" in repr(system)
    assert "z(0) near 0.5" in repr(system)


def test_elimination_leaves_over_what_does_not_determine():
    """p a + q b = x and r p a + r q b = y have the constraint y - r x, whatever p, q and r are."""
    for p, q, r in ((sp.S.One, sp.S.One, sp.Integer(2)), (sp.sin(u), v, u)):
        rows = [LinearRow({0: p, 1: q}, -x), LinearRow({0: r * p, 1: r * q}, -y)]
        eliminated = Elimination(pendulum().coordinates)(rows)
        assert not eliminated.solutions
        ((row, constraint),) = eliminated.constraints.items()
        assert sp.simplify(constraint * (r if row == 0 else 1) + y - r * x) == 0


@pytest.mark.parametrize(
    ("expression", "sign"),
    [
        (k, 1),
        (-k, -1),
        (k - 3, -1),
        (k - sp.Rational(3, 2), None),
        (k + sp.exp(x), 1),
        (k + x, None),
        (1 / k + k**2, 1),
        (sp.sin(k), 1),
        ((-k) ** 3, -1),
        ((-k) ** 2, 1),
    ],
)
def test_signs_over_the_box(expression, sign):
    assert Elimination(pendulum().coordinates).sign(expression) == sign


def test_text_and_files(tmp_path):
    """A pendulum in x and y with the force in its rod, which has no initial value."""
    problem = ro.Problem.from_strings(
        {},
        {"x": "sin(a)", "y": "-cos(a)", "x_t": 0, "y_t": 0},
        {"a": (0.5, 1)},
        (0, 1),
        equations=["x_tt = -force*x", "y_tt = -force*y - 9.81", "0 = x^2 + y^2 - 1"],
        unknowns=["force"],
    )
    read = load_problem(problem.save(tmp_path / "pendulum.toml"))
    assert repr(read) == repr(problem)
    angle = solve_ivp(lambda t, u: [u[1], -9.81 * np.sin(u[0])], (0, 1), [0.8, 0], rtol=1e-10,
                      atol=1e-12).y[:, -1]  # fmt: skip
    expected = [np.sin(angle[0]), -np.cos(angle[0]), angle[1] ** 2 + 9.81 * np.cos(angle[0])]
    np.testing.assert_allclose(read.trajectory(1.0, a=0.8).values, expected, rtol=1e-6)
    with pytest.raises(ro.ProblemError, match=r"unknown name `z`.*or `unknowns`"):
        ro.Problem.from_strings({"x": "-z"}, {"x": 1}, {}, (0, 1), equations=["0 = z - x"])
