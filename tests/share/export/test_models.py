"""Solved models in Python and in C agree with the solution they were made from."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.share.export.model_c import c_identifier
from rankone.share.export.model_python import keywords
from rankone.share.export.packing import pack
from rankone.support.errors import ExportError, OptionError
from rankone.trajectories.system.verdict import Status
from tests.problems import EXAMPLES
from tests.share.export.solutions import (
    points,
    solved,
    synthetic,
    synthetic_with_breaks,
    synthetic_with_scales,
)

ROOT = Path(__file__).parents[3]
DRIVER = Path(__file__).parent / "model_driver.c"
COUNT, SANITIZED_COUNT = 10_000, 500

COMPILER = shutil.which("gcc") or shutil.which("clang") or shutil.which("cc")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C compiler (gcc, clang or cc)")
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
SANITIZED = ["-g", "-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]

SOLUTIONS = {
    **{name: lambda name=name: solved(name) for name in EXAMPLES},
    "synthetic": synthetic,
    "unequal": synthetic_with_breaks,
    "scaled": synthetic_with_scales,
}


def imported(path):
    """The model as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def sizes(values):
    """The largest value of each unknown, for broadcasting over the points."""
    return np.abs(values).max(axis=1, keepdims=True)


def widths(solution):
    intervals = [solution.time, *solution.parameters.values()]
    return np.array([upper - lower for lower, upper in intervals])


def slab_gradient(solution, where):
    """Derivatives of the slabs themselves.

    Along each coordinate a slab is a polynomial on every element; it is interpolated, and the
    interpolant differentiated.
    """
    names = list(where)
    centre = np.stack([where[name] for name in names])
    gradient = np.empty((len(solution.unknowns), *centre.shape))
    nodes = np.cos(np.pi * (np.arange(80) + 0.5) / 80)
    starts = [slab.start for slab in solution.outcome.slabs[1:]]
    owner = np.searchsorted(starts, centre[0], side="right")
    for k in range(centre.shape[1]):
        slab = solution.outcome.slabs[owner[k]]
        for j in range(len(names)):
            basis = None if j == 0 else slab.bases[j - 1]
            lower, upper = (slab.start, slab.end) if j == 0 else (basis.lower, basis.upper)
            edges = np.array([lower, upper]) if j == 0 else basis.edges
            e = np.searchsorted(edges[1:-1], centre[j, k], side="right")
            a, width = edges[e], edges[e + 1] - edges[e]
            sample = np.repeat(centre[:, k : k + 1], nodes.size, axis=1)
            sample[j] = a + 0.5 * width * (nodes + 1.0)
            values = slab(sample[0], sample[1:])[: len(solution.unknowns)]
            for i, row in enumerate(values):
                fit = np.polynomial.chebyshev.Chebyshev.fit(nodes, row, 64, domain=[-1, 1])
                xi = 2.0 * (centre[j, k] - a) / width - 1.0
                gradient[i, j, k] = fit.deriv()(xi) * 2.0 / width
    return gradient


# --- Python ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["lotka_volterra", "unequal", "scaled"])
def test_python_gradient(name, tmp_path):
    solution = SOLUTIONS[name]()
    model = imported(solution.export(tmp_path / "model.py"))
    where = points(solution, 12, seed=3)
    wanted = slab_gradient(solution, where)
    size = sizes(solution(points(solution, COUNT)))[:, :, None] / widths(solution)[:, None]
    size = np.maximum(size, np.abs(wanted).max(axis=2, keepdims=True))
    assert np.all(
        np.abs(model.gradient(where) - wanted) <= 1e-6 * size
    )  # the interpolation of short slabs


def test_python_beside(tmp_path):
    """Few coefficients are in the file, many beside it; the same bytes every time."""
    solved("decay").export(tmp_path / "small.py")
    assert {path.name for path in tmp_path.iterdir()} == {"small.py"}
    large = [solved("lotka_volterra").export(tmp_path / f"{name}.py") for name in ("a", "b")]
    archives = [path.with_suffix(".npz").read_bytes() for path in large]
    assert archives[0] == archives[1]
    assert "a.npz" in large[0].read_text()


