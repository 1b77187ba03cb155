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
