"""Statistics of fields compared with those of many points, and of plain solutions of entries."""

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from tests.solution.fields.small_fields import N, R, orthonormal_modes, small_fields

V = orthonormal_modes()
TIMES = [0.3, 1.0]


@pytest.fixture(scope="module")
def solution():
    return small_fields()


@pytest.fixture(scope="module")
def entries(solution):
    """Entries 3 and 17 and the scalar unknown, as outputs of the coefficients."""
    t = sp.Symbol("t")
    a = [sp.Function(f"u_{i}")(t) for i in range(R)]
    expressions = {f"u{k}": sum(float(V[k, i]) * a[i] for i in range(R)) for k in (3, 17)}
    return solution.coefficients.output({**expressions, "w": sp.Function("w")(t)}, rtol=1e-6)


def test_means_and_variances_are_those_of_the_entries(solution, entries):
    mean, var = solution.mean(TIMES), solution.var(TIMES)
    assert mean.shape == var.shape == (N + 1, 2)
    assert mean[[3, 17, N]] == pytest.approx(entries.mean(TIMES), rel=1e-5)
    assert var[[3, 17, N]] == pytest.approx(entries.var(TIMES), rel=1e-4)
    assert solution.std(TIMES) == pytest.approx(np.sqrt(var), rel=1e-12)
    assert solution["u"].mean(0.3) == pytest.approx(mean[:N, 0], rel=1e-12)
    assert solution["u"][17].std(TIMES) == pytest.approx(np.sqrt(var[17]), rel=1e-10)
    assert solution["w"].var(0.3).shape == ()


def test_statistics_of_other_distributions(solution, entries):
    from scipy.stats import norm

    under = {"k": norm(1.2, 0.2)}
    expected = entries.mean(TIMES, under=under)[:2]
    assert solution["u"][[3, 17]].mean(TIMES, under=under) == pytest.approx(expected, rel=1e-5)
    correlated = {("k", "s"): 0.5}
    expected = entries.std(TIMES, correlation=correlated)[:2]
    chosen = solution["u"][[3, 17]].std(TIMES, correlation=correlated)
    assert chosen == pytest.approx(expected, rel=1e-4)


def test_covariances_of_chosen_entries(solution, entries):
    chosen = solution["u"].entries([3, 17]).cov(TIMES)
    assert chosen == pytest.approx(entries.cov(TIMES)[:2, :2], rel=1e-4)
    assert solution["u"].reshape(6, 10).cov(0.3).shape == (6, 10, 6, 10)


def test_covariances_of_many_entries_are_refused(solution, monkeypatch):
    monkeypatch.setattr("rankone.solution.fields.field_statistics._MOST_COVARIANCES", 1000)
    with pytest.raises(ro.EvaluationError, match="covariances of 60 entries"):
        solution["u"].cov(0.3)


def test_sobol_indices_are_those_of_the_entries(solution, entries):
    expected = entries.sobol(TIMES)
    indices = solution["u"][[3, 17]].sobol(TIMES)
    assert indices.first.shape == (2, 2, 2)
    assert indices.first == pytest.approx(expected.first[:2], abs=1e-4)
    assert indices.total == pytest.approx(expected.total[:2], abs=1e-4)
    every = solution.sobol(TIMES)
    assert every["u"].first[[3, 17]] == pytest.approx(indices.first, rel=1e-9)
    assert every["w"].first == pytest.approx(expected.first[2], abs=1e-4)
    assert (indices.total_half_width > 0.0).all()
    shares = indices.over_entries()[0]
    variance = solution["u"][[3, 17]].var(TIMES)
    mean = (indices.first * variance[:, None]).sum(axis=0) / variance.sum(axis=0)
    assert shares == pytest.approx(mean, rel=1e-10)
    assert "Sobol indices of u" in repr(indices)
    assert solution.at(0.3)["u"].sobol().first == pytest.approx(every["u"].first[..., 0], rel=1e-6)


def test_sobol_indices_by_symbols(solution):
    indices = solution.sobol(0.3)
    assert indices[ro.field("u", 60)] is indices["u"]
    for unknown in ("v", ro.field("v", 60)):
        with pytest.raises(ro.EvaluationError, match="no unknown `v`"):
            indices[unknown]


def test_sobol_indices_below_the_error_are_nan(solution):
    assert np.isnan(solution["w"].sobol(0.0).first).all()


def test_sobol_indices_need_independence(solution):
    with pytest.raises(ro.OptionError, match="correlated"):
        solution["u"].sobol(0.3, correlation={("k", "s"): 0.5})


def test_quantiles(solution, entries):
    chosen = solution["u"][[3, 17]].quantile([0.1, 0.5, 0.9], TIMES)
    expected = entries.quantile([0.1, 0.5, 0.9], TIMES)[:, :2]
    assert chosen.shape == (3, 2, 2)
    assert np.asarray(chosen) == pytest.approx(expected, abs=2e-3)
    assert chosen.half_width.shape == chosen.shape
    every = solution.quantile(0.5, 0.3)
    assert every.shape == (N + 1,)
    assert every[[3, 17]] == pytest.approx(chosen[1, :, 0], rel=1e-10)


def test_samples_are_of_the_parameters(solution):
    sample = solution.sample(7, seed=1)
    assert solution(t=0.3, **sample).shape == (N + 1, 7)


def test_indices_become_labelled(solution):
    pytest.importorskip("xarray")
    labelled = solution["u"].sobol(TIMES).to_xarray()
    assert labelled["first"].dims == ("entry", "parameter", "time")
    assert labelled.sizes["entry"] == N
