"""The exported solver stands alone and gives the library's result."""

from __future__ import annotations

import ast
import inspect
import itertools
import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import sympy as sp
from threadpoolctl import threadpool_limits

import rankone as ro
from rankone.share.commands.cli import main
from rankone.share.export.standalone import bundle, needed_modules, source_text, standalone_source
from rankone.solvers import outcome as ir_metadata
from rankone.solvers.engines.greedy_engine import ENGINE
from rankone.support.errors import ExportError, OptionError
from rankone.tensors import ChebyshevBasis
from rankone.tensors.train import Train
from tests.problems import EXAMPLES
from tests.share.export.alone import PythonAlone, clean_environment
from tests.share.export.solutions import compiled, points, solved

ROOT = Path(__file__).parents[3]

_ALL = ("--states", "all")


def source_of(problem: ro.CompiledProblem, method: str = "train") -> str:
    """Text of the standalone solver."""
    return standalone_source(problem.problem.name, problem.source, problem.metadata(method=method))


def started(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Start Python in the folder, without the library on its path."""
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=clean_environment(),
        capture_output=True,
        text=True,
    )


@pytest.fixture(scope="module")
def alone():
    """Runs scripts and programs of the solver in a folder, without the library."""
    python = PythonAlone()
    yield python.runs
    python.close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("solver")
    compiled("lotka_volterra").export(place / "solver.py")
    return place


@pytest.mark.parametrize(
    "name",
    [
        "decay",
        "lotka_volterra",
        pytest.param("kirchhoff", marks=pytest.mark.slow),
    ],
)
def test_the_library_and_the_solver_agree(alone, name, folder, tmp_path):
    if name == "lotka_volterra":
        tmp_path = folder
    else:
        compiled(name).export(tmp_path / "solver.py")
    wanted = solved(name)
    where = points(wanted, 200)
    np.savez(tmp_path / "points.npz", **where)
    script = (
        f"s = solver.solve(rtol={wanted.rtol!r})\n"
        "where = dict(np.load('points.npz'))\n"
        "np.save('values.npy', s(where))\n"
        "time, *rest = where.values()\n"
        "names = [*where][1:]\n"
        "assert np.array_equal(s(time, dict(zip(names, rest))), s(where))\n"
        "first = s[s.unknowns[0]](where)\n"
        "assert np.abs(first - s(where)[0]).max() <= 1e-13 * np.abs(first).max()\n"
        "again = solver.load(s.save('history.npz'))\n"
        "assert again.outcome.history == s.outcome.history\n"
        "s.save('solution.npz')\n"
        "assert np.array_equal(solver.load('solution.npz')(where), s(where))\n"
        "assert s.success and s.error <= s.metadata.rtol, s.message\n"
    )
    (run,) = alone(tmp_path, script)
    assert run.returncode == 0, run.stderr
    values = wanted(where)
    size = np.abs(values).max(axis=1, keepdims=True)
    np.testing.assert_array_less(np.abs(np.load(tmp_path / "values.npy") - values) / size, 1e-12)
    loaded = ro.load(tmp_path / "solution.npz")
    assert np.all(np.abs(loaded(where) - values) <= 1e-12 * size)
    assert loaded.error == pytest.approx(wanted.error, rel=1e-6)


@pytest.mark.slow
def test_the_classic_method_is_exported_as_well(alone, tmp_path):
    problem = compiled("coupled")
    problem.export(tmp_path / "solver.py", method="greedy")
    with threadpool_limits(1, "blas"):
        wanted = ENGINE.run(problem.system, 1e-3)
    script = (
        "s = solver.solve(rtol=1e-3)\n"
        "points = np.load('points.npy')\n"
        "np.save('values.npy', s(dict(zip(('t', *s.parameters), points))))\n"
        "assert s.metadata.method == 'greedy'\n"
    )
    box = np.array([problem.system.horizon, *problem.system.box])
    points = box[:, :1] + np.diff(box) * np.random.default_rng(0).random((len(box), 50))
    np.save(tmp_path / "points.npy", points)
    (run,) = alone(tmp_path, script)
    assert run.returncode == 0, run.stderr
    values = np.load(tmp_path / "values.npy")
    for k, point in enumerate(points.T):
        slab = next(slab for slab in wanted.slabs if point[0] <= slab.end)
        exact = slab(point[:1], point[1:, None])[:, 0]
        np.testing.assert_allclose(values[:, k], exact, rtol=0, atol=1e-12 * np.abs(values).max())


def _general() -> ro.CompiledProblem:
    """Functions of unknowns, SciPy's among them, a table and an initial value that couples."""
    force = ro.table([0, 0.5, 1.2, 2], [0, 1, -1, 0.5], name="force")
    t, k, m = sp.symbols("t k m")
    x = sp.Function("x")(t)
    rhs = -k * sp.sin(x) + sp.erf(m * x) + force(t)
    return ro.compile(
        ro.Problem([sp.Eq(x.diff(t), rhs)], (t, 0, 2), {k: (1, 2), m: (0.5, 1)}, {x: 1 / (k + m)})
    )


def test_the_cross_method_is_exported_as_well(alone, tmp_path):
    problem = _general()
    problem.export(tmp_path / "solver.py", method="cross")
    wanted = problem.solve(1e-4, method="cross")
    where = points(wanted, 50)
    np.savez(tmp_path / "points.npz", **where)
    script = (
        "s = solver.solve(rtol=1e-4)\n"
        "np.save('values.npy', s(dict(np.load('points.npz'))))\n"
        "assert s.success and s.metadata.method == 'cross'\n"
        "assert np.array_equal(solver.load(s.save('s.npz'))(s.time[1], s.parameters and "
        "{n: b[0] for n, b in s.parameters.items()}), s(s.time[1], "
        "{n: b[0] for n, b in s.parameters.items()}))\n"
    )
    (run,) = alone(tmp_path, script)
    assert run.returncode == 0, run.stderr
    np.testing.assert_allclose(np.load(tmp_path / "values.npy"), wanted(where), 1e-9, 1e-9)


def test_other_box_and_horizon(alone, folder):
    script = (
        "s = solver.solve(rtol=1e-5, parameters={'x0': (7, 13)}, t_final=4.0)\n"
        "print(s(t=4.0, x0=[7.0, 12.5], y0=5.5).tolist())\n"
        "assert s.parameters == {'x0': (7.0, 13.0), 'y0': (4.0, 6.0)} and s.time == (0.0, 4.0)\n"
    )
    (run,) = alone(folder, script)
    assert run.returncode == 0, run.stderr
    example = EXAMPLES["lotka_volterra"]
    problem = ro.Problem(
        example.problem.equations,
        (example.t, 0, 4),
        {example.x0: (7, 13), example.y0: (4, 6)},
        {example.x: example.x0, example.y: example.y0},
    )
    wanted = ro.solve(problem, rtol=1e-5)(t=4.0, x0=[7.0, 12.5], y0=5.5)
    np.testing.assert_allclose(json.loads(run.stdout), wanted, rtol=0, atol=1e-12)


BAD_CALLS = [
    ("solver.solve(parameters={'z': (1, 2)})", "OptionError", "no parameter `z`"),
    ("solver.solve(parameters={'x0': (2, 1)})", "OptionError", "ascending"),
    ("solver.solve(t_final=-1)", "OptionError", "horizon"),
    ("solver.solve(rtol=2)", "OptionError", "rtol"),
    ("solution(t=7, x0=9, y0=5)", "EvaluationError", "[0, 6]"),
    ("solution(t=float('nan'), x0=9, y0=5)", "EvaluationError", "`t`"),
    ("solution(t=1, x0=9)", "EvaluationError", "no value for `y0`"),
    ("solution(1, 9, 5)", "EvaluationError", "solution(t=3, x0=10, y0=5)"),
    ("solution['z']", "EvaluationError", "no unknown `z`"),
    ("solution.save('values.txt')", "StorageError", "end the name in .npz"),
    (
        "solver.solve(rtl=1e-3)",
        "OptionError",
        "unknown option 'rtl' (did you mean `rtol`?); remedy: choose from basis",
    ),
    (
        "solver.solve(zzz=1)",
        "OptionError",
        "time_nodes; solve itself takes rtol, parameters, t_final, check",
    ),
    ("solver.solve(check=-1)", "OptionError", "check=-1"),
    ("solver.load('nothing.npz')", "StorageError", "nothing.npz"),
    ("solver.load('solver.py')", "StorageError", "solver.py"),
]


def test_bad_input(alone, folder):
    script = (
        "import json\n"
        "solution, said = solver.solve(rtol=1e-3), []\n"
        f"for call in {[call for call, _, _ in BAD_CALLS]!r}:\n"
        "    try:\n"
        "        said.append(['nothing', repr(eval(call))])\n"
        "    except Exception as error:\n"
        "        said.append([type(error).__name__, str(error)])\n"
        "print(json.dumps(said))"
    )
    (run,) = alone(folder, script)
    assert run.returncode == 0, run.stderr
    for (call, error, message), (raised, said) in zip(BAD_CALLS, json.loads(run.stdout)):
        assert raised == error, call
        assert message in said, call


@pytest.mark.slow
def test_program(alone, folder):
    run = started(folder, "solver.py", "--rtol", "1e-6", "--at", "t=1", "x0=9", "y0=5", "--json")
    assert run.returncode == 0, run.stderr
    values = json.loads(run.stdout)["values"]
    wanted = solved("lotka_volterra")(t=1, x0=9, y0=5)
    np.testing.assert_allclose([values["x"], values["y"]], wanted, rtol=1e-12)

    save = ["--grid", "5", "--rtol", "1e-3", "--save", "values.npz"]
    limited = ["--options", "max_slabs=3", "--rtol", "1e-8"]
    large = ["--rtol", "1e-3", "--grid", "100000", "--save", "large.npz"]
    lines = save, save, [*save, "--overwrite"], limited, large, ["--help"]
    runs = alone(folder, *lines)
    assert [run.returncode for run in runs] == [0, 2, 0, 1, 2, 0], runs
    with np.load(folder / "values.npz") as file:
        assert set(file) == {"t", "x0", "y0", "x", "y"}
        assert file["x"].shape == (5, 5, 5)
        np.testing.assert_allclose(file["x"][0, :, 0], file["x0"], rtol=1e-3)
    assert "x' = 1.5*x - x*y" in runs[-1].stdout


def test_wrong_arguments_of_the_program(alone, folder):
    (folder / "folder.npz").mkdir()
    (folder / "there.npz").touch()
    wrong = [
        (["--at", "t"], "--at: 't' cannot be read; remedy: write NAME=VALUE"),
        (["--at", "t=a"], "--at: 't=a' cannot be read"),
        (["--at", "t=1", "t=2"], "'t=2' has a name that is given twice"),
        (["--box", "x0=7,13"], "--box: 'x0=7,13' cannot be read; remedy: write NAME=LOWER"),
        (["--rtol", "1e-3", "--grid", "0", "--save", "zero.npz"], "--grid 0"),
        (["--save", "there.npz"], "exists"),
        (["--save", "nowhere/values.npz"], "cannot be written: there is no directory `nowhere`"),
        (["--save", ".", "--overwrite"], "end the name in .npz"),
        (["--save", "", "--overwrite"], "end the name in .npz"),
        (["--save", "folder.npz", "--overwrite"], "cannot be written: it is a directory"),
        (["--save", f"{'x' * 300}.npz"], "cannot be written"),
        (["--load", ""], "cannot be read"),
        (["--options", "rtol=1"], "--options: `rtol` is not an option of the engine"),
        (["--options", "cls=1"], "unknown option 'cls'"),
        (["--box", "x0=7"], "not two numbers"),
        (["--grid", "5"], "--grid needs --save"),
        (["--load", "there.npz", "--rtol", "1e-3"], "no --rtol"),
        (["--options", "max_rank=0"], "max_rank=0"),
    ]
    runs = alone(folder, *(arguments for arguments, _ in wrong))
    for run, (arguments, message) in zip(runs, wrong):
        assert run.returncode == 2, arguments
        assert message in run.stderr, arguments


@pytest.mark.slow
def test_saved_by_the_program(alone, folder):
    file = folder / "saved.npz"
    saved, again, run = alone(
        folder,
        ["--rtol", "1e-3", "--save", str(file)],
        ["--load", str(file), "--at", "t=1", "x0=9", "y0=5", "--json"],
        f"s = solver.load({str(file)!r}); s.save('b.npz'); print(s.error)",
    )
    assert saved.returncode == 0
    values = json.loads(again.stdout)["values"]
    wanted = ro.load(file)
    np.testing.assert_allclose(list(values.values()), wanted(t=1, x0=9, y0=5), rtol=1e-12)
    assert float(run.stdout) == wanted.error
    assert ro.load(folder / "b.npz").error == wanted.error
    whole = file.read_bytes()
    middle = len(whole) // 2
    # one byte alone may be in what no reader of archives looks at
    changed = bytes(byte ^ 1 for byte in whole[middle : middle + 512])
    damaged = [b"", whole[:2000], whole[:middle] + changed + whole[middle + 512 :]]
    for number, content in enumerate(damaged):
        (folder / f"{number}damaged.npz").write_bytes(content)
    compiled("decay").solve(1e-3, method="cross").save(folder / "decay.npz")
    *broken, other = alone(
        folder,
        *(["--load", f"{number}damaged.npz"] for number in range(len(damaged))),
        ["--load", "decay.npz"],
    )
    for run in broken:
        assert run.returncode == 2
        assert "damaged.npz` is" in run.stderr
    assert other.returncode == 2
    assert "other equations" in other.stderr


def test_derivatives_and_corners_by_the_program(alone, tmp_path):
    t, k = sp.symbols("t k")
    x = sp.Function("x")(t)
    problem = ro.Problem(
        [sp.Eq(x.diff(t, 2), -k * x)], (t, 0, 1), {k: (1, 2)}, {x: 1, x.diff(t): 0}
    )
    ro.compile(problem).export(tmp_path / "solver.py")
    saved = str(tmp_path / "saved.npz")
    at = ["--load", saved, "--at", "t=0.5", "k=1.5", "--json"]
    grid = ["--load", saved, "--grid", "4", "--save", "grid.npz"]
    script = "s = solver.solve(1e-4, check=0); print(s['x_t'](t=0, k=1) + 1, s.corner_error)"
    save = ["--rtol", "1e-4", "--save", saved]
    runs = alone(tmp_path, save, at, [*at, *_ALL], [*grid, *_ALL], script)
    assert not any(run.returncode for run in runs), runs
    solution = ro.load(saved)
    plain, full = (json.loads(run.stdout) for run in runs[1:3])
    assert set(plain["values"]) == {"x"}
    wanted = {name: float(solution[name](t=0.5, k=1.5)) for name in ("x", "x_t")}
    assert full["values"] == pytest.approx(wanted, rel=1e-12)
    assert full["values"]["x_t"] == pytest.approx(-np.sqrt(1.5) * np.sin(np.sqrt(0.375)), rel=1e-3)
    assert (full["error"], full["errors"]) == (solution.error, solution.errors)
    assert full["corner_error"] == solution.corner_error
    with np.load(tmp_path / "grid.npz") as arrays:
        assert set(arrays) == {"t", "k", "x", "x_t"}
        wanted = solution["x_t"].grid(t=arrays["t"], k=arrays["k"])
        np.testing.assert_allclose(arrays["x_t"], wanted, rtol=1e-12, atol=1e-15)
    value, corners = runs[-1].stdout.split()
    assert float(value) == pytest.approx(1.0, abs=1e-3)
    assert corners == "nan"


def test_elements_of_unequal_size_are_read_and_written(alone, folder, tmp_path):
    before = str(tmp_path / "before.npz")
    (run,) = alone(folder, f"solver.solve(rtol=1e-3).save({before!r})")
    assert run.returncode == 0, run.stderr
    solved_before = ro.load(before)
    slabs = []
    for slab in solved_before.outcome.slabs:
        first, *rest = slab.bases
        basis = ChebyshevBasis(
            first.lower, first.upper, first.degree, breaks=(first.lower + 0.1, first.lower + 0.5)
        )
        values = first.modal_values(basis.nodes) * np.sqrt(basis.weights)[:, None]
        core = np.matmul(basis.to_modal @ values, slab.cores[1])
        cores = (slab.cores[0], core, *slab.cores[2:])
        slabs.append(replace(slab, train=Train(cores), bases=(basis, *rest)))
    outcome = replace(solved_before.outcome, slabs=tuple(slabs))
    solution = ro.Solution(outcome, solved_before.metadata)
    where = points(solution, 200)
    wanted = solved_before(where)
    np.testing.assert_allclose(solution(where), wanted, atol=1e-10 * np.abs(wanted).max())
    at, a, b, values = (str(tmp_path / f"{name}.npz") for name in ("at", "a", "b", "values"))
    solution.save(a)
    np.savez(at, **where)
    script = (
        f"s = solver.load({a!r})\ns.save({b!r})\nnp.savez({values!r}, s({{**np.load({at!r})}}))"
    )
    (run,) = alone(folder, script)
    assert run.returncode == 0, run.stderr
    with np.load(values) as file:
        np.testing.assert_array_equal(file["arr_0"], solution(where))
    again = ro.load(b)
    assert [s.bases for s in again.outcome.slabs] == [s.bases for s in solution.outcome.slabs]


@pytest.mark.slow
def test_a_blow_up_leaves_what_comes_before_it(alone, tmp_path):
    problem = ro.Problem.from_strings(
        rhs={"x": "x**2"}, initial={"x": "a"}, parameters={"a": (1, 2)}, time=(0, 0.8)
    )
    ro.compile(problem).export(tmp_path / "solver.py")
    script = (
        "import pickle\ntry:\n    solver.solve(1e-3)\nexcept solver.BlowUpError as error:\n"
        "    again = pickle.loads(pickle.dumps(error))\n"
        "    print(str(again) == str(error), again.parameters == error.parameters)\n"
        "    print(error.part.success, error.part.time)"
    )
    arguments = ["--rtol", "1e-3", "--at", "t=0.25", "a=2", "--json"]
    late_arguments = ["--rtol", "1e-3", "--at", "t=0.7", "a=2", "--save", "b.npz"]
    run, error, late = alone(tmp_path, arguments, script, late_arguments)
    assert run.returncode == 1
    assert "blows up" in run.stderr
    assert error.stdout == "True True\nTrue (0.0, 0.8)\n"
    assert late.returncode == 1
    assert ro.load(tmp_path / "b.npz").time[1] < 0.7
    answer = json.loads(run.stdout)
    assert answer["success"] is False
    assert answer["values"]["x"] == pytest.approx(4.0, rel=2e-3)


@pytest.mark.slow
def test_formatted(tmp_path):
    pytest.importorskip("ruff")
    for name, method in itertools.product(EXAMPLES, ("train", "cross", "greedy")):
        if method == "train" or name == "kirchhoff":
            compiled(name).export(tmp_path / f"{name}_{method}.py", method=method)
    ruff = [sys.executable, "-m", "ruff"]
    config = ["--config", str(ROOT / "pyproject.toml"), str(tmp_path)]
    for command in (["check", "--no-cache"], ["format", "--check", "--diff", "--no-cache"]):
        run = subprocess.run([*ruff, *command, *config], capture_output=True, text=True)
        assert run.returncode == 0, run.stdout + run.stderr


@pytest.mark.parametrize("method", ["train", "cross", "greedy"])
def test_the_front_is_all_a_reader_needs(method):
    """In 250 lines what the file is, solve, load, the command line and the system, then kernels."""
    source = source_of(compiled("lotka_volterra"), method)
    front = source[: source.index("# Runtime: ")]
    assert front[: front.index("# --- Kernels")].count("\n") <= 200
    assert front.count("\n") <= 260
    for text in ("x' = 1.5*x - x*y", "x0 in [8, 12]", "Operations: rhs 5"):
        assert text in front
    order = ["As a program", "def solve(", "def load(", "def main(", "def rhs(", "def linear_0("]
    places = [front.index(text) for text in order]
    assert places == sorted(places)
    assert "Largest error asked for, relative to the size of each unknown" in front
    assert "may be used, changed and passed on without restriction.\n" in front
    assert "rankone." not in "".join(line for line in source.splitlines() if "import " in line)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["cross", "train", "greedy"])
