"""Parameters over decades: the coordinate that cross takes, and everything that reads it."""

import functools

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import loguniform

import rankone as ro
from rankone.solution.storage import contents as header
from rankone.support.errors import StorageError
from rankone.tensors import IDENTITY, Logarithm


@functools.cache
def relaxation():
    """x' = m - k x from a: linear in m and a; k over four decades."""
    problem = ro.Problem.from_strings(
        rhs={"x": "m - k*x"},
        initial={"x": "a"},
        parameters={"k": (1e-3, 10.0), "m": (0.5, 1.0), "a": (1e-6, 1e-2)},
        time=(0, 5),
    )
    return ro.solve(problem, rtol=1e-5, method="cross")


def exact(t, k, m, a):
    return a * np.exp(-k * t) + m * -np.expm1(-k * t) / k


def points(count=300, seed=0):
    draw = np.random.default_rng(seed)
    return {
        "t": draw.uniform(0.0, 5.0, count),
        "k": 10.0 ** draw.uniform(-3.0, 1.0, count),
        "m": draw.uniform(0.5, 1.0, count),
        "a": 10.0 ** draw.uniform(-6.0, -2.0, count),
    }


def test_epidemic_from_few_infected():
    """Linear in i0 this took ten times the trajectories, and did not converge."""
    parameters = {"b": (0.3, 0.6), "i0": (1e-6, 1e-2)}
    problem = ro.Problem.from_strings(
        rhs={"s": "-b*s*i", "i": "b*s*i - 0.2*i"},
        initial={"s": "1 - i0", "i": "i0"},
        parameters=parameters,
        time=(0, 40),
    )
    solution = ro.solve(problem, rtol=1e-3, method="cross")
    assert solution.success
    by_name = dict(zip(parameters, solution.outcome.slabs[0].bases, strict=True))
    assert by_name["i0"].scale == Logarithm()
    assert solution.nodes[1] < 30
    times = np.linspace(0.0, 40.0, 21)
    for b, i0 in [(0.3, 1e-6), (0.6, 1e-6), (0.45, 3e-6), (0.55, 1e-4), (0.4, 1e-2)]:
        trajectory = solve_ivp(
            lambda _, u, b=b: [-b * u[0] * u[1], b * u[0] * u[1] - 0.2 * u[1]],
            (0.0, 40.0),
            [1.0 - i0, i0],
            method="LSODA",
            rtol=1e-9,
            atol=1e-12,
            t_eval=times,
        )
        sizes = [[1.0], [0.3]]
        assert (np.abs(solution(t=times, b=b, i0=i0) - trajectory.y) / sizes).max() < 5e-3


def test_parameters_take_different_coordinates():
    bases = relaxation().outcome.slabs[0].bases
    assert [basis.scale for basis in bases] == [Logarithm(), IDENTITY, IDENTITY]
    at = points()
    assert relaxation()["x"](**at) == pytest.approx(exact(**at), abs=1e-4)


def test_derivatives_are_those_of_the_parameter():
    at, solution = points(), relaxation()
    gradient = solution.gradient(**at)[0]
    for j, name in enumerate(("k", "m", "a")):
        up, down = (dict(at) | {name: at[name] * (1.0 + h)} for h in (1e-6, -1e-6))
        slope = (exact(**up) - exact(**down)) / (up[name] - down[name])
        assert gradient[j] == pytest.approx(slope, abs=5e-3 * np.abs(slope).max())
        assert solution.diff(name)(**at)[0] == pytest.approx(gradient[j], rel=1e-9, abs=1e-12)


def test_smaller_solutions():
    at, solution = points(), relaxation()
    fixed = solution.fix(k=0.02)
    expected = solution(**at | {"k": 0.02})
    assert fixed(t=at["t"], m=at["m"], a=at["a"]) == pytest.approx(expected, abs=1e-12)
    inside = at | {"k": np.clip(at["k"], 0.01, 1.0)}
    part = solution.restrict(k=(0.01, 1.0))
    assert part.outcome.slabs[0].bases[0].scale == Logarithm()
    assert part(**inside) == pytest.approx(solution(**inside), abs=1e-11)


def test_statistics_in_the_parameter_and_in_its_logarithm():
    shares = (np.arange(200_000) + 0.5) / 200_000
    solution = relaxation()
    for under, k in (
        ({}, 1e-3 + (10.0 - 1e-3) * shares),
        ({"k": loguniform(1e-3, 10.0)}, 10.0 ** (4.0 * shares - 3.0)),
    ):
        a = 0.5 * (1e-6 + 1e-2)
        of_m, of_a = -np.expm1(-3.0 * k) / k, np.exp(-3.0 * k)
        middle = a * of_a + 0.75 * of_m
        variance = middle.var() + np.mean(of_m**2) * 0.25 / 12 + np.mean(of_a**2) * 1e-4 / 12
        assert solution.mean([3.0], under=under)[0, 0] == pytest.approx(middle.mean(), abs=2e-5)
        assert solution.var([3.0], under=under)[0, 0] == pytest.approx(variance, rel=1e-4)


def test_canonical_form():
    solution = relaxation()
    form = solution.to_canonical(1e-7)["x"]
    assert form.axes[1].scale == Logarithm()
    assert form.weights["k"].sum() == pytest.approx(1.0, abs=1e-12)
    assert form.weights["k"] @ form.nodes["k"] == pytest.approx(0.5 * (1e-3 + 10.0), rel=1e-12)
    squares = form.weights["k"] @ form.factors["k"] ** 2
    assert squares == pytest.approx(np.ones(form.rank), abs=1e-12)
    at = points()
    assert form(**at) == pytest.approx(solution["x"](**at), abs=2e-5)


def test_outputs_take_the_same_coordinates():
    output = relaxation().output({"y": "x**2*k"})
    assert output.success
    assert output.outcome.slabs[0].bases[0].scale == Logarithm()
    at = points()
    assert output["y"](**at) == pytest.approx(exact(**at) ** 2 * at["k"], abs=2e-3)


@pytest.mark.parametrize("name", ["scaled.npz", "scaled.nc"])
def test_files_of_scaled_solutions_are_refused_by_older_readers(name, tmp_path, monkeypatch):
    if name.endswith(".nc"):
        pytest.importorskip("h5netcdf")
    path = relaxation().save(tmp_path / name)
    again, at = ro.load(path), points()
    np.testing.assert_array_equal(again(**at), relaxation()(**at))
    assert again.outcome.slabs[0].bases == relaxation().outcome.slabs[0].bases
    monkeypatch.setattr(header, "FORMAT_VERSION", 1)
    with pytest.raises(StorageError, match=r"version 2 of the format.*upgrade rankone"):
        ro.load(path)


def test_a_scale_that_is_given_is_looked_at_first():
    """Where another coordinate is no better, it stays."""
    problem = ro.Problem.from_strings(
        rhs={"x": "-k*x"},
        initial={"x": "1"},
        parameters={"k": (1.0, 2.0, "log")},
        time=(0, 1),
    )
    solution = ro.solve(problem, rtol=1e-4, method="cross")
    assert solution.outcome.slabs[0].bases[0].scale == Logarithm()
