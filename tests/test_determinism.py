"""What is generated does not depend on the seed of Python's hashes, byte for byte."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import sympy as sp

import rankone as ro
from rankone.compiler.codegen.module import generate_source
from tests.compiler.codegen.systems import REFERENCE
from tests.problems import EXAMPLES

ROOT = Path(__file__).parents[1]


def coupled_masses() -> ro.Problem:
    """Sums and products of several parameters everywhere, and masses that are inverted."""
    t, *p = sp.symbols("t p0:4")
    a, b, c = (sp.Function(name)(t) for name in "abc")
    q = sum(p)
    equations = [
        a.diff(t) - sp.exp(-q) * (1 + a + b + c) ** 2 * sp.cos(q + t),
        b.diff(t) + 2 * c.diff(t) - q * a * b,
        b.diff(t) - p[0] * c.diff(t) - sp.sqrt(p[0] * p[1]) / (p[2] * p[3] + p[2]),
    ]
    return ro.Problem(equations, (t, 0, 1), dict.fromkeys(p, (1, 2)), {a: q, b: q, c: q})


def lifted() -> ro.Problem:
    """Functions of unknowns that become unknowns."""
    return ro.Problem.from_strings(
        {"x": "a*K**n/(K**n + x**n) - x*sin(y)", "y": "-exp(-b*x)/y"},
        {"x": "a", "y": "b"},
        {"a": (1, 2), "b": (1, 2), "K": (1, 2), "n": (2, 3)},
        (0, 1),
    )


def write(folder: Path) -> None:
    """Every kind of generated text."""
    problem = coupled_masses()
    form = ro.separate(problem)
    stages = problem, ro.weak_form(problem), form.terms, form.initial, form.factors
    texts = {
        "stages.txt": "\n".join(map(str, stages)) + form._repr_latex_(),
        "lifted.py": ro.compile(lifted()).lifted.source,
        "modules.py": "".join(generate_source(make()) for make in REFERENCE.values()),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    ro.compile(EXAMPLES["kirchhoff"].problem).export(folder / "solver.py")


@pytest.mark.slow
def test_the_same_bytes_under_another_hash_seed(tmp_path):
    """As another process writes them, whatever this one has computed before."""
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    there.mkdir()
    write(here)
    seed = "1" if os.environ.get("PYTHONHASHSEED") != "1" else "4711"
    path = os.pathsep.join([str(ROOT), str(ROOT / "src")])
    environment = {**os.environ, "PYTHONHASHSEED": seed, "PYTHONPATH": path}
    command = [sys.executable, "-m", "tests.test_determinism", str(there)]
    subprocess.run(command, cwd=ROOT, env=environment, check=True)
    texts = {file.name: file.read_bytes() for file in here.iterdir()}
    assert texts.keys() == {"lifted.py", "modules.py", "solver.py", "stages.txt"}
    assert b"Term" in texts["stages.txt"]
    assert texts == {file.name: file.read_bytes() for file in there.iterdir()}


if __name__ == "__main__":
    write(Path(sys.argv[1]))