def test_the_runtime_is_whole_modules_of_the_library(method):
    """Each once, after those it imports, the same statements, each name declared global."""
    tree = ast.parse(source_of(compiled("decay"), method))
    bundled = [
        node for node in tree.body if isinstance(node, ast.FunctionDef) and "__" in node.name
    ]
    done = []
    for node in bundled:
        name = f"rankone.{node.name.replace('__', '.')}"
        declared = [s for s in node.body if isinstance(s, ast.Global)]
        documented = ast.get_docstring(node) is not None
        body = node.body[: 1 if documented else 0] + node.body[documented + len(declared) :]
        assert statements(body) == statements_of_library(name), name
        for inner in (n for n in body if isinstance(n, ast.ImportFrom) and n.level):
            imported = {inner.module, *(f"{inner.module}.{alias.name}" for alias in inner.names)}
            assert imported & {*done}, name
        done.append(name.removeprefix("rankone."))
    assert len(done) == len({*done})
    inside = [*statements_within(tree)]
    for_types = [n for n in inside if isinstance(n, ast.If) and "TYPE_" in ast.dump(n.test)]
    ignored = {id(inner) for node in for_types for inner in statements_within(node)}
    imports = [n for n in inside if isinstance(n, ast.ImportFrom) and n.level]
    assert {n.module for n in imports if id(n) not in ignored} <= {*done}
    assert not [name for name in done if name.startswith(("compiler", "problem"))]