def test_python_bounds_and_names(tmp_path):
    model = imported(synthetic().export(tmp_path / "model.py"))
    assert model.KEYWORDS == ("t", "lambda_", "x_0", "α")
    at = {"t": 0.0, "lambda": 1.0, "x_{0}": 0.5, "α": 1.5}
    wanted = model.value(at)
    np.testing.assert_array_equal(model.value(t=0.0, lambda_=1.0, x_0=0.5, α=1.5), wanted)
    assert model.value({**at, "t": [0.0, 1.0]}).shape == (2, 2)
    assert model.gradient({**at, "t": [[0.0], [1.0]]}).shape == (2, 4, 2, 1)
    assert model.value({**at, "t": []}).shape == (2, 0)
    for wrong in ({"t": 2.1}, {"lambda": -2.1}, {"α": float("nan")}):
        with pytest.raises(ValueError, match=r" is [\w.-]+, not in \["):
            model.value({**at, **wrong})
    for other in ("0.5", None, [1.0, "x"], 1j, [[1.0], [1.0, 2.0]]):
        with pytest.raises(ValueError, match=rf"α is {re.escape(repr(other))}, not a number"):
            model.value({**at, "α": other})
    for given in ({"t": 0.0}, {**at, "y": 1.0}, {**at, "lambda_": 1.0}):
        with pytest.raises(ValueError, match="were given"):
            model.value(given)


def test_python_names_that_cannot_be_imported(tmp_path):
    """The docstring says how a file is imported whose name is not an identifier."""
    path = solved("decay").export(tmp_path / "my-model.py")
    assert 'importlib.import_module("my-model")' in path.read_text()
    assert "import my" not in path.read_text()


def test_names_that_need_no_change_keep_their_own(tmp_path):
    """`a b` becomes `a_b` only if nobody is called so already."""
    t, first, second = sp.symbols("t"), sp.Symbol("a b"), sp.Symbol("a_b")
    u = sp.Function("u")(t)
    box = {first: (1, 2), second: (1, 2)}
    solution = ro.solve(ro.Problem([u.diff(t) + second * u], (t, 0, 1), box, {u: first}), rtol=1e-6)
    model = imported(solution.export(tmp_path / "model.py"))
    assert model.KEYWORDS == ("t", "a_b_", "a_b")
    wanted = solution({"t": 0.5, "a b": 1, "a_b": 2})
    for given in ({"t": 0.5, "a b": 1, "a_b": 2}, {"t": 0.5, "a_b_": 1, "a_b": 2}):
        np.testing.assert_allclose(model.value(given), wanted, rtol=1e-12)
    solution.export(tmp_path / "model.c")
    header = (tmp_path / "model.h").read_text()
    assert "#define MODEL_P_a_b_ 0\n#define MODEL_P_a_b 1\n" in header


def test_c_positions_of_names_that_lose_their_accents(tmp_path):
    t, *ks = sp.symbols("t é e ê")
    u = sp.Function("u")(t)
    problem = ro.Problem([u.diff(t) + sum(ks) * u], (t, 0, 1), dict.fromkeys(ks, (0, 1)), {u: 1})
    ro.solve(problem, rtol=1e-3).export(tmp_path / "model.c")
    found = re.findall(r"#define MODEL_P_(\w+) (\d)", (tmp_path / "model.h").read_text())
    assert found == [("e_", "0"), ("e", "1"), ("e__", "2")]


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (("t", "x_", "x__"), ("t", "x_", "x__")),
        (("t", "x_{0}", "x_0", "x_0_"), ("t", "x_0__", "x_0", "x_0_")),
        (("t", "lambda", "lambda_", "ﬁ"), ("t", "lambda__", "lambda_", "fi")),
    ],
)
def test_keywords(names, words):
    assert keywords(names) == words


def test_models_say_the_equations(tmp_path):
    t = sp.Symbol("t")
    q = sp.Function("q")(t)
    a = sp.Symbol("a")
    second = ro.Problem([q.diff(t, 2) + 4 * q], (t, 0, 1), {a: (1, 2)}, {q: a, q.diff(t): 0})
    solution = ro.solve(second, rtol=1e-6)
    lines = ("q' = q_t", "q_t' = -4*q", "q(0) = a", "q_t(0) = 0")
    assert solution.metadata.equations == lines
    for file in ("model.py", "model.h"):
        solution.export((tmp_path / file).with_suffix(".py" if file[-1] == "y" else ".c"))
        text = (tmp_path / file).read_text()
        assert all(line in text for line in lines)


