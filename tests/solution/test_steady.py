"""Steady states of networks against closed forms and bisection; branches, folds, and errors."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp
from scipy.optimize import brentq

import rankone as ro
from rankone.support.budget import NORMAL, limited
from rankone.trajectories.rest import SteadyStates, from_states

t, k, a, b = sp.symbols("t k a b")
x, y, z, E, S, C, P, ill, R = (sp.Function(name)(t) for name in [*"xyzESCPIR"])
RTOL = 1e-6


def problem(rates, box, initial, end=10, **options):
    equations = [sp.Eq(u.diff(t), rate) for u, rate in rates.items()]
    return ro.Problem(equations, (t, 0, end), box, initial, **options)


def enzyme():
    """Substrate is fed, product is washed out, the total of the enzyme stays 1."""
    bound, freed = 2 * E * S, C + b * C
    rates = {S: a - bound + C, E: freed - bound, C: bound - freed, P: b * C - P}
    start = {S: 0, E: 1, C: 0, P: 0}
    return problem(rates, {a: (0.1, 0.3), b: (1, 2)}, start), lambda a, b: [
        (a + a / b) / (2 * (1 - a / b)),
        1 - a / b,
        a / b,
        a,
    ]


def oscillator_at_rest():
    """The Brusselator below its bifurcation."""
    rates = {x: a + x**2 * y - (k + 1) * x, y: k * x - x**2 * y}
    box = {k: (1, 1.5), a: (1, 1.2)}
    return problem(rates, box, {x: 1.2, y: 1}), lambda k, a: [a, k / a]


def epidemic():
    """Susceptible, infected and recovered, with births and deaths."""
    infected = a * S * ill
    rates = {S: 0.1 - infected - 0.1 * S, ill: infected - (k + 0.1) * ill, R: k * ill - 0.1 * R}
    start = {S: 0.9, ill: 0.1, R: 0}

    def exact(a, k):
        s = (k + 0.1) / a
        i = 0.1 * (1 - s) / (a * s)
        return [s, i, 10 * k * i]

    return problem(rates, {a: (2, 3), k: (0.4, 0.8)}, start), exact


def repression():
    """A chain of three whose last member represses the first."""
    rates = {x: a / (1 + z**2) - x, y: x - y, z: b * y - z}

    def exact(a, b):
        first = brentq(lambda x: a / (1 + (b * x) ** 2) - x, 0, 10, xtol=1e-15)
        return [first, first, b * first]

    return problem(rates, {a: (1, 2), b: (0.8, 1.2)}, {x: 0, y: 0, z: 0}), exact


def switch():
    """Modified and unmodified protein (Goldbeter and Koshland), with the total 1."""
    J = sp.Rational(1, 5)
    on, off = k * x / (J + x), y / (J + y)

    def exact(k):
        share = brentq(lambda y: k * (1 - y) / (1.2 - y) - y / (0.2 + y), 0, 1, xtol=1e-15)
        return [1 - share, share]

    return problem({x: off - on, y: on - off}, {k: (0.8, 1.2)}, {x: 1, y: 0}), exact


def gene(start=0, largest=0.04):
    """It activates itself: two stable states."""
    rates = {x: a + x**2 / (1 + x**2) - k * x}
    return problem(rates, {a: (0.02, largest), k: (0.42, 0.46)}, {x: start})


def lower(a, k):
    return [brentq(lambda x: a + x**2 / (1 + x**2) - k * x, 0, 0.25, xtol=1e-15)]


@pytest.mark.parametrize(
    "network",
    [
        pytest.param(enzyme, marks=pytest.mark.slow),
        oscillator_at_rest,
        epidemic,
        repression,
        switch,
        lambda: (gene(), lower),
    ],
    ids=["enzyme", "oscillator_at_rest", "epidemic", "repression", "switch", "bistable gene"],
)
def test_networks_come_to_rest(network):
    model, exact = network()
    steady = ro.steady_state(model, rtol=RTOL)
    assert steady.success, steady.message
    assert "is stable" in steady.message
    names = [symbol.name for symbol in model.parameters]
    box = np.array(list(model.parameters.values()))
    points = np.random.default_rng(5).uniform(box[:, 0], box[:, 1], (40, len(box)))
    expected = np.array([exact(**dict(zip(names, p, strict=True))) for p in points]).T
    states = steady(dict(zip(names, points.T, strict=True)))
    size = np.abs(expected).max(axis=1, keepdims=True)
    assert (np.abs(states - expected) / size).max() <= 5 * RTOL
    corners = np.array(list(itertools.product(*box)))
    points = np.concatenate([points[:8], 0.996 * corners + 0.004 * box.mean(axis=1)])
    gradient = steady.gradient(dict(zip(names, points.T, strict=True)))
    widths = np.diff(box)[:, 0]
    shifts = 1e-3 * np.array([-2, -1, 1, 2])[:, None, None] * np.diag(widths)
    moved = points + shifts[:, :, None]
    u = [[[exact(**dict(zip(names, p, strict=True))) for p in row] for row in m] for m in moved]
    slopes = np.tensordot(np.array([1, -8, 8, -1]) / 12e-3, np.array(u), 1)
    errors = np.abs(gradient * widths[:, None] - slopes.transpose(2, 0, 1))
    assert (errors.max(axis=(1, 2)) <= RTOL * np.abs(slopes).max(axis=(0, 1))).all()


@pytest.mark.slow
def test_totals_of_compartments_of_different_volumes_are_kept():
    """The amounts S + a*(C + P) are conserved; their coefficients depend on a parameter."""
    across, paired = k * (S - C), 2 * C**2 - P
    model = problem({S: -across, C: across / a - paired, P: paired}, {k: (1, 2), a: (0.5, 3)},
                    {S: 5, C: 0, P: 0})  # fmt: skip
    steady = ro.steady_state(model)
    assert steady.success, steady.message
    for volume in (0.6, 1.7, 2.9):
        share = brentq(lambda c: c + volume * (c + 2 * c**2) - 5, 0, 5, xtol=1e-15)  # noqa: B023
        expected = [share, share, 2 * share**2]
        np.testing.assert_allclose(steady(k=1.2, a=volume), expected, rtol=5 * RTOL)


@pytest.mark.slow
def test_initial_values_choose_the_branch():
    low, high = (ro.steady_state(gene(start), rtol=1e-4) for start in (0, 3))
    assert low.success
    assert high.success
    assert low(a=0.03, k=0.44)[0] < 0.2 < 1.5 < high(a=0.03, k=0.44)[0]
    assert "the branch with x = 0.08" in low.message


@pytest.mark.slow
def test_a_fold_inside_the_box_is_named():
    """At the fold k is the slope of x**2/(1 + x**2), and a follows from x."""
    with pytest.raises(ro.ConvergenceError, match="ends in a fold at") as caught:
        ro.steady_state(gene(largest=0.06))
    named = caught.value.message.split(" at ")[-1]
    at = {name: float(x) for name, x in (pair.split(" = ") for pair in named.split(", "))}
    fold = brentq(lambda x: 2 * x / (1 + x**2) ** 2 - at["k"], 0, 0.5)
    assert at["a"] == pytest.approx(at["k"] * fold - fold**2 / (1 + fold**2), rel=1e-3)


BRUSSELATOR = {x: 1 + x**2 * y - (a + 1) * x, y: a * x - x**2 * y}
LORENZ = {x: 10 * (y - x), y: x * (a - z) - y, z: x * y - 2 * z}


@pytest.mark.parametrize(
    ("kind", "rates", "box", "start", "place"),
    [
        ("fold", {x: a + x**2 - x}, {a: (0.1, 0.3)}, {x: 0}, 0.25),
        ("Hopf", BRUSSELATOR, {a: (1.2, 2.5)}, {x: 1, y: 1}, 2),
        pytest.param(
            "Hopf", BRUSSELATOR, {a: (1.8, 2.9)}, {x: 1.1, y: 2}, 2, marks=pytest.mark.slow
        ),
        ("transcritical", {x: a * x - x**2, y: x - y}, {a: (-0.5, 1)}, {x: 1, y: 0}, 0),
        ("transcritical", {x: y * x - 2 * x, y: a - y - x * y}, {a: (1, 2.7)}, {x: 1, y: 0}, 2),
        ("pitchfork", {x: a * x - x**3}, {a: (-1, 0.6)}, {x: 1}, 0),
        ("pitchfork", {x: a * x - x**3}, {a: (-0.4, 1)}, {x: 1}, 0),
        ("pitchfork", LORENZ, {a: (0.2, 1.6)}, {x: 1, y: 1, z: 0}, 1),
        # at the centre of the box, where nothing settles
        ("fold", {x: a + x**2}, {a: (-1, 1)}, {x: -0.5}, 0),
        pytest.param(
            "Hopf", BRUSSELATOR, {a: (1.5, 2.5)}, {x: 1.1, y: 2}, 2, marks=pytest.mark.slow
        ),
        ("transcritical", {x: a * x - x**2}, {a: (-1, 1)}, {x: 1}, 0),
        ("pitchfork", {x: a * x - x**3}, {a: (-1, 1)}, {x: 1}, 0),
    ],
)
def test_bifurcations_are_named_and_located(kind, rates, box, start, place):
    """In closed form; from either side, with fast and slow states, at zero and elsewhere."""
    with pytest.raises(ro.ConvergenceError) as caught:
        ro.steady_state(problem(rates, box, start), settle=5000)
    found = caught.value.bifurcation
    assert found.kind == kind
    assert found.parameters["a"] == pytest.approx(place, abs=1e-6)
    assert str(found) in caught.value.message


def test_the_frequency_of_a_hopf_point_is_that_of_the_oscillation():
    with pytest.raises(ro.ConvergenceError) as caught:
        ro.steady_state(problem(BRUSSELATOR, {a: (1.2, 2.5)}, {x: 1, y: 1}), settle=5000)
    assert caught.value.bifurcation.frequency == pytest.approx(1, abs=1e-6)
    assert caught.value.bifurcation.state == pytest.approx({"x": 1, "y": 2}, abs=1e-6)


@pytest.mark.slow
def test_slow_settling_is_no_bifurcation():
    """Perturbations decay at 1e-3 in all of the box: a longer time is the remedy, and works."""
    slow = problem({x: k - x, y: (x - y) / 1000}, {k: (1, 2)}, {x: 0, y: 0})
    with pytest.raises(ro.ConvergenceError, match=r"decay at a rate of 0\.001") as caught:
        ro.steady_state(slow)
    assert caught.value.bifurcation is None
    settle = float(caught.value.remedy.split("settle=")[1].split(",")[0])
    assert ro.steady_state(slow, settle=settle)(k=1.5) == pytest.approx([1.5, 1.5])


@pytest.mark.slow
def test_the_time_to_settle_is_that_of_the_slowest_part_of_the_box():
    slow = problem({x: k - x, y: (x - y) * (k - 1) / 200}, {k: (1.1, 3)}, {x: 0, y: 0})
    with pytest.raises(ro.ConvergenceError, match=r"elsewhere at 0\.0005") as caught:
        ro.steady_state(slow, settle=200)
    settle = float(caught.value.remedy.split("settle=")[1].split(",")[0])
    assert ro.steady_state(slow, settle=settle)(k=1.2) == pytest.approx([1.2, 1.2])


def test_rest_at_a_saddle_is_said():
    """Without predators the prey comes to rest, and nothing oscillates."""
    rates = {x: x * (1 - x / k) - x * y, y: x * y - y / 2}
    with pytest.raises(ro.ConvergenceError, match="come to rest at a steady state that is not"):
        ro.steady_state(problem(rates, {k: (1, 2)}, {x: 0.5, y: 0}))


@pytest.mark.parametrize("share", [1, pytest.param(1e-9, marks=pytest.mark.slow)])
def test_steady_states_at_zero(share):
    """Rounding is that of the values on the way; beside other states that are not zero as well."""
    rates = {x: -k * x, y: x - y, z: share - z}
    steady = ro.steady_state(problem(rates, {k: (0.5, 2)}, {x: 1, y: 0, z: 0}))
    assert steady.success, steady.message
    assert steady(k=1.1) == pytest.approx([0, 0, share], rel=1e-6, abs=1e-18)


@pytest.mark.slow
def test_a_continuum_of_steady_states_is_said():
    """Any share of the susceptible may be left of an epidemic without births."""
    epidemic = problem(
        {S: -k * S * ill, ill: k * S * ill - ill / 2}, {k: (0.8, 1)}, {S: 1, ill: 0.1}
    )
    with pytest.raises(ro.ConvergenceError, match="are not isolated"):
        ro.steady_state(epidemic)


@pytest.mark.slow
def test_another_branch_inside_the_box_is_named():
    """x goes to 1 from above a, and to 0 from below."""
    model = problem({x: k * x * (1 - x) * (x - a)}, {k: (1, 2), a: (0.3, 0.6)}, {x: 0.5})
    with pytest.raises(ro.ConvergenceError, match=r"is left at k = .*, a = 0\.[45]") as caught:
        ro.steady_state(model)
    named = float(caught.value.message.split("a = ")[1].split(":")[0])
    assert named == pytest.approx(0.5, abs=0.02)


@pytest.mark.slow
def test_what_does_not_come_to_rest():
    vibration = ro.Problem(
        [sp.Eq(x.diff(t, 2) + k * x, 1)], (t, 0, 2), {k: (1, 2)}, {x: 0, x.diff(t): 0}
    )
    with pytest.raises(ro.ConvergenceError, match=r"not settled by t = 200 at .*may oscillate"):
        ro.steady_state(vibration)
    slow = problem({x: (k - x) / 10**4}, {k: (1, 2)}, {x: 0}, end=1)
    with pytest.raises(ro.ConvergenceError, match=r"not settled by t = 100 at k = 1\.5"):
        ro.steady_state(slow)
    assert ro.steady_state(slow, settle=1e6)(k=1.3) == pytest.approx(1.3)
    with pytest.raises(ro.BlowUpError, match=r"blows up at t = 0\.66"):
        ro.steady_state(problem({x: k * x**2}, {k: (1, 2)}, {x: 1}))


def test_problems_without_steady_states():
    with pytest.raises(ro.ProblemError, match=r"rate of `x\(t\)` depends on the time"):
        ro.steady_state(problem({x: sp.sin(t) - k * x}, {k: (1, 2)}, {x: 0}))
    jumping = problem({x: -k * x}, {k: (1, 2)}, {x: 1}, jumps={1: {x: x + 1}})
    with pytest.raises(ro.ProblemError, match="jumps or events"):
        ro.steady_state(jumping)
    with pytest.raises(ro.OptionError, match="settle"):
        ro.steady_state(gene(), settle=-1)
    with pytest.raises(ro.OptionError, match="steady_state"):
        ro.steady_state("gene")


def test_unstable_initial_values_stay_and_are_said():
    steady = ro.steady_state(problem({x: k * x * (1 - x)}, {k: (1, 2)}, {x: 0}))
    assert steady(k=1.5) == 0
    assert "is unstable: some perturbation grows at a rate of 2" in steady.message


@pytest.mark.slow
def test_mechanics_and_algebraic_equations_rest_too():
    spring = ro.Problem(
        [sp.Eq(x.diff(t, 2) + x.diff(t) + k * x, 1)], (t, 0, 10), {k: (1, 2)}, {x: 0, x.diff(t): 0}
    )
    steady = ro.steady_state(spring)
    assert steady.states == ("x",)
    assert steady(k=1.6) == pytest.approx(1 / 1.6, rel=1e-6)
    equations = [sp.Eq(x.diff(t), k - z), sp.Eq(z**3 + z, x)]
    guessed = ro.Problem(equations, (t, 0, 10), {k: (1, 2)}, {x: 1, z: 1})
    np.testing.assert_allclose(ro.steady_state(guessed)(k=1.6), [1.6**3 + 1.6, 1.6], rtol=1e-6)


@pytest.mark.slow
def test_consumers_take_it(tmp_path):
    steady = ro.steady_state(gene(), rtol=1e-5)
    assert steady.mean().shape == (1,)
    assert steady.sobol().first.shape == (1, 2)
    assert steady.output({"q": x**2})(a=0.03, k=0.44) == pytest.approx(
        steady(a=0.03, k=0.44) ** 2, rel=1e-4
    )
    steady.save(tmp_path / "gene.npz")
    loaded = ro.load(tmp_path / "gene.npz")
    assert loaded.message == steady.message
    np.testing.assert_array_equal(loaded(a=0.03, k=0.44), steady(a=0.03, k=0.44))
    steady.export(tmp_path / "gene.py")


def test_a_start_among_the_parameters_is_left_as_it_is():
    """Where trajectories do not settle, the message is about the point that was asked for."""
    swing = ro.compile(problem({x: k * y, y: -k * x}, {k: (1, 2)}, {x: 1, y: 0}))
    whole = from_states(swing.system, (0.0, 9.0))
    named = replace(whole, parameters=("k", "x(0)", "y(0)"), box=((1, 2), (1, 1), (0, 0)))
    steady = SteadyStates(named, 1.0, 9.0)
    start = np.array([1.5, 1.0, 0.0])
    with pytest.raises(ro.ConvergenceError, match="have not settled by t = 9"):
        steady(start[:, None])
    assert start.tolist() == [1.5, 1.0, 0.0]


@pytest.mark.slow
def test_finer_solves_for_gradients_share_one_patience():
    """Next to a fold the gradients of a solve within the tolerance are not."""
    near = problem({x: a * x * (1 - x) - b}, {a: (1, 1.5), b: (0.1, 0.2499)}, {x: 1})
    with limited() as account:
        steady = ro.steady_state(near, rtol=1e-3, effort=0.04)
    assert steady.success
    assert account.done < 0.04 * NORMAL
    exact = 0.5 + np.sqrt(0.25 - np.array([0.2, 0.2499]))
    np.testing.assert_allclose(steady(a=1, b=[0.2, 0.2499]).ravel(), exact, atol=1e-3)


def test_steps_of_newton_count():
    system = ro.compile(problem({x: a - x**2}, {a: (1, 2)}, {x: 1})).system
    constraints = SteadyStates(system, 10.0, 1000.0).constraints([0])
    work = []
    for count in (1, 1000):
        points = np.linspace(1, 2, count)[None]
        with limited() as account:
            constraints.consistent(0.0, np.ones((1, count)), points)
        work.append(account.done)
    assert 1e4 < work[0] < work[1]