@cache
def statements_of_library(name: str) -> list[str]:
    return statements(ast.parse(source_text(name)).body)


def statements_within(node: ast.AST) -> Iterator[ast.AST]:
    """A statement and all those inside it, without their expressions."""
    yield node
    for field in ("body", "orelse", "finalbody", "handlers", "cases"):
        for inner in getattr(node, field, ()):
            yield from statements_within(inner)


def statements(body: list[ast.stmt]) -> list[str]:
    """Statements as the bundler leaves them, docstrings without their indentation."""
    texts = []
    for node in body:
        for inner in statements_within(node):
            if isinstance(inner, ast.ImportFrom) and (inner.module or "").startswith("rankone."):
                inner.module = inner.module.removeprefix("rankone.")
            if isinstance(inner, ast.ImportFrom):
                inner.level = 0
            if isinstance(inner, ast.Expr) and isinstance(inner.value, ast.Constant):
                inner.value.value = inspect.cleandoc(str(inner.value.value))
        if isinstance(node, ast.AnnAssign):
            node = ast.Assign([node.target], node.value, lineno=1)
        texts.append(ast.dump(node))
    future = ast.dump(ast.parse("from __future__ import annotations").body[0])
    return [text for text in texts if text != future]


def test_tracebacks_and_pickles_name_the_modules_of_the_file(alone, folder):
    """A traceback shows lines of the file, a pickle of a solution is read in another process."""
    script = (
        "import inspect, pickle, traceback\n"
        "s = solver.solve(rtol=1e-3)\n"
        "open('s.pickle', 'wb').write(pickle.dumps(s))\n"
        "np.save('pickled.npy', s(t=1.0, x0=9.0, y0=5.0))\n"
        "assert type(s).__module__ == 'solver.solution.evaluation.event_times'\n"
        "assert inspect.getsource(type(s).save).lstrip().startswith('def save')\n"
        "try:\n    solver.solve(rtol=2)\n"
        "except solver.OptionError as error:\n"
        "    frame = traceback.extract_tb(error.__traceback__)[-1]\n"
        "    assert frame.filename == solver.__file__\n"
        "    lines = open(solver.__file__).read().splitlines()\n"
        "    assert frame.line == lines[frame.lineno - 1].strip() and 'raise' in frame.line"
    )
    (run,) = alone(folder, script)
    assert run.returncode == 0, run.stderr
    again = (
        "import pickle, sys\nsys.path.insert(0, '')\n"
        "s = pickle.loads(open('s.pickle', 'rb').read())\n"
        "import numpy as np\n"
        "assert np.array_equal(s(t=1.0, x0=9.0, y0=5.0), np.load('pickled.npy'))\n"
        "assert 'rankone' not in sys.modules and 'sympy' not in sys.modules"
    )
    run = started(folder, "-c", again)
    assert run.returncode == 0, run.stderr