def with_derivatives():
    """Two unknowns in a second-order equation and a first-order one."""
    problem = ro.Problem.from_strings(
        rhs={"x": "v", "v": "-k*x"}, initial={"x": 1, "v": 0}, parameters={"k": (1, 2)}, time=(0, 1)
    )
    solution = ro.solve(problem, rtol=1e-6)
    metadata = replace(solution.metadata, states=("x", "x_t"), roles=("unknown", "derivative"))
    return ro.Solution(solution.outcome, metadata)


def test_python_states(tmp_path):
    solution = with_derivatives()
    assert imported(solution.export(tmp_path / "few.py")).UNKNOWNS == ("x",)
    model = imported(solution.export(tmp_path / "all.py", states="all"))
    assert model.UNKNOWNS == solution.states == ("x", "x_t")
    where = points(solution, 100)
    wanted = np.array([solution[name](where) for name in model.UNKNOWNS])
    np.testing.assert_allclose(model.value(where), wanted, atol=1e-12)
    np.testing.assert_allclose(model.gradient(where)[0, 0], wanted[1], atol=1e-5)
    with pytest.raises(
        OptionError,
        match="states='some' is unknown; remedy: use 'unknowns', 'all' or a list of names",
    ):
        solution.export(tmp_path / "some.py", states="some")


@needs_compiler
def test_c_states(tmp_path):
    solution = with_derivatives()
    solution.export(tmp_path / "model.c", states="all")
    assert "#define MODEL_U_x_t 1\n" in (tmp_path / "model.h").read_text()
    where = points(solution, 100)
    states = replace(solution.metadata, roles=("unknown", "unknown"))
    both = ro.Solution(solution.outcome, states)
    values, _, _ = run_driver(compiled_driver(tmp_path, "-O2"), both, where)
    np.testing.assert_allclose(values, both(where), atol=1e-12)


# --- C -----------------------------------------------------------------------------------------


def compiled_driver(folder, *flags):
    """Compile model.c with the driver; skip if the compiler lacks what the flags ask for."""
    program = folder / f"driver{abs(hash(flags))}"
    files = [str(folder / "model.c"), str(DRIVER)]
    command = [COMPILER, *STRICT, *flags, f"-I{folder}", "-o", str(program), *files, "-lm"]
    run = subprocess.run(command, capture_output=True, text=True)
    if run.returncode and "sanitize" in " ".join(flags) and "cannot find" in run.stderr:
        pytest.skip("the compiler has no sanitizers")
    assert run.returncode == 0, run.stderr
    return program


def run_driver(program, solution, where):
    """Values (unknowns, N), gradients (unknowns, coordinates, N) and the values of a batch."""
    table = np.stack(list(where.values()), axis=1)
    count, width = table.shape
    data = np.concatenate([[float(count)], table.ravel()]).tobytes()
    run = subprocess.run([str(program)], input=data, capture_output=True)
    assert run.returncode == 0, run.stderr.decode()
    n = len(solution.unknowns)
    out = np.frombuffer(run.stdout)
    single, batch = out[: count * n * (width + 1)], out[count * n * (width + 1) :]
    rows = single.reshape(count, n * (width + 1))
    values, gradients = rows[:, :n].T, rows[:, n:].reshape(count, n, width)
    return values, np.moveaxis(gradients, 0, 2), batch.reshape(count, n).T


def test_c_of_equal_elements_has_no_tables_of_breaks(tmp_path):
    for name, there in (("synthetic", False), ("unequal", True)):
        SOLUTIONS[name]().export(tmp_path / f"{name}.c")
        text = (tmp_path / f"{name}.c").read_text()
        assert ("places" in text) == there
        assert "@" not in text


