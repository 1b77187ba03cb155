"""Wall clock of the exported targets: ``python tests/benchmarks/export.py``.

Import time and length of the standalone solver, and the time of one evaluation of the C model
against the Python call, on one core. With ``--events`` the latter alone, for systems with events.
"""

from __future__ import annotations

import argparse
import ctypes
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parents[2] / "src")]

import rankone as ro  # noqa: E402
from tests.benchmarks.events import SYSTEMS  # noqa: E402
from tests.problems import EXAMPLES  # noqa: E402

REPEATS = 7
LOOP = r"""
#include "model.h"
/* one call after the other, as a program would make them */
int loop(size_t count, const model_real *p, const model_real *t, model_real *u)
{
    size_t k;
    int status = 0;
    for (k = 0; k < count; k++)
        status |= model_eval(p + k * MODEL_PARAMETERS, t[k], u + k * MODEL_UNKNOWNS);
    return status;
}
"""


def best(run: Callable[[], object], count: int) -> float:
    """Median over the repeats of the processor seconds per item."""
    seconds = []
    for _ in range(REPEATS):
        began = time.process_time()
        run()
        seconds.append((time.process_time() - began) / count)
    return statistics.median(seconds)


def import_time(folder: Path) -> float:
    """Seconds to import the solver once NumPy and SciPy are there."""
    script = (
        "import time, numpy, scipy.integrate, scipy.linalg, scipy.sparse\n"
        "began = time.perf_counter()\nimport solver\nprint(time.perf_counter() - began)"
    )
    command = [sys.executable, "-B", "-c", script]
    runs = [subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)]
    runs += [subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)]
    return min(float(run.stdout) for run in runs)


def c_times(solution: ro.Solution, folder: Path, flags: list[str], real: type) -> float:
    """Seconds of one call of the C model."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    assert compiler, "no C compiler"
    (folder / "loop.c").write_text(LOOP)
    library = folder / f"model{abs(hash(tuple(flags)))}.so"
    sources = [str(folder / "model.c"), str(folder / "loop.c")]
    command = [compiler, "-std=c99", *flags, "-shared", "-fPIC", "-o", str(library), *sources]
    subprocess.run(command, check=True)
    loop = ctypes.CDLL(str(library)).loop
    count = 20_000
    rng = np.random.default_rng(0)
    bounds = np.array([solution.time, *solution.parameters.values()])
    points = (bounds[:, :1] + np.diff(bounds) * rng.random((len(bounds), count))).astype(real)
    t, p = np.ascontiguousarray(points[0]), np.ascontiguousarray(points[1:].T)
    u = np.empty((count, len(solution.unknowns)), dtype=real)
    arguments = [ctypes.c_void_p(array.ctypes.data) for array in (p, t, u)]
    assert loop(ctypes.c_size_t(count), *arguments) == 0
    return best(lambda: loop(ctypes.c_size_t(count), *arguments), count)


def python_time(solution: ro.Solution) -> float:
    """Seconds of one call of the solution with numbers, by keyword."""
    rng = np.random.default_rng(0)
    bounds = {solution.metadata.time: solution.time, **solution.parameters}
    calls = [
        {name: float(a + (b - a) * rng.random()) for name, (a, b) in bounds.items()}
        for _ in range(2000)
    ]

    def run() -> None:
        for call in calls:
            solution(**call)

    return best(run, len(calls))


def print_calls(solution: ro.Solution, folder: Path) -> None:
    """Print the times of one call from Python and in C."""
    solution.export(folder / "model.c")
    python = python_time(solution)
    print(f"  Python call {python * 1e6:.1f} us")
    for flags, real in (
        (["-O2"], np.float64),
        (["-O3", "-march=native"], np.float64),
        (["-O3", "-march=native", "-DMODEL_FLOAT"], np.float32),
    ):
        c = c_times(solution, folder, flags, real)
        print(f"  C {c * 1e6:6.2f} us, {python / c:5.1f} x, {1 / c:.2g} points/s: {flags}")


def with_events() -> None:
    for name, (system, rtol) in SYSTEMS.items():
        with tempfile.TemporaryDirectory() as place:
            solution = ro.solve(system, rtol=rtol)
            parameters = len(solution.parameters)
            print(f"{name}: {solution.timeline.stretches} stretches, {parameters} parameters")
            print_calls(solution, Path(place))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--events", action="store_true")
    if parser.parse_args().events:
        with_events()
        return
    for name, example in EXAMPLES.items():
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            compiled = ro.compile(example.problem)
            began = time.perf_counter()
            path = compiled.export(folder / "solver.py")
            seconds = time.perf_counter() - began
            lines = path.read_text().count("\n")
            print(f"{name}: solver {lines} lines, written in {seconds:.2f} s", end=", ")
            print(f"imported in {import_time(folder):.3f} s beyond NumPy and SciPy")
            print_calls(compiled.solve(rtol=example.RTOL), folder)


if __name__ == "__main__":
    main()