def test_two_solvers_in_one_process_keep_apart(alone, folder):
    """Also one in a package, and one that is not registered as a module."""
    (folder / "package").mkdir()
    (folder / "package" / "second.py").write_bytes((folder / "solver.py").read_bytes())
    script = (
        "import importlib.util\n"
        "import package.second as second\n"
        "spec = importlib.util.spec_from_file_location('third', 'solver.py')\n"
        "third = importlib.util.module_from_spec(spec)\n"
        "spec.loader.exec_module(third)\n"
        "assert 'third' not in sys.modules\n"
        "solvers = solver, second, third\n"
        "assert len({each.OptionError for each in solvers}) == 3\n"
        "a, b, c = (each.solve(rtol=1e-3)(t=1, x0=9, y0=5) for each in solvers)\n"
        "assert np.array_equal(a, b) and np.array_equal(a, c)"
    )
    (run,) = alone(folder, script)
    assert run.returncode == 0, run.stderr


def test_a_solution_by_another_method_is_refused(alone, folder):
    greedy = compiled("lotka_volterra").solve(1e-2, method="greedy", effort=0.01)
    greedy.save(folder / "greedy.npz")
    run, shown = alone(folder, ["--load", "greedy.npz"], "print(repr(solver.solve(1e-3)))")
    assert run.returncode == 2
    assert "a solution by method='greedy', which is not known here" in run.stderr
    assert shown.stdout.startswith("Solution of x, y: success, the")


