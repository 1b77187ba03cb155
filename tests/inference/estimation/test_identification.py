"""Combinations that data identify, by name."""

import numpy as np
import pytest

import rankone as ro

TIMES = np.linspace(0.1, 2.0, 12)
A = {"a": (0.5, 2), "b": (0.5, 2)}


def fitted(rate, box, initial="1", sigma=0.01, **values):
    solution = ro.solve(ro.Problem.from_strings({"u": rate}, {"u": initial}, box, (0, 2)), 1e-7)
    data = solution["u"](TIMES, values) + np.random.default_rng(3).normal(0, sigma, TIMES.size)
    return solution.fit(TIMES, data, sigma=sigma)


@pytest.mark.parametrize(
    ("rate", "wanted"),
    [
        ("-a*b*u", "a*b"),
        ("-a*b**2*u", "a*b**2"),
        ("-a/b*u", "a/b"),
        ("-sqrt(a)/b*u", "a/b**2"),
        ("-(a + b)*u", "a + b"),
        ("-(a + 2*b)*u", "a + 2*b"),
    ],
)
def test_of_two(rate, wanted):
    fit = fitted(rate, A, a=1.0, b=0.9)
    assert fit.combinations == (wanted,)
    assert not any(fit.identifiable.values())
    truth = eval(wanted, {"a": 1.0, "b": 0.9})
    low, high = fit.interval_of(wanted, 0.9999)
    assert low < truth < high
    assert high - low < 0.2 * truth


def test_of_four_parameters():
    box = {**A, "c": (0.5, 2), "k": (0.2, 2)}
    fit = fitted("a*b/c - k*u", box, a=1.0, b=1.1, c=0.9, k=0.8)
    assert fit.identifiable == {"a": False, "b": False, "c": False, "k": True}
    assert fit.combinations == ("a*b/c",)
    assert fit.std["k"] < 0.1
    assert "`a`, `b` and `c` alone, only `a*b/c`" in fit.message


@pytest.mark.filterwarnings("ignore::rankone.RankoneWarning")
def test_one_that_does_not_matter():
    fit = fitted("-a*u + 0*b", A, a=1.0, b=1.0)
    assert fit.identifiable == {"a": True, "b": False}
    assert "do not identify `b`;" in fit.message
    assert fit.combinations == ()


def test_all_are_identified():
    fit = fitted("a - b*u", A, a=1.2, b=0.8)
    assert fit.success, fit.message
    assert all(np.isfinite(list(fit.std.values())))


def test_of_either_sign():
    box = {"a": (-1, 1), "b": (-1, 1)}
    fit = fitted("a + b", box, "0", a=0.2, b=0.1)
    assert fit.combinations == ("a + b",)
    # a sum is constant along no part of a hyperbola
    product = fitted("a*b", box, "0", a=0.5, b=0.6)
    assert not any(product.identifiable.values())
    assert product.combinations in ((), ("a*b",))


def test_two_values_that_fit_as_well():
    fit = fitted("k**2", {"k": (-2, 2)}, "0", k=1.2)
    assert [abs(fit.x["k"]), abs(fit.others[0]["k"])] == pytest.approx([1.2, 1.2], abs=0.01)
    assert "other values fit as well: k = " in fit.message
    assert not fit.success


def two_doses():
    """The second dose comes at t = 1, into a volume V."""
    box = {"D1": (0, 4), "D2": (0, 4), "V": (0.5, 2), "k": (0.5, 2)}
    equations, initial = {"c": "-k*c"}, {"c": "D1/V"}
    problem = ro.Problem.from_strings(
        equations, initial, box, (0, 2), jumps={1.0: {"c": "c + D2/V"}}
    )
    return ro.solve(problem, 1e-6)


def test_a_dose_that_nobody_saw():
    """The message says of each parameter what the table says."""
    solution, times = two_doses(), TIMES[TIMES < 1.0]
    truth = {"D1": 2.0, "D2": 1.0, "V": 1.0, "k": 1.0}
    data = 2.0 * np.exp(-times) + np.random.default_rng(3).normal(0, 0.01, times.size)
    fit = solution.fit(times, data, sigma=0.01)
    assert fit.combinations == ("D1/V",)
    assert "do not identify `D1` and `V` alone, only `D1/V`; remedy: fix one of them" in fit.message
    assert "; the data do not identify `D2`; remedy" in fit.message
    late = solution["c"](TIMES, truth) + np.random.default_rng(4).normal(0, 0.01, TIMES.size)
    both = solution.fit(TIMES, late, sigma=0.01)
    assert len(both.combinations) == 2
    assert "`D1`, `D2` and `V` alone" in both.message
    assert "fix one of them" in both.message


def test_a_dose_of_zero_ends_at_its_bound():
    """The search stands at the bound, and not at a jump of the likelihood."""
    data = np.exp(-TIMES) * (2.0 - 0.02 * (TIMES > 1.0))
    fit = two_doses().fit(TIMES, data, sigma=0.01)
    assert fit.at_bounds["D2"] == "lower"
    assert fit.x["D2"] == 0.0
    assert fit.converged
    assert not fit.stuck
