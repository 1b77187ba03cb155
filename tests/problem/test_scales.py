"""Intervals with a scale: what they mean, how they travel, and what is refused."""

import math
import pickle

import numpy as np
import pytest
import scipy.stats
import sympy as sp

import rankone as ro
from rankone.solvers.request import Domain
from rankone.solvers.verification.points import check_points
from rankone.support.errors import OptionError, ProblemError

t, k = sp.symbols("t k")
u = sp.Function("u")(t)


def decay(interval):
    return ro.Problem([sp.Eq(u.diff(t), -k * u)], (t, 0, 2), {k: interval}, {u: 1})


@pytest.fixture(scope="module")
def solution():
    return ro.solve(decay((1e-2, 10, "log")), rtol=1e-6)


def mean_of_decay(density, lower, upper, time):
    """Mean of exp(-k t) under a density on an interval, by SciPy."""
    mass = scipy.integrate.quad(density, lower, upper)[0]
    return scipy.integrate.quad(lambda x: np.exp(-x * time) * density(x), lower, upper)[0] / mass


def test_statistics_are_in_the_logarithm(solution):
    exact = mean_of_decay(lambda x: 1 / x, 1e-2, 10, 1.5)
    assert abs(solution.mean(1.5)[0] - exact) < 1e-6
    assert abs(solution.quantile(0.5, 1.5)[0] - np.exp(-1.5 * math.sqrt(0.1))) < 1e-3
    below = np.mean(solution.sample(4000, seed=1)["k"] < 0.1)
    assert abs(below - 1 / 3) < 0.05


def test_statistics_are_in_the_reciprocal():
    solution = ro.solve(decay((0.1, 10, "reciprocal")), rtol=1e-6)
    assert abs(solution.mean(1.5)[0] - mean_of_decay(lambda x: x**-2, 0.1, 10, 1.5)) < 1e-6


def test_log_is_loguniform(solution):
    same = ro.solve(decay(scipy.stats.loguniform(1e-2, 10)), rtol=1e-6)
    assert np.array_equal(same.mean(1.0), solution.mean(1.0))
    assert same.metadata.distributions == solution.metadata.distributions


@pytest.mark.slow
def test_it_is_shown(solution, tmp_path):
    assert "k in [0.01, 10] (log)" in repr(decay((1e-2, 10, "log")))
    assert "k in [0.01, 10] (log)" in repr(solution)
    assert "k in [0.1, 1] (reciprocal)" in repr(ro.compile(decay((0.1, 1, "reciprocal"))))
    exported = ro.compile(decay((1e-2, 10, "log"))).export(tmp_path / "solver.py")
    assert "k in [0.01, 10] (log)" in exported.read_text()
    model = solution.export(tmp_path / "model.py")
    assert "k in [0.01, 10.0] (log)" in model.read_text()


@pytest.mark.parametrize("word", ["log", "reciprocal"])
def test_it_survives_pickling_and_files(word, tmp_path):
    problem = decay((0.3, 0.7, word))
    again = pickle.loads(pickle.dumps(problem))
    assert again.parameters == problem.parameters
    assert again.distributions == problem.distributions
    solved = ro.solve(problem, rtol=1e-4)
    solved.save(tmp_path / "u.npz")
    loaded = ro.load(tmp_path / "u.npz")
    assert np.array_equal(loaded.mean(1.0), solved.mean(1.0))
    assert f"({word})" in repr(loaded)


def test_text_and_toml(tmp_path):
    texts = {"rhs": {"u": "-k*u"}, "initial": {"u": 1.0}, "time": (0.0, 2.0)}
    problem = ro.Problem.from_strings(**texts, parameters={"k": (1e-2, 10, "log")})
    assert dict(problem.distributions) == {"k": "loguniform(0.01, 10.0)"}
    file = tmp_path / "decay.toml"
    file.write_text(
        'time = [0, 2]\nrhs = {u = "-k*u"}\ninitial = {u = 1}\n'
        'parameters = {k = [1e-2, 10, "log"]}\n'
    )
    from rankone.share.commands.common import load_problem

    assert load_problem(file).distributions == problem.distributions


def test_another_box(solution):
    compiled = ro.compile(decay((1e-2, 10, "log")))
    narrower = compiled.solve(1e-5, parameters={k: (0.1, 1)})  # a scale stays
    assert abs(narrower.mean(1.5)[0] - mean_of_decay(lambda x: 1 / x, 0.1, 1, 1.5)) < 1e-5
    wider = compiled.solve(1e-5, parameters={k: (1e-3, 20)})
    assert abs(wider.mean(1.5)[0] - mean_of_decay(lambda x: 1 / x, 1e-3, 20, 1.5)) < 1e-5
    plain = compiled.solve(1e-5, parameters={k: (0.1, 1, "linear")})
    assert abs(plain.mean(1.5)[0] - mean_of_decay(lambda x: 1, 0.1, 1, 1.5)) < 1e-5
    given = ro.compile(decay((0.1, 1))).solve(1e-5, parameters={"k": (0.1, 1, "log")})
    assert abs(given.mean(1.5)[0] - narrower.mean(1.5)[0]) < 2e-5