STATUS = r"""
#include <math.h>
#include <stdio.h>
#include <string.h>
#include "model.h"

int main(void)
{
    double p[3] = {1.0, 0.5, 1.5}, many[6] = {1.0, 0.5, 1.5, 1.0, 0.5, 9.0}, t[2] = {0.0, 0.0};
    double u[8] = {7, 7, 7, 7, 7, 7, 7, 7};
    int k, kept = 1;
    printf("%d ", model_eval(p, 2.5, u));
    printf("%d ", model_gradient(p, -1.1, u));
    printf("%d ", model_eval(p, NAN, u));
    p[MODEL_P_x_0] = 0.8;
    printf("%d ", model_eval(p, 0.0, u));
    p[MODEL_P_x_0] = NAN;
    printf("%d ", model_gradient(p, 0.0, u));
    printf("%d ", model_eval_batch(2, many, t, u));
    for (k = 0; k < 8; k++)
        kept = kept && u[k] == 7;
    p[MODEL_P_x_0] = 0.7 + 1e-14;
    printf("%d %d ", kept, model_eval(p, 2.0 + 1e-14, u));
    printf("%d %d %d ", MODEL_PARAMETERS, MODEL_UNKNOWNS, MODEL_U_int);
    printf("%s %s ", model_parameter_names[MODEL_P_lambda], model_unknown_names[1]);
    printf("%s %g %g ", model_parameter_names[2], model_lower[2], model_upper[2]);
    printf("%g", model_time_upper);
    return 0;
}
"""


@needs_compiler
@pytest.mark.parametrize("flags", [[], ["-O3", "-ffast-math"]])
def test_c_status_and_constants(flags, tmp_path):
    """What is not a number is refused, also where the compiler is told that there is no such."""
    synthetic().export(tmp_path / "model.c")
    (tmp_path / "main.c").write_text(STATUS)
    program = tmp_path / "main"
    for command in (
        ["-c", "main.c"],
        [*flags, "-c", "model.c"],
        ["-o", "main", "main.o", "model.o"],
    ):
        subprocess.run([COMPILER, *STRICT, *command], cwd=tmp_path, check=True)
    out = subprocess.run([str(program)], capture_output=True, text=True, check=True).stdout
    assert out == "2 2 1 2 1 2 1 0 3 2 1 lambda int α 1 2 2"


@needs_compiler
def test_c_needs_nothing(tmp_path):
    """No symbol is left open but what the compiler itself may call."""
    solved("decay").export(tmp_path / "model.c")
    nm = shutil.which("nm")
    if nm is None:
        pytest.skip("no nm")
    own = r"mem(?:set|cpy)|_GLOBAL_OFFSET_TABLE_|__cpu_(?:model|indicator_init)"
    for flags, allowed in ((["-O2"], own), (["-O2", "-DMODEL_PORTABLE"], r"mem(?:set|cpy)")):
        subprocess.run([COMPILER, *STRICT, *flags, "-c", "model.c"], cwd=tmp_path, check=True)
        run = subprocess.run([nm, "-u", "model.o"], cwd=tmp_path, capture_output=True, text=True)
        assert not re.findall(rf"U (?!_?(?:{allowed})$)(\w+)", run.stdout, re.MULTILINE)


@needs_compiler
@pytest.mark.parametrize("unknown", ["u", "u*/", "a/*b", 'u???/"};int x;//', "what????"])
def test_c_without_coefficients_or_with_odd_names(unknown, tmp_path):
    t = sp.Symbol("t")
    u = sp.Function(unknown)(t)
    solution = ro.solve(ro.Problem([u.diff(t) + u], (t, 0, 1), {}, {u: 0}))
    solution.export(tmp_path / "model.c")
    where = {"t": np.linspace(0, 1, 5)}
    values, _, _ = run_driver(compiled_driver(tmp_path, "-O2"), solution, where)
    np.testing.assert_array_equal(values, np.zeros((1, 5)))


def test_equal_cores_are_there_once(tmp_path):
    """Slabs of sampled trajectories share the cores of the parameters."""
    solution = solved("lotka_volterra")
    slabs = solution.outcome.slabs
    shared = sum(core.size for core in slabs[0].cores[1:])
    once = shared + sum(slab.cores[0].size for slab in slabs)
    assert len(slabs) > 5
    assert pack(solution).size <= once
    solution.export(tmp_path / "model.py")
    with np.load(tmp_path / "model.npz") as file:
        assert file["coefficients"].size <= once
    text = solution.export(tmp_path / "model.c").read_text()
    numbers = text.partition("coefficients[] ALIGNED = {")[2].partition("};")[0]
    every = sum(core.size for slab in slabs for core in slab.cores)
    assert numbers.count(",") < 0.5 * every  # rows are padded with zeros


