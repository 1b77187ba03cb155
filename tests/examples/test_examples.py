"""Every example runs, and its solution agrees with independent trajectories."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

import examples
import rankone as ro
from rankone.problem_files import load_problem
from tests.problems import EXAMPLES, GENERAL, SAMPLED
from tests.reference.measure import measured_errors
from tests.reference.systems import INDEPENDENT

ALL = EXAMPLES | GENERAL | SAMPLED
FOLDER = Path(next(iter(examples.__path__)))


def test_every_file_is_tested():
    files = {path.stem for path in FOLDER.glob("*.py")}
    assert files == {example.__name__.split(".")[-1] for example in ALL.values()}


@pytest.mark.parametrize("name", ALL)
def test_solution(name):
    example = ALL[name]
    solution = ro.solve(example.problem, rtol=example.RTOL)
    errors = measured_errors(solution, INDEPENDENT[name])
    assert solution.success, solution.message
    assert np.all(errors <= 5.0 * example.RTOL), errors


@pytest.mark.parametrize("name", GENERAL)
def test_solution_by_lifting(name):
    """The separated engine takes them with functions of the unknowns as further unknowns."""
    solution = ro.solve(GENERAL[name].problem, rtol=1e-5, method="train")
    errors = measured_errors(solution, INDEPENDENT[name])[: len(solution.unknowns)]
    assert solution.success, solution.message
    assert np.all(errors <= 5e-5), errors


@pytest.mark.parametrize("name", ALL)
def test_main(name, capsys):
    ALL[name].main()
    printed = capsys.readouterr().out
    assert printed.startswith("Solution")
    assert "success   yes" in printed


def test_toml_is_the_same_problem():
    path = FOLDER / "lotka_volterra.toml"
    problem = load_problem(path)
    wanted = EXAMPLES["lotka_volterra"].problem
    assert problem.residuals == wanted.residuals
    assert problem.coordinates == wanted.coordinates
    assert problem.name == wanted.name == tomllib.loads(path.read_text())["name"]
