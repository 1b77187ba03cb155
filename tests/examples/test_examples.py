"""Every example runs, and its solution agrees with independent trajectories."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

import examples
import rankone as ro
from rankone.problem_files import load_problem
from tests.problems import EXAMPLES
from tests.reference.measure import measured_errors
from tests.reference.systems import INDEPENDENT

FOLDER = Path(next(iter(examples.__path__)))


def test_every_file_is_tested():
    files = {path.stem for path in FOLDER.glob("*.py")}
    assert files == {example.__name__.split(".")[-1] for example in EXAMPLES.values()}


@pytest.mark.parametrize("name", EXAMPLES)
def test_solution(name):
    example = EXAMPLES[name]
    solution = ro.solve(example.problem, rtol=example.RTOL)
    errors = measured_errors(solution, INDEPENDENT[name])
    assert solution.success, solution.message
    assert np.all(errors <= 5.0 * example.RTOL), errors


@pytest.mark.parametrize("name", EXAMPLES)
def test_main(name, capsys):
    EXAMPLES[name].main()
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
