"""The examples of many states, at a small size, against trajectories and with their pictures."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rankone as ro

pytest.importorskip("matplotlib")

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "examples" / "fields"
SIZES = {"brusselator": 3, "truss": 1}  # Entry by entry
FIELDS = {"heat": 80, "convection": 10, "epidemic": 64, "beam": 1}


@pytest.fixture
def script(monkeypatch):
    """Import a script as it runs: its own folder first on the path."""
    monkeypatch.syspath_prepend(str(FOLDER))
    yield importlib.import_module
    import matplotlib.pyplot as plt

    plt.close("all")
    for name in ("common", *SIZES, *FIELDS):
        sys.modules.pop(name, None)


def test_every_script_has_its_picture_in_the_docs():
    scripts = {path.stem for path in FOLDER.glob("*.py")} - {"common"}
    assert scripts == {*SIZES, *FIELDS}
    text = (ROOT / "docs" / "guide" / "fields.md").read_text()
    for name in scripts:
        picture = ROOT / "docs" / "guide" / "fields" / f"{name}.png"
        assert picture.stat().st_size <= 120_000
        assert f"(fields/{name}.png)" in text


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) for n in SIZES])
def test_solution_and_picture(name, script, monkeypatch, capsys):
    """States, or what is kept of them, against a trajectory of SciPy."""
    module, solutions, solve = script(name), [], ro.CompiledProblem.solve

    def recorded(*arguments, **options):
        solutions.append(solve(*arguments, **options))
        return solutions[-1]

    monkeypatch.setattr(ro.CompiledProblem, "solve", recorded)
    figure = module.draw(SIZES[name])
    (solution,) = solutions
    assert capsys.readouterr().out.startswith(repr(solution))
    assert solution.success
    assert solution.rtol == module.RTOL
    point = {p: 0.3 * a + 0.7 * b for p, (a, b) in solution.parameters.items()}
    times = np.linspace(0, module.END, 9)
    system = ro.compile(module.problem(SIZES[name])).system
    p = np.array(list(point.values()))[:, None]
    exact = solve_ivp(
        lambda t, u: system.rhs(t, u[:, None], p)[:, 0],
        (0, module.END),
        system.initial(p)[:, 0],
        method="LSODA",
        rtol=1e-9,
        atol=1e-12,
        t_eval=times,
    ).y[: len(system.unknowns)]
    if name == "truss":
        exact = exact[: len(exact) // 2]  # without velocities
    ours = np.atleast_2d(solution(times, point))
    size = np.abs(exact).max(axis=1, keepdims=True)
    size[size == 0.0] = 1.0  # a tower of one storey stands still in the middle
    assert (np.abs(ours - exact) / size).max() <= 5 * module.RTOL
    assert figure.axes


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) for n in FIELDS])
def test_fields_and_picture(name, script, monkeypatch, capsys):
    """All entries of all fields against a trajectory of SciPy."""
    if name == "beam":
        pytest.importorskip("skfem")
    module, solutions, solve = script(name), [], ro.CompiledFields.solve

    def recorded(*arguments, **options):
        solutions.append(solve(*arguments, **options))
        return solutions[-1]

    monkeypatch.setattr(ro.CompiledFields, "solve", recorded)
    figure = module.draw(FIELDS[name])
    (solution,) = solutions
    assert capsys.readouterr().out.startswith(repr(solution))
    assert solution.success
    assert solution.rtol == module.RTOL
    assert solution.modes.trajectories <= 100
    point = {p: 0.3 * a + 0.7 * b for p, (a, b) in solution.parameters.items()}
    times = np.linspace(0, module.END, 9)
    system = ro.compile(module.problem(FIELDS[name])).system
    own = system.at(np.array(list(point.values())))
    mass = np.eye(system.size) if system.mass is None else system.mass.toarray()
    inverse = np.linalg.inv(mass)
    exact = solve_ivp(
        lambda t, u: inverse @ own.force(t, u),
        (0, module.END),
        system.initial(np.array(list(point.values()))),
        method="Radau",
        jac=lambda t, u: inverse @ own.jacobian(t, u).toarray(),
        rtol=1e-7,
        atol=1e-9,
        t_eval=times,
    ).y
    ours = solution(times, point)
    for unknown in system.unknowns:
        if unknown.rows.stop <= len(ours):
            errors = np.abs(ours[unknown.rows] - exact[unknown.rows])
            assert errors.max() <= 2 * module.RTOL * np.abs(exact[unknown.rows]).max()
    assert figure.axes


def test_the_beam_says_what_to_install(script, monkeypatch):
    monkeypatch.setitem(sys.modules, "skfem", None)
    with pytest.raises(SystemExit, match="pip install scikit-fem"):
        script("beam")


def test_a_beam_that_turns_has_no_stress(script):
    """A turn as a whole is no strain, which linear elasticity does not know."""
    pytest.importorskip("skfem")
    beam = script("beam")
    body = beam.assembled(1)
    x, y = body.places.T
    turned = np.stack([np.cos(0.5) * x - np.sin(0.5) * y, np.sin(0.5) * x + np.cos(0.5) * y], 1)
    u = (turned - body.places).ravel()
    h = [[body.gradients[i][j] @ u for j in (0, 1)] for i in (0, 1)]
    symbols = beam.sp.Matrix(2, 2, beam.sp.symbols("h:4"))
    stress = beam.sp.lambdify([*symbols], list(beam.stresses(symbols)))
    point = [h[0][0][-1], h[0][1][-1], h[1][0][-1], h[1][1][-1]]  # at the tip, free of the clamp
    assert np.abs(stress(*point)).max() < 1e-12
    linear = beam.sp.lambdify([*symbols], list(beam.stresses(symbols, large=False)))
    assert np.abs(linear(*point)).max() > 0.1
