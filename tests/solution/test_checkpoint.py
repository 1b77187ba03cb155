"""Finished solves on disk: the same bits after an end at any moment, and refusals by name."""

import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
import sympy as sp
from scipy.interpolate import CubicSpline

import rankone as ro
from rankone.solution.checkpoint import problem_digest
from rankone.solution.many import solve_many

TIMES = np.linspace(0, 2, 5)


def problem(rate="-k*u", **options):
    box = {"k": (0.5, 5)}
    return ro.Problem.from_strings({"u": rate}, {"u": "1"}, box, (0, 2), **options)


def bits(solutions):
    middles = [{n: 0.5 * sum(ends) for n, ends in s.parameters.items()} for s in solutions]
    return [s(TIMES, middle).tobytes() for s, middle in zip(solutions, middles)]


@pytest.fixture
def solved(monkeypatch):
    """Counts solves."""
    counted = []
    solve = ro.CompiledProblem.solve

    def counting(self, *arguments, **options):
        counted.append(options)
        return solve(self, *arguments, **options)

    monkeypatch.setattr(ro.CompiledProblem, "solve", counting)
    return counted


def test_finished_solves_are_read_and_not_solved_again(tmp_path, solved):
    boxes = problem().split(k=3)
    first = solve_many(problem(), boxes[:2], 1e-6, checkpoint=tmp_path / "run")
    assert len(solved) == 2
    again = solve_many(problem(), boxes, 1e-6, checkpoint=tmp_path / "run")
    assert len(solved) == 3
    assert bits(again)[:2] == bits(first)
    assert bits(again) == bits(solve_many(problem(), boxes, 1e-6))
    assert again.join().success


def test_an_interrupt_keeps_what_is_finished(tmp_path, solved):
    boxes = problem().split(k=3)

    def interrupting(done, total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        solve_many(problem(), boxes, 1e-6, checkpoint=tmp_path, progress=interrupting)
    solve_many(problem(), boxes, 1e-6, checkpoint=tmp_path)
    assert len(solved) == 3


@pytest.mark.parametrize("damage", [b"", b"no archive", None])
def test_damaged_files_are_solved_again(tmp_path, solved, damage):
    boxes = problem().split(k=2)
    first = solve_many(problem(), boxes, 1e-6, checkpoint=tmp_path)
    path = sorted(tmp_path.glob("solve-*"))[0]
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content if damage is None else damage)
    with pytest.warns(ro.RankoneWarning, match="is solved again"):
        again = solve_many(problem(), boxes, 1e-6, checkpoint=tmp_path)
    assert len(solved) == 3
    assert bits(again) == bits(first)
    assert ro.load(path).success


def test_a_damaged_manifest_is_written_again(tmp_path, solved):
    boxes = problem().split(k=2)
    solve_many(problem(), boxes, 1e-4, checkpoint=tmp_path)
    (tmp_path / "checkpoint.json").write_text("{")
    solve_many(problem(), boxes, 1e-4, checkpoint=tmp_path)
    assert len(solved) == 2
    json.loads((tmp_path / "checkpoint.json").read_text())


@pytest.mark.parametrize(
    ("other", "options", "text"),
    [
        (problem("-2*k*u", name="twice"), {}, r"problem decay \(.*not of twice \("),
        (problem(name="decay").set(k=1.0), {}, "is of the problem decay"),
        (problem(name="decay").vary(k=(1, 2)), {}, "another box, horizon, function or detail"),
        (problem(name="decay"), {"rtol": 1e-5}, "rtol=0.0001, not 1e-05"),
        (problem(name="decay"), {"method": "train"}, "method=None, not 'train'"),
    ],
)
def test_other_problems_and_options_are_refused(tmp_path, other, options, text):
    decay = problem(name="decay")
    solve_many(decay, [{}], 1e-4, checkpoint=tmp_path)
    with pytest.raises(ro.StorageError, match=text):
        solve_many(other, [{}], **{"rtol": 1e-4, **options}, checkpoint=tmp_path)


@pytest.mark.slow
def test_more_memory_solves_what_lacked_it_and_nothing_else(tmp_path, solved):
    """The limit may change: solutions are kept, and what failed for lack of memory is tried."""
    rates = {f"x{i}": f"k*x{i - 1} - k*x{i}" if i else "-k*x0" for i in range(400)}
    initial = {name: "1" if name == "x0" else "0" for name in rates}
    chain = ro.Problem.from_strings(rates, initial, {"k": (1, 2)}, (0, 1))
    options = {"rtol": 1e-2, "unknowns": ["x3"], "check": 8, "checkpoint": tmp_path}
    refused = solve_many(chain, [{}], max_memory="50MB", **options)
    assert refused.statuses == (ro.Status.MEMORY_LIMIT,)
    again = solve_many(chain, [{}], max_memory="50MB", **options)
    assert again.statuses == refused.statuses
    assert len(solved) == 1
    more = solve_many(chain, [{}], max_memory="1GB", **options)
    assert more.success
    assert len(solved) == 2
    assert solve_many(chain, [{}], max_memory="51MB", **options).success
    assert solve_many(chain, [{}], **options).success
    assert len(solved) == 2


