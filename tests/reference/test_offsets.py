"""Systems far from zero are right, or refused with a clear error; never wrong."""

import importlib.util
import subprocess

import numpy as np
import pytest

import rankone as ro
from tests.reference.offsets import END, JUMP, SYSTEMS
from tests.share.export.alone import PythonAlone
from tests.share.export.node import NODE, script
from tests.share.export.test_models import COMPILER

RTOL = 1e-5
WITHIN = 5.0
SOME = ("body_temperature", "start_1", "jump_6", "output_15")
EXPORTED = {*[*SYSTEMS][:5], *[*SYSTEMS][-4:]}
"""One of each place at either end of the offsets."""


def solved(system, **options):
    problem = ro.Problem.from_strings(**system.arguments)
    solution = ro.solve(problem, rtol=RTOL, **options)
    if system.place != "output":
        return solution, "y"
    return solution.output({"q": system.text.format("x")}), "q"


def points(solution):
    rng = np.random.default_rng(7)
    box = solution.parameters
    return {name: lower + (upper - lower) * rng.random(20) for name, (lower, upper) in box.items()}


def errors(system, values, where, times):
    """Largest error at points over the largest value."""
    b = where.get("b", np.zeros(20))
    exact = np.array([system.exact(times, *pair) for pair in zip(where["a"], b, strict=True)])
    return np.abs(values - exact).max() / np.abs(exact).max()


def times(system):
    t = np.linspace(0.0, END, 41)
    return t[t != JUMP] if system.place == "jump" else t


def check(name):
    """The solution if it is one."""
    system = SYSTEMS[name]
    solution, unknown = solved(system)
    where, t = points(solution), times(SYSTEMS[name])
    columns = {key: column[:, None] for key, column in where.items()}
    error = errors(system, solution[unknown](t=t, **columns), where, t)
    assert not solution.success or error <= WITHIN * solution.rtol, (
        f"{error:.2g}: {solution.message}"
    )
    return solution


@pytest.mark.parametrize("name", SOME)
def test_some_far_from_zero(name):
    assert check(name).success


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
def test_far_from_zero(name, tmp_path):
    """Models of some in Python, C and JavaScript have the values of the solution too."""
    solution = check(name)
    if name not in EXPORTED:
        return
    names = [solution.metadata.time, *solution.parameters]
    at = [0.7 * END, *(0.3 * lower + 0.7 * upper for lower, upper in solution.parameters.values())]
    wanted = solution(**dict(zip(names, at, strict=True)))
    found = [in_python(solution, dict(zip(names, at, strict=True)), tmp_path)]
    if COMPILER is not None:
        found.append(in_c(solution, at, tmp_path))
    if NODE is not None:
        solution.export(tmp_path / "model.mjs")
        given = f"{at[0]!r}, {at[1:]!r}"
        found.append(script(tmp_path, f"console.log(JSON.stringify([...m.evaluate({given})]))"))
    for values in found:
        np.testing.assert_allclose(values, wanted, rtol=1e-9, atol=1e-12)


def in_python(solution, at, folder):
    spec = importlib.util.spec_from_file_location("model", solution.export(folder / "model.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.value(at)


def in_c(solution, at, folder):
    solution.export(folder / "model.c")
    header = next(folder.glob("*.h")).name
    numbers = ", ".join(map(repr, at[1:]))
    (folder / "main.c").write_text(
        f'#include <stdio.h>\n#include "{header}"\nint main(void) {{\n'
        f"  double p[] = {{{numbers}}}, out[MODEL_UNKNOWNS];\n"
        f"  if (model_eval(p, {at[0]!r}, out) != MODEL_OK) return 1;\n"
        f'  for (int i = 0; i < MODEL_UNKNOWNS; i++) printf("%.17g\\n", out[i]);\n'
        "  return 0;\n}\n"
    )
    files = [str(folder / "main.c"), str(folder / "model.c")]
    program = folder / "program"
    subprocess.run([COMPILER, *files, "-lm", "-o", str(program)], check=True)
    run = subprocess.run([str(program)], capture_output=True, text=True, check=True)
    return [float(line) for line in run.stdout.split()]


@pytest.fixture(scope="module")
def alone():
    python = PythonAlone()
    yield python.runs
    python.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["body_temperature", pytest.param("rate_16", marks=pytest.mark.slow)]
)
def test_the_standalone_solver_far_from_zero(alone, name, tmp_path):
    arguments = SYSTEMS[name].arguments
    ro.compile(ro.Problem.from_strings(**arguments)).export(tmp_path / "solver.py")
    script_ = "s = solver.solve(rtol=1e-5); print(s.success); print(float(s(t=1.3, a=1.05)[1]))"
    (run,) = alone(tmp_path, script_)
    assert run.returncode == 0, run.stderr
    success, value = run.stdout.split()
    exact = SYSTEMS[name].exact(np.array([0.0, 1.3]), 1.05, 0.0)[1]
    assert success == "True"
    assert float(value) == pytest.approx(exact, abs=1e-4)