def test_long_texts_are_wrapped():
    terms = " + ".join(f"{k}*a**{k}*x" for k in range(1, 20))
    problem = ro.Problem.from_strings({"x": terms}, {"x": 1}, {"a": (0, 0.1)}, (0, 1))
    source = source_of(ro.compile(problem))
    front = source[: source.index("# Runtime: ")]
    assert max(map(len, front.splitlines())) <= 100
    metadata = source[source.index("METADATA = ") :]
    names = {"solvers__outcome": ir_metadata}
    exec(metadata[: metadata.index("\n)\n") + 3], names)
    assert names["METADATA"] == replace(ro.compile(problem).metadata(), source=None)


def test_grids_of_any_names_and_a_pole(alone, tmp_path):
    names = {"lambda_": (1, 2), "file": (1, 2)}
    problem = ro.Problem.from_strings({"x": "-lambda_*x/file"}, {"x": "1"}, names, (0, 1))
    ro.compile(problem).export(tmp_path / "solver.py")
    value = "print(solver.solve()({'t': 1, 'lambda_': 1.5, 'file': 2})[0])"
    grid = ["--rtol", "1e-3", "--grid", "3", "--save", "grid.npz"]
    inside, run, refused = alone(tmp_path, value, grid, ["--rtol", "1e-3", "--box", "file=-1:2"])
    assert float(inside.stdout) == pytest.approx(np.exp(-0.75), rel=1e-6)
    assert run.returncode == 0, run.stderr
    with np.load(tmp_path / "grid.npz") as arrays:
        assert set(arrays) == {"t", "lambda_", "file", "x"}
        assert arrays["x"].shape == (3, 3, 3)
        wanted = np.exp(-arrays["lambda_"][:, None] / arrays["file"])
        np.testing.assert_allclose(arrays["x"][-1], wanted, rtol=2e-3)
    assert refused.returncode == 2
    assert "not finite for `file` in [-1, 2]" in refused.stderr