def test_another_version_is_refused(tmp_path, monkeypatch):
    solve_many(problem(), [{}], 1e-4, checkpoint=tmp_path)
    monkeypatch.setattr("rankone.solution.checkpoint.__version__", "99")
    with pytest.raises(ro.StorageError, match="and this is 99"):
        solve_many(problem(), [{}], 1e-4, checkpoint=tmp_path)


def test_conditions_are_told_apart(tmp_path, solved):
    source = problem("-k*u + c", constants={"c": 0.0})
    many = solve_many(source, [{"c": 0.0}, {"c": 1.0}], 1e-4, checkpoint=tmp_path)
    assert len({*bits(many)}) == 2
    assert bits(solve_many(source, [{"c": 1.0}, {"c": 0.0}], 1e-4, checkpoint=tmp_path)) == [
        *reversed(bits(many))
    ]
    assert len(solved) == 2


def with_function(value):
    """A problem with a function of the user."""
    t, k = sp.symbols("t k")
    u = sp.Function("u")(t)
    f = ro.function("f", value, lambda x: np.ones_like(x))
    return ro.Problem([sp.Eq(u.diff(t), -k * f(u))], (t, 0, 2), {k: (1, 2)}, {u: 1})


def scaled(factor, x):
    return factor * x


class Line:
    """A callable object that counts by its state."""

    def __init__(self, factor):
        self.factor = factor

    def __call__(self, x):
        return self.factor * x

    def value(self, x):
        return self(x)


def enclosed(held):
    return lambda x: held(x)


def spline(factor):
    nodes = np.linspace(-1, 2, 4)
    return CubicSpline(nodes, factor * nodes)


def with_default(factor):
    return lambda x, factor=factor: factor * x


def with_cache(factor):
    slope = cache(partial(scaled, factor))
    return lambda x: slope(1.0) * x


GLOBALS = """
def slope(x):
    return table(1.0) * x

def f(x):
    return [slope(each) for each in [x]][0]
"""
CLASS = """
class Held:
    def __call__(self, x):
        return self.slope * x

    @property
    def slope(self):
        return {factor}
"""


def with_global(factor):
    """A function that reads a table through another one, both as global variables."""
    namespace = {"table": spline(factor)}
    exec(GLOBALS, namespace)
    return namespace["f"]


def with_property(factor):
    namespace = {}
    exec(CLASS.format(factor=factor), namespace)
    return namespace["Held"]()


@pytest.mark.parametrize(
    "function",
    [
        lambda factor: (lambda x: 1.0 * x) if factor == 1.0 else (lambda x: 2.0 * x),
        spline,
        Line,
        with_default,
        lambda factor: partial(scaled, factor),
        lambda factor: Line(factor).value,
        lambda factor: enclosed(spline(factor)),
        lambda factor: enclosed(partial(scaled, factor)),
        with_cache,
        lambda factor: enclosed(enclosed(Line(factor).value)),
        lambda factor: enclosed(Line(np.full((), factor))),
        with_global,
        with_property,
    ],
    ids=[
        *("code", "spline", "object", "default", "partial", "method"),
        *("closure-spline", "closure-partial", "closure-cache"),
        *("closure-method", "closure-object", "global", "property"),
    ],
)
def test_functions_of_the_user_count_by_their_code_and_state(function):
    first = problem_digest(ro.compile(with_function(function(1.0))))
    assert first == problem_digest(ro.compile(with_function(function(1.0))))
    assert first != problem_digest(ro.compile(with_function(function(2.0))))


@pytest.mark.parametrize("function", [spline, lambda factor: partial(scaled, factor)])
def test_the_folder_of_another_function_is_refused(tmp_path, solved, function):
    solve_many(with_function(function(1.0)), [{}], 1e-3, checkpoint=tmp_path)
    solve_many(with_function(function(1.0)), [{}], 1e-3, checkpoint=tmp_path)
    assert len(solved) == 1
    with pytest.raises(ro.StorageError, match="another box, horizon, function or detail"):
        solve_many(with_function(function(2.0)), [{}], 1e-3, checkpoint=tmp_path)


