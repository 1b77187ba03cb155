"""Systems stated as text: conservation laws, right-hand sides, and LSODA against Radau."""

import numpy as np
import pytest
import scipy.integrate
import sympy as sp

import rankone as ro
from tests.reference.decades import DECADES
from tests.reference.kinetics import KINETICS
from tests.reference.relaxation import RELAXATION
from tests.reference.stated import Stated, reactions

STATED = {**RELAXATION, **KINETICS, **DECADES}
SLOW = {"carbon_bond", "coagulation", "activated_sludge"}
"""Those with many terms to sort."""
CONSERVED = {  # species whose sum no reaction changes, at most each with its number
    "pollu": [{f"y{i}": 1 for i in (1, 2, 13, 15, 19)} | {"y20": 2}, {"y17": 1, "y18": 1}],
    "huang_ferrell": [
        {"K": 1, "KE1": 1, "Kp": 1, "KpE2": 1, "MKp": 1, "MpKp": 1},
        {"R": 1, "RMpp": 1, "Rp": 1, "RpRP": 1, "RpMpp": 1, "Rpp": 1, "RppRP": 1},
        {"MP": 1, "MpMP": 1, "MppMP": 1},
    ],
    "growth_factor": [
        {"SOS": 1, "RGS": 1, "GS": 1, "RShGS": 1, "ShGS": 1},
        {"Shc": 1, "RSh": 1, "RShP": 1, "ShP": 1, "RShG": 1, "ShG": 1, "RShGS": 1, "ShGS": 1},
        {"PLC": 1, "RPL": 1, "RPLP": 1, "PLCP": 1, "PLCI": 1},
    ],
    "wnt": [{"X1": 1, "X2": 1}, {"X13": 1, "X14": 1}],
    "sites": [
        {"E": 1} | {f"S{i}E": 1 for i in range(5)},
        {"F": 1} | {f"S{i}F": 1 for i in range(1, 6)},
    ],
    "coagulation": [
        {"V": 1, "Va": 1, "XaVa": 1, "XaVaII": 1},
        {"IX": 1, "TFVIIaIX": 1, "IXa": 1, "IXaVIIIa": 1, "IXaVIIIaX": 1, "IXaAT": 1},
        {"II": 1, "IIa": 1, "XaVaII": 1, "mIIa": 1, "mIIaAT": 1, "IIaAT": 1},
    ],
    "clusters": [{f"c{r}": r for r in range(1, 21)}],
    "uranium_series": [dict.fromkeys(KINETICS["uranium_series"].rates, 1)],
}


def _states(system, seed=3):
    p = system.points(1)[0]
    return p, np.random.default_rng(seed).uniform(0.5, 1.5, len(system.rates))


def test_the_suites_have_the_sizes_that_they_promise():
    assert len(RELAXATION) >= 10
    assert len(KINETICS) == 12
    assert len(DECADES) == 15
    assert all(15 <= len(system.rates) <= 40 for system in KINETICS.values())
    for system in KINETICS.values():
        assert [hi / lo for lo, hi in system.parameters.values()] == pytest.approx([2.25] * 3)


def test_reactions_become_rates():
    rates = reactions("2 A + B = 0.5 C : k, back\nC -> D : v*C/(1 + C)", fixed=["D"])
    a, b, c, k, back, v = sp.symbols("A B C k back v")
    forth, backwards, saturated = k * a**2 * b, back * c ** sp.Float(0.5), v * c / (1 + c)
    expected = {
        "A": 2 * (backwards - forth),
        "B": backwards - forth,
        "C": (forth - backwards) / 2 - saturated,
    }
    assert set(rates) == set(expected)
    for name, rate in rates.items():
        assert sp.simplify(sp.sympify(rate) - expected[name]) == 0


@pytest.mark.parametrize("name", CONSERVED)
def test_moieties_are_conserved(name):
    system = KINETICS[name]
    p, states = _states(system)
    rates = dict(zip(system.rates, system.functions[0](0.0, states.tolist(), p), strict=True))
    for moiety in CONSERVED[name]:
        terms = [many * rates[species] for species, many in moiety.items()]
        assert abs(sum(terms)) <= 1e-12 * np.abs(terms).max()


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n not in SLOW else pytest.mark.slow) for n in STATED]
)
def test_rankone_is_given_the_rates_that_scipy_integrates(name):
    system = STATED[name]
    first = ro.first_order(system.problem())
    time, *parameters = (coordinate.symbol for coordinate in first.coordinates)
    rhs = sp.lambdify([time, first.functions, parameters], first.rhs, "math", cse=True)
    p, states = _states(system)
    order = [state.name for state in first.states]
    assert set(order) == set(system.rates)
    by_name = dict(zip(system.rates, states, strict=True))
    ours = rhs(0.0, [by_name[state] for state in order], p)
    theirs = dict(zip(system.rates, system.functions[0](0.0, states.tolist(), p), strict=True))
    for state, rate in zip(order, ours, strict=True):
        assert rate == pytest.approx(theirs[state], rel=1e-8, abs=1e-12 * max(states))


@pytest.mark.slow
@pytest.mark.parametrize("name", STATED)
def test_the_trajectories_are_those_of_radau(name):
    system = STATED[name]
    p, times = system.points(1)[0], np.linspace(0.0, system.end, 6)
    states = system.trajectory(p, times)
    rhs, initial = system.functions
    size = np.abs(states).max(axis=1)
    smallest = np.abs(states).min(axis=1, where=states != 0.0, initial=np.inf)
    second = scipy.integrate.solve_ivp(
        lambda t, u: rhs(t, u.tolist(), p.tolist()),
        (0.0, system.end),
        initial(p.tolist()),
        method="Radau",
        t_eval=times,
        rtol=1e-6,
        atol=1e-5 * np.minimum(smallest, 1e-4 * size),
    )
    assert second.success
    assert np.all(np.abs(states - second.y) <= 3e-5 * size[:, None])


def test_points_see_every_decade():
    system = Stated("", "", {"x": "-k*x"}, {"x": 1.0}, {"k": (1e-4, 1.0)}, 1.0)
    points = system.points(400)[:, 0]
    assert points.min() >= 1e-4
    assert points.max() <= 1.0
    for lower in (1e-4, 1e-3, 1e-2, 1e-1):
        assert np.count_nonzero((points >= lower) & (points < 10.0 * lower)) >= 30