def test_no_parameters(alone, tmp_path):
    problem = ro.Problem.from_strings(
        rhs={"x": "-x"}, initial={"x": "1"}, parameters={}, time=(0, 1)
    )
    ro.compile(problem).export(tmp_path / "solver.py")
    (run,) = alone(tmp_path, "print(solver.solve()(t=1)[0])")
    assert float(run.stdout) == pytest.approx(np.exp(-1), rel=1e-6)


def test_paths(tmp_path):
    problem = compiled("decay")
    file = problem.export(tmp_path / "solver.py")
    before = file.read_bytes()
    with pytest.raises(ExportError, match="exists"):
        problem.export(file)
    assert problem.export(file, overwrite=True).read_bytes() == before
    with pytest.raises(ExportError, match=r"'\.txt' names no target"):
        problem.export(tmp_path / "solver.txt")
    with pytest.raises(ExportError, match="names no target"):
        problem.export(tmp_path / "solver")
    with pytest.raises(ExportError, match="cannot be written"):
        problem.export(tmp_path / "nowhere" / "solver.py")
    with pytest.raises(OptionError, match="method='magic'"):
        problem.export(tmp_path / "other.py", method="magic")
    (tmp_path / "folder.py").mkdir()
    with pytest.raises(ExportError, match="it is a directory"):
        problem.export(tmp_path / "folder.py", overwrite=True)
    assert {path.name for path in tmp_path.iterdir()} == {"solver.py", "folder.py"}


