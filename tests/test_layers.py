"""Imports go one way: no circles, and numeric modules never need SymPy or the front end.

Every import counts, also those inside functions and those for type checkers alone.
"""

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

import rankone
from tests.problems import REFERENCE

SOURCE = Path(rankone.__file__).parent


def module_name(path):
    parts = ("rankone", *path.relative_to(SOURCE).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


PATHS = {module_name(path): path for path in sorted(SOURCE.rglob("*.py"))}


@cache
def imported(name):
    """What a module imports; ``from package import name`` is the submodule if there is one."""
    names = set()
    for node in ast.walk(ast.parse(PATHS[name].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            names.update(other if other in PATHS else node.module for other in inner)
    return names


@cache
def library():
    """For each module of the library the modules of the library that it imports."""
    return {name: {other for other in imported(name) if other in PATHS} for name in PATHS}


@cache
def sympy_users():
    """The modules that import SymPy themselves."""
    return {name for name in PATHS if any(m.split(".")[0] == "sympy" for m in imported(name))}


def reached(graph, start):
    """For each module on a path from the start the one before it."""
    before, waiting = {}, [start]
    while waiting:
        name = waiting.pop()
        for other in sorted(graph[name]):
            if other not in before:
                before[other] = name
                waiting.append(other)
    return before


def chain(before, start, end):
    """The path from one module to another as text."""
    path = [end]
    while path[-1] != start or len(path) == 1:
        path.append(before[path[-1]])
    return " -> ".join(reversed(path))


def circles(graph):
    """One circle for every module that is in some."""
    ways = {name: reached(graph, name) for name in graph}
    return {name: chain(way, name, name) for name, way in ways.items() if name in way}


def test_no_circles():
    assert not circles(library()), "\n".join(circles(library()).values())


def test_circles_are_found():
    graph = {"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": set(), "e": {"e"}}
    assert circles(graph) == {
        "a": "a -> b -> c -> a",
        "b": "b -> c -> a -> b",
        "c": "c -> a -> b -> c",
        "e": "e -> e",
    }


FRONT_END = re.compile(
    r"rankone\.(problem|compiler|inference\.calibration|share\.commands|__main__)(\.|$)"
    r"|rankone\.solution(\.[a-z_]+)?$"
)
"""Rooms that may reach SymPy, beside the package itself; of solutions what users hold."""
INNER = re.compile(r"rankone\.solution\.(evaluation|outputs|statistics|storage)")
REST = [
    name for name in PATHS if name != "rankone" and (INNER.match(name) or not FRONT_END.match(name))
]


def test_only_the_front_end_reaches_sympy():
    """Engines, solutions, files and exported models can do without it."""
    chains = []
    for name in REST:
        way = {name: name, **reached(library(), name)}
        chains += [chain(way, name, user) for user in sorted(sympy_users().intersection(way))[:1]]
    assert not chains, "\n".join(chains)


@pytest.mark.parametrize(
    "name",
    [
        "rankone.compiler.codegen",
        "rankone.compiler.codegen.layout",
        "rankone.trajectories.system.features",
    ],
)
def test_workers_load_a_system_without_sympy(name):
    """Importing SymPy would take each of them most of its start."""
    assert not sympy_users().intersection({name, *reached(library(), name)})


def room(name):
    """The folder of a module; a file beside the folders stands for itself."""
    return name.split(".")[1] if "." in name else name


APPLICATIONS = {"inference", "share"}
"""Rooms that methods of a solution open when they are called."""


def at_once(name):
    """What a module imports when it is imported itself."""
    return {
        f"{node.module}.{alias.name}" if f"{node.module}.{alias.name}" in PATHS else node.module
        for node in ast.parse(PATHS[name].read_text(encoding="utf-8")).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


def rooms():
    """For each room the rooms it imports from."""
    graph = {room(name): set() for name in PATHS}
    for name, others in library().items():
        entered = {room(other) for other in others}
        if room(name) == "solution":
            entered -= APPLICATIONS - {room(other) for other in at_once(name)}
        graph[room(name)] |= entered - {room(name)}
    return graph


def test_nine_rooms():
    assert len({room(name) for name in PATHS} - {"rankone", "__main__", "plotting"}) <= 9


def test_no_two_modules_share_a_name():
    names = [path.name for path in PATHS.values() if not path.name.startswith("__")]
    assert sorted(set(names)) == sorted(names)


def test_the_rooms_have_no_circle():
    assert not circles(rooms()), "\n".join(circles(rooms()).values())


def test_few_files_beside_the_rooms():
    assert len([path for path in SOURCE.iterdir() if path.is_file()]) <= 8


def test_only_the_printers_use_sympy_printing():
    users = {n for n in PATHS if any(m.startswith("sympy.printing") for m in imported(n))}
    assert users == {"rankone.compiler.codegen.printer", "rankone.problem.expressions.notation"}


@pytest.mark.parametrize("slow", ["scipy.stats", "scipy.signal"])
def test_scipy_imports_what_is_slow_where_it_is_first_used(slow):
    """``import scipy`` is enough for that; half of the time of ``import rankone`` otherwise."""
    assert not [name for name in PATHS if slow in imported(name)]


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
        "import rankone.support.budget, rankone.tensors.canonical\n"
        "from rankone.solution.solution import load\n"
        f"print(float(load({str(path)!r})(t=1.0, k=2.0)[0]))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert float(done.stdout) == float(solution(t=1.0, k=2.0)[0])


ROOMS = [path for path in sorted(SOURCE.rglob("__init__.py")) if path.parent != SOURCE]


@pytest.mark.parametrize("room", ROOMS, ids=lambda path: str(path.parent.relative_to(SOURCE)))
def test_rooms_list_their_modules(room):
    """What a room holds is listed in it."""
    listed = re.findall(r"^- ``(\w+)``", ast.get_docstring(ast.parse(room.read_text())), re.M)
    modules = [path.stem for path in room.parent.glob("*.py") if path.name != "__init__.py"]
    folders = [path.parent.name for path in room.parent.glob("*/__init__.py")]
    assert sorted(listed) == sorted(modules + folders)