@pytest.mark.parametrize("word", ["log", "reciprocal"])
@pytest.mark.parametrize("interval", [(-1.0, 1.0), (-2.0, -1.0)])
def test_a_scale_is_dropped_on_an_interval_that_it_cannot_have(word, interval):
    solution = ro.compile(decay((1e-2, 10, word))).solve(1e-5, parameters={k: interval})
    assert solution.metadata.distributions == ()
    assert f"({word})" not in repr(solution)
    exact = mean_of_decay(lambda x: 1, *interval, 1.5)
    assert abs(solution.mean(1.5)[0] - exact) < 1e-5 * np.exp(2 * 2)


def test_engines_see_the_scale():
    def scales(interval):
        return Domain.of(ro.compile(decay(interval)).system).scales

    assert scales((1, 2)) == ("linear",)
    assert scales((1, 2, "log")) == ("log",)
    assert scales((1, 2, "reciprocal")) == ("reciprocal",)
    assert scales(scipy.stats.lognorm(0.3)) == ("log",)
    assert scales(scipy.stats.lognorm(0.3, loc=1.0)) == ("linear",)
    assert scales(scipy.stats.norm(5, 0.1)) == ("linear",)
    domain = Domain.of(ro.compile(decay((1, 2, "log"))).system)
    assert domain.moved(["k"], {"k": (3, 4)}).scales == ("log",)
    assert domain.moved(["k"], {"k": (-1, 4)}).scales == ("linear",)


def test_check_points_of_a_lognormal_are_even_in_the_logarithm():
    domain = Domain.of(ro.compile(decay(scipy.stats.lognorm(0.3))).system)
    points = check_points(domain.bounds, 96, scales=domain.coordinates)[3:, 0]
    lower, upper = np.log(domain.box[0])
    shares = (np.log(np.sort(points)) - lower) / (upper - lower)
    assert np.abs(shares - (np.arange(96) + 0.5) / 96).max() < 0.02


@pytest.mark.parametrize(
    ("interval", "message"),
    [
        ((1, 2, "lg"), r"scale of parameter `k` is 'lg' \(did you mean `log`\?\)"),
        ((1, 2, "root"), "`k` is 'root'; remedy: write 'linear', 'log' or 'reciprocal'"),
        ((0, 2, "log"), r"parameter `k` is 'log', but its interval \(0, 2\) is not above zero"),
        ((-1, 2, "reciprocal"), r"`k` is 'reciprocal', but its interval \(-1, 2\) is not above"),
    ],
)
def test_what_is_no_scale(interval, message):
    with pytest.raises(ProblemError, match=message):
        decay(interval)
    with pytest.raises(OptionError, match=message):
        ro.compile(decay((1, 2))).solve(parameters={k: interval})


@pytest.mark.slow
def test_the_exported_solver_knows_scales(tmp_path):
    import importlib.util

    path = ro.compile(decay((1e-2, 10, "log"))).export(tmp_path / "solver.py")
    spec = importlib.util.spec_from_file_location("exported_with_scale", path)
    solver = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(solver)
    assert solver.SYSTEM.scales == ("log",)
    moved = solver.solve(1e-4, parameters={"k": (0.1, 1, "reciprocal")})
    assert moved.metadata.distributions == (("k", "truncpareto(1.0, 10.0, 0.0, 0.1)"),)


def test_main_effects_and_plots_are_on_the_scale(solution):
    pyplot = pytest.importorskip("matplotlib.pyplot")
    from rankone import plotting

    effects = solution.main_effects(1.0, count=4)
    assert np.allclose(effects.values["k"], [1e-2, 0.1, 1.0, 10.0])
    axes = plotting.plot_surface(solution, x="t", y="k")
    assert (axes.get_xscale(), axes.get_yscale()) == ("linear", "log")
    axes = plotting.plot_main_effects(solution, t=1.0)
    assert np.allclose(np.diff(axes.get_lines()[0].get_xdata(), n=2), 0.0)
    pyplot.close("all")


def test_the_slider_of_the_page_is_on_the_scale(solution, tmp_path):
    import json
    import re

    page = solution.explore(tmp_path / "page.html").read_text()
    (data,) = re.findall(r'"parameters": ?(\[\{.*?\}\])', page)
    (parameter,) = json.loads(data)
    assert parameter["scale"] == "log"
    assert parameter["distribution"] == "(log)"
    assert abs(parameter["median"] - math.sqrt(0.1)) < 1e-3
