"""Results print as tables, also in notebooks, and become tables of pandas and data sets."""

import functools
import html

import numpy as np
import pytest

import rankone as ro
from tests.inference.estimation.systems import decay

TIMES = np.linspace(0.1, 2, 12)
DATA = 2.0 * np.exp(-1.3 * TIMES) + 0.02 * np.random.default_rng(0).standard_normal(12)


@functools.cache
def results():
    fit = decay().fit(TIMES, DATA, sigma=0.02)
    return {
        "sobol": decay().sobol([0.5, 1.0, 1.5, 2.0]),
        "density": decay().density(1.0),
        "effects": decay().main_effects([0.5, 1.0], count=5),
        "probability": decay().probability([0.5, 1.0], above=0.5, below=1.0),
        "risk": decay().probability(1.0, above=0.5),
        "fit": fit,
        "posterior": ro.posterior(fit),
        "optimum": decay().minimize("u", t=1.0, fixed={"a": 1}),
        "design": decay().design(2, after=fit),
    }


@pytest.mark.parametrize(
    ("name", "lines"),
    [
        ("sobol", ["Sobol indices of u at 4 times", "unknown  parameter  first at 0.5"]),
        ("density", ["Density of u", "peak", "97.5 %"]),
        ("effects", ["Means of u given one parameter", "u        k           0.5 ", " at 0.2"]),
        ("probability", ["Probability of 0.5 < u < 1", "time  probability", "0.5   "]),
        ("risk", ["Probability of u > 0.5", "1    "]),
        ("fit", ["Fit to 12 values of u: chi2", "parameter  estimate", "success: "]),
        ("posterior", ["Posterior of k, a by quadrature", "parameter", "95 % interval"]),
        ("optimum", ["Optimum: 0.0183", "parameter  best", "fixed: a = 1"]),
        ("design", ["D-optimal design: 2 times", "expected std"]),
    ],
)
def test_printed(name, lines):
    result = results()[name]
    for line in lines:
        assert line in repr(result)
    page = result._repr_html_()
    assert page.startswith("<table>")
    assert html.escape(lines[0]) in page


def test_a_table_of_sobol_indices():
    pytest.importorskip("pandas")
    sobol = results()["sobol"]
    rows = sobol.to_dataframe()
    assert rows.index.names == ["unknown", "parameter", "time"]
    assert rows.loc[("u", "k", 1.0), "first"] == sobol.first[0, 0, 1]
    widths = ["first_half_width", "total_half_width"]
    assert list(rows.columns) == ["first", "total", *widths]


def test_effects_and_probabilities_as_tables():
    pytest.importorskip("pandas")
    effects, probability = results()["effects"], results()["probability"]
    rows = effects.to_dataframe()
    assert rows.index.names == ["parameter", "unknown", "position", "time"]
    assert rows.loc[("k", "u", 1.0, 1.0), "value"] == decay().parameters["k"][1]
    assert rows.loc[("a", "u", 0.5, 0.5), "mean"] == effects.means["a"][0, 2, 0]
    assert effects.to_xarray().sizes["position"] == 5
    frame = probability.to_dataframe()
    assert frame.loc[1.0, "probability"] == probability.value[1]
    assert len(results()["risk"].to_dataframe()) == 1
    steady = ro.steady_state(
        ro.Problem.from_strings({"x": "a - x"}, {"x": "0"}, {"a": (1, 2)}, (0, 10))
    )
    timeless = steady.probability(above=1.5)
    assert timeless.to_dataframe()["probability"][0] == pytest.approx(0.5, abs=0.01)
    assert "Probability of x > 1.5" in repr(timeless)
    assert steady.main_effects(count=3).to_dataframe().index.names[-1] == "position"
    assert "1.5 at 1.5" in repr(steady.main_effects(count=3))


def test_data_sets():
    pytest.importorskip("xarray")
    sobol, fit = results()["sobol"], results()["fit"]
    second = sobol.to_xarray().second.sel(unknown="u", parameter="k", other="a", time=0.5)
    assert float(second) == sobol.second[0, 0, 1, 0]
    np.testing.assert_array_equal(fit.to_xarray().covariance, fit.covariance)
    gain = results()["design"].to_xarray().gain
    assert gain.sizes == {"time": 201}


def test_estimates_as_a_table():
    pytest.importorskip("pandas")
    for name in ("fit", "posterior"):
        result = results()[name]
        rows = result.to_dataframe()
        low, high = result.interval()["k"]
        assert list(rows.index) == ["k", "a"]
        assert (rows.loc["k", "lower"], rows.loc["k", "upper"]) == (low, high)
    density = results()["density"]
    np.testing.assert_array_equal(density.to_dataframe()["density"], density.density)
    assert density.quantile(0.5) == pytest.approx(float(decay().quantile(0.5, 1.0)[0]), rel=0.02)
