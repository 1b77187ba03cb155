"""Imports go one way: numeric modules never need SymPy or the front end."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import rankone
from tests.problems import REFERENCE

SOURCE = Path(rankone.__file__).parent
FRONT_END = {"symbolic", "codegen", "compiled.py", "problem_files.py", "cli.py", "__init__.py"}
NUMERIC = sorted(
    path
    for path in SOURCE.rglob("*.py")
    if path.relative_to(SOURCE).parts[0] not in FRONT_END | {"export"}
)


def imported(path):
    """Modules imported at run time (not under TYPE_CHECKING)."""
    tree = ast.parse(path.read_text())
    skipped = {
        id(child)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for child in ast.walk(node)
    }
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ""


@pytest.mark.parametrize("path", NUMERIC, ids=lambda p: str(p.relative_to(SOURCE)))
def test_numeric_modules_do_not_import_the_front_end(path):
    for name in imported(path):
        assert not name.startswith(("sympy", "rankone.symbolic", "rankone.codegen")), name


@pytest.mark.parametrize("path", sorted((SOURCE / "symbolic").rglob("*.py")), ids=lambda p: p.name)
def test_the_front_end_does_not_import_code_generation_or_solvers(path):
    for name in imported(path):
        assert not name.startswith(("rankone.codegen", "rankone.solvers", "rankone.solution")), name


@pytest.mark.parametrize("path", sorted((SOURCE / "codegen").rglob("*.py")), ids=lambda p: p.name)
def test_code_generation_does_not_import_the_front_end_or_solvers(path):
    for name in imported(path):
        assert not name.startswith(("rankone.symbolic", "rankone.solvers")), name


def test_only_the_printer_uses_sympy_printing():
    users = {
        path.relative_to(SOURCE).as_posix()
        for path in SOURCE.rglob("*.py")
        if any(name.startswith("sympy.printing") for name in imported(path))
    }
    assert users == {"codegen/printer.py"}


def test_a_saved_solution_is_evaluated_without_sympy(tmp_path):
    """The solution and everything below it run with SymPy made unimportable."""
    solution = rankone.solve(REFERENCE["decay"](), rtol=1e-4)
    path = tmp_path / "decay.npz"
    solution.save(path)
    script = (
        "import sys, types\n"
        "sys.modules['sympy'] = None\n"
        f"package = types.ModuleType('rankone'); package.__path__ = [{str(SOURCE)!r}]\n"
        "sys.modules['rankone'] = package\n"
        "from rankone.storage import load\n"
        f"print(float(load({str(path)!r})(t=1.0, k=2.0)[0]))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert float(done.stdout) == float(solution(t=1.0, k=2.0)[0])