def test_paths_that_cannot_be(tmp_path):
    solution = solved("decay")
    for name in ("x" * 300 + ".c", "a\0.c", 'q"q.c', "a\\b.c"):
        with pytest.raises(ExportError, match="cannot be"):
            solution.export(tmp_path / name)
    (tmp_path / "one.c").write_text("")
    (tmp_path / "one.h").symlink_to(tmp_path / "one.c")
    with pytest.raises(ExportError, match="are one file"):
        solution.export(tmp_path / "one.c", overwrite=True)
    assert (tmp_path / "one.c").read_text() == ""


def test_c_prefix_and_bytes(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        solved("decay").export(tmp_path / name / "my-model.c")
    source, header = ((tmp_path / "a" / f"my-model.{s}").read_text() for s in "ch")
    assert source == (tmp_path / "b" / "my-model.c").read_text()
    assert "int my_model_eval(const my_model_real *p" in header
    assert '#include "my-model.h"' in source
    assert "@" not in source + header


@pytest.mark.parametrize(
    ("name", "identifier"),
    [
        ("x0", "x0"),
        ("x_{0}", "x_0"),
        ("lambda", "lambda"),
        ("α", "alpha"),
        ("λ_1", "lambda_1"),
        ("ΔΩ", "DeltaOmega"),
        ("ϑ̇", "theta"),
        ("ά", "alpha"),
        ("ς", "sigma"),
        ("µm²", "mum2"),
        ("é", "e"),
        ("Höhe", "Hohe"),
        ("naïve model-1", "naive_model_1"),
        ("Straße", "Stra_e"),
        ("Ωж_1", "Omega_1"),
        ("日本x", "_x"),
        ("日本", "model"),
        ("2a", "_2a"),
        ("k'", "k_prime"),
        ("???", "model"),
    ],
)
def test_c_identifiers(name, identifier):
    assert c_identifier(name) == identifier


# --- what the files say ------------------------------------------------------------------------

TERMS = "may be used, changed and passed on without restriction."


@pytest.mark.parametrize("suffix", ["py", "c", "h", "js", "d.ts", "html"])
def test_models_can_be_passed_on(suffix, tmp_path):
    path = tmp_path / f"model.{suffix}"
    solved("decay").export(
        path.with_name({"h": "model.c", "d.ts": "model.js"}.get(suffix, path.name))
    )
    assert path.read_text().count(TERMS) == 1


# --- bad input ---------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["py", "c"])
def test_failed_solutions(suffix, tmp_path):
    failed = synthetic(Status.TOLERANCE)
    with pytest.raises(ExportError, match="allow_failed=True"):
        failed.export(tmp_path / f"model.{suffix}")
    assert not list(tmp_path.iterdir())
    failed.export(tmp_path / f"model.{suffix}", allow_failed=True)


def test_paths(tmp_path):
    solution = solved("decay")
    with pytest.raises(ExportError, match="names no target"):
        solution.export(tmp_path / "model.cpp")
    with pytest.raises(ExportError, match="cannot be written"):
        solution.export(tmp_path / "nowhere" / "model.c")
    (tmp_path / "model.h").write_text("mine")
    with pytest.raises(ExportError, match=r"model\.h` exists"):
        solution.export(tmp_path / "model.c")
    assert [path.name for path in tmp_path.iterdir()] == ["model.h"]
    solution.export(tmp_path / "model.c", overwrite=True)
    assert {path.name for path in tmp_path.iterdir()} == {"model.c", "model.h"}


def test_both_or_none(tmp_path, monkeypatch):
    """When the second file cannot be put in its place, the first is taken back."""
    solution = solved("decay")

    def failing(put):
        def fail(source, target):
            if Path(target).suffix == ".h":
                raise OSError("disk full")
            return put(source, target)

        return fail

    monkeypatch.setattr(Path, "replace", failing(Path.replace))
    monkeypatch.setattr(os, "link", failing(os.link))
    with pytest.raises(ExportError, match="disk full"):
        solution.export(tmp_path / "model.c")
    assert not list(tmp_path.iterdir())
    (tmp_path / "model.c").write_text("old")
    with pytest.raises(ExportError, match="disk full"):
        solution.export(tmp_path / "model.c", overwrite=True)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"model.c": "old"}