DIGEST = """
    import math
    from functools import cache, partial
    import numpy as np
    from scipy.interpolate import CubicSpline
    from rankone.solution.checkpoint import function_digest

    class Held:
        def __call__(self, x):
            return x

    def enclosed():
        import numpy
        nodes = np.linspace(0, 1, 5)
        spline, words, held = CubicSpline(nodes, nodes**2), {"a", "b", "c", "d"}, Held()

        def again(x, depth):
            return again(x, depth - 1) if depth else numpy.interp(x, nodes, spline(nodes))

        def f(x):
            if str(x) in {"one", "two", "three", "four"} or len(words) == 3:
                return later
            return again(held(x), 2) + math.pi

        if nodes.size == 0:
            later = 0
        return partial(f)

    print(function_digest("f", enclosed()))
"""


@pytest.mark.slow
def test_closures_are_the_same_in_two_processes():
    """With other hashes, and other addresses; sets and functions that call themselves included."""

    def printed(seed):
        call = [sys.executable, "-c", text]
        environment = {**os.environ, "PYTHONHASHSEED": seed}
        return subprocess.run(call, env=environment, capture_output=True, text=True, check=True)

    text = textwrap.dedent(DIGEST)
    assert printed("1").stdout == printed("2").stdout != ""


def test_functions_whose_state_cannot_be_read(tmp_path):
    with open(tmp_path / "file", "w") as file:
        held = with_function(lambda x: x if file else -x)
        text = "checkpoint= cannot tell function `f` from another.*leave out checkpoint="
        with pytest.raises(ro.OptionError, match=text):
            solve_many(held, [{}], 1e-4, checkpoint=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_folders_that_cannot_be_used(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ro.StorageError, match="cannot be used"):
        solve_many(problem(), [{}], 1e-4, checkpoint=tmp_path / "file")
    with pytest.raises(ro.StorageError, match="is empty text"):
        solve_many(problem(), [{}], 1e-4, checkpoint="")
    with pytest.raises(ro.StorageError, match="is not a path"):
        solve_many(problem(), [{}], 1e-4, checkpoint=3)


def test_a_blow_up_is_kept_too(tmp_path, solved):
    grown = ro.Problem.from_strings({"u": "u**2"}, {"u": "a"}, {"a": (0.5, 2)}, (0, 1))
    first = solve_many(grown, [{}], 1e-4, checkpoint=tmp_path)
    again = solve_many(grown, [{}], 1e-4, checkpoint=tmp_path)
    assert first.statuses == again.statuses == (ro.Status.BLOW_UP,)
    assert len(solved) == 1


SCRIPT = """
    import sys, time
    import rankone as ro

    def main():
        problem = ro.Problem.from_strings({"u": "-k*u"}, {"u": "1"}, {"k": (0.5, 5)}, (0, 2))

        def slowly(done, total):
            print(done, flush=True)
            time.sleep(0.2)

        many = ro.solve_many(problem, problem.split(k=6), 1e-6, executor=2,
                             checkpoint=sys.argv[1], progress=slowly)
        print([s(1.0, k=s.parameters["k"][0])[0].hex() for s in many], flush=True)

    if __name__ == "__main__":
        main()
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
def test_killed_processes_and_the_same_bits(tmp_path):
    """The main process, then a worker: workers end with it, and no finished file changes."""
    script = tmp_path / "script.py"
    script.write_text(textwrap.dedent(SCRIPT))
    call = [sys.executable, str(script), str(tmp_path / "run")]

    def started():
        main = subprocess.Popen(call, stdout=subprocess.PIPE, text=True)
        return main, main.stdout.readline()

    main, _ = started()
    workers = workers_of(main.pid)
    assert len(workers) == 2
    main.kill()
    main.wait()
    end = time.monotonic() + 60.0
    while any(Path(f"/proc/{pid}").exists() for pid in workers) and time.monotonic() < end:
        time.sleep(0.05)
    assert not any(Path(f"/proc/{pid}").exists() for pid in workers)
    finished = {path: path.stat().st_mtime_ns for path in (tmp_path / "run").glob("solve-*")}
    assert finished
    main, first = started()
    assert int(first) >= 1
    for pid in workers_of(main.pid):
        os.kill(pid, signal.SIGKILL)
    lines = main.stdout.read().splitlines()
    assert main.wait() == 0
    assert all(path.stat().st_mtime_ns == at for path, at in finished.items())
    whole = solve_many(problem(), problem().split(k=6), 1e-6)
    assert lines[-1] == str([s(1.0, k=s.parameters["k"][0])[0].hex() for s in whole])


def workers_of(pid):
    """The processes that a process started to work."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == pid and "spawn_main" in (folder / "cmdline").read_text():
                found.append(int(folder.name))
        except (OSError, ValueError):
            continue
    return found
