"""Every example runs, and its solution agrees with independent trajectories."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

import examples
import rankone as ro
from rankone.share.commands.common import load_problem
from tests.problems import EXAMPLES, GENERAL, SAMPLED
from tests.reference.measure import measured_errors
from tests.reference.systems import INDEPENDENT

ALL = EXAMPLES | GENERAL | SAMPLED
FOLDER = Path(next(iter(examples.__path__)))


def test_every_file_is_tested():
    files = {path.stem for path in FOLDER.glob("*.py")}
    assert files == {example.__name__.split(".")[-1] for example in ALL.values()}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(n, marks=pytest.mark.slow if n == "robertson" else ())
        for n in EXAMPLES | GENERAL
    ],
)
def test_main(name, capsys, monkeypatch):
    """What it prints is a solution that agrees; that of the falling card has tests of its own."""
    solutions, solve = [], ro.CompiledProblem.solve

    def recorded(*arguments, **options):
        solutions.append(solve(*arguments, **options))
        return solutions[-1]

    monkeypatch.setattr(ro.CompiledProblem, "solve", recorded)
    ALL[name].main()
    assert capsys.readouterr().out.startswith(repr(solutions[0]))
    asked = {name: ALL[name].RTOL}
    if name == "kirchhoff":
        asked["kirchhoff_long"] = ALL[name].RTOL_LONG
    for solution, (system, rtol) in zip(solutions, asked.items(), strict=True):
        assert solution.success, solution.message
        assert solution.rtol == rtol
        errors = measured_errors(solution, INDEPENDENT[system])
        assert np.all(errors <= 5.0 * rtol), errors


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n == "projectile" else ()) for n in GENERAL]
)
def test_solution_by_lifting(name):
    """The separated engine takes them with functions of the unknowns as further unknowns."""
    solution = ro.solve(GENERAL[name].problem, rtol=1e-4, method="train")
    errors = measured_errors(solution, INDEPENDENT[name])[: len(solution.unknowns)]
    assert solution.success, solution.message
    assert np.all(errors <= 5e-4), errors


def test_toml_is_the_same_problem():
    path = FOLDER / "lotka_volterra.toml"
    problem = load_problem(path)
    wanted = EXAMPLES["lotka_volterra"].problem
    assert problem.residuals == wanted.residuals
    assert problem.coordinates == wanted.coordinates
    assert problem.name == wanted.name == tomllib.loads(path.read_text())["name"]