def test_command_line(tmp_path, capsys):
    source = ROOT / "examples" / "decay.py"
    target = tmp_path / "solver.py"
    assert main(["export", str(source), "-o", str(target)]) == 0
    assert target.read_text() == source_of(compiled("decay"))
    assert main(["export", str(source), "-o", str(target)]) == 2
    assert "exists" in capsys.readouterr().err
    assert main(["export", str(source), "-o", str(target), "--overwrite"]) == 0


@pytest.mark.parametrize("name", ["numpy", "scipy", "sympy", "math", "random", "rankone"])
def test_files_that_would_hide_modules_are_refused(name, tmp_path):
    with pytest.raises(ExportError, match=rf"hide the module `{name}`.*such as my_{name}\.py"):
        compiled("decay").export(tmp_path / f"{name}.py")
    assert not list(tmp_path.iterdir())


def test_only_what_runs_counts_as_needed():
    modules = needed_modules(["rankone.tensors.train"])
    assert modules[-1] == "rankone.tensors.train"
    assert "rankone.support.arrays" in modules
    assert not [name for name in modules if name.startswith("rankone.solvers.engines")]


def test_unknown_roots_are_refused():
    with pytest.raises(ExportError, match="not at hand"):
        bundle(["rankone.tensors.nothing"])


@pytest.mark.slow
def test_switches_are_held_in_exported_solvers_as_in_the_library(alone, tmp_path):
    relay = ro.Problem.from_strings(
        {"x": "-x + 2 - 2*Heaviside(x - c)"}, {"x": 0}, {"c": (0.5, 1)}, (0, 3)
    )
    compiled = ro.compile(relay)
    compiled.export(tmp_path / "solver.py")
    wanted = compiled.solve(1e-3)
    script = (
        "s = solver.solve(rtol=1e-3)\n"
        "assert s.success, s.message\n"
        "np.save('values.npy', s(t=np.linspace(0, 3, 9), c=0.7))\n"
    )
    (run,) = alone(tmp_path, script)
    assert run.returncode == 0, run.stderr
    values = wanted(t=np.linspace(0, 3, 9), c=0.7)
    np.testing.assert_allclose(np.load(tmp_path / "values.npy"), values, rtol=1e-12, atol=1e-12)
