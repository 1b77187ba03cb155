"""Measure every reference problem and print a Markdown table: python tests/benchmarks/report.py

Two numbers matter. *Accuracy kept* is the measured error divided by the tolerance asked for, on
256 random points × 21 times against independent trajectories (tests/reference). *Break-even* is the
solve time divided by the time of one ``scipy.integrate.solve_ivp(method="DOP853", rtol=1e-8)``
trajectory at the centre of the box (for the stiff Robertson problem the faster of Radau with its
Jacobian and LSODA): after that many parameter values rankone has paid for itself against a loop.
*Stacked* is the same against one of 500 trajectories integrated by SciPy as one stacked system at
rtol 1e-8, which is what an expert would do instead of a loop.

Each problem runs in a process of its own with one BLAS thread. Times are the least of
repetitions made in turns, except that of the compile stage, which is the first one in its process:
SymPy caches.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import datetime
import json
import platform
import re
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

SMOOTH = ("decay", "linear", "free_fall", "coupled", "lotka_volterra")
BARS = [(name, rtol) for name in SMOOTH for rtol in (1e-3, 1e-6, 1e-8)] + [
    ("kirchhoff", 1e-4),
    ("kirchhoff_long", 1e-3),
    ("robertson", 1e-4),
    ("chain", 1e-3),
    ("chain", 1e-4),
]
QUICK = [("linear", 1e-6), ("coupled", 1e-6), ("lotka_volterra", 1e-6), ("kirchhoff", 1e-4)]
TITLES = {
    "decay": "decay",
    "linear": "linear",
    "free_fall": "free fall",
    "coupled": "coupled",
    "lotka_volterra": "Lotka–Volterra, T = 6",
    "kirchhoff": "Kirchhoff, T = 1",
    "kirchhoff_long": "Kirchhoff, T = 3",
    "robertson": "Robertson (stiff), T = 40",
    "chain": "ten compartments, T = 5",
}
STACKED = 500
"""Trajectories in a stack."""
COST = re.compile(r"costs as much as (\d+) to (\d+) traj")
"""What the README says of the break-even."""
RUN_ENOUGH = 2.0
"""Seconds after which a measurement is not repeated any more (three repetitions at least)."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="four problems, fewer repetitions")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="problems, such as kirchhoff")
    parser.add_argument("--json", metavar="PATH", type=Path, help="write the numbers to PATH")
    parser.add_argument(
        "--update", action="store_true", help="write docs/measured.md and the README's sentence"
    )
    parser.add_argument("--method", default="auto", help="the engine (default: %(default)s)")
    parser.add_argument("--one", nargs=4, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        name, rtol, repetitions, method = arguments.one
        print(json.dumps(_measure(name, float(rtol), int(repetitions), method)))
        return
    if arguments.only and arguments.update:
        parser.error("--update needs all problems")
    rows = []
    for name, rtol in QUICK if arguments.quick else BARS:
        if arguments.only and name not in arguments.only:
            continue
        _say(f"{TITLES[name]} at {rtol:g} ...")
        command = ["--one", name, repr(rtol), "3" if arguments.quick else "9"]
        command.append(arguments.method)
        rows.append(json.loads(_python(str(Path(__file__)), *command)))
    _say("imports ...")
    report = {"machine": machine(), "import": _import_times(), "problems": rows}
    text = _markdown(report)
    print(text)
    if arguments.update:
        update(ROOT / "docs" / "measured.md", text)
        _update_readme([row["break_even"] for row in rows])
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=2) + "\n")


# -- one problem, in its own process ------------------------------------------------------------


def _measure(name: str, rtol: float, repetitions: int, method: str) -> dict[str, Any]:
    """All numbers of one problem and tolerance."""
    import scipy.integrate  # noqa: F401 - part of the baseline

    import rankone as ro
    from tests.problems import MEASURED

    problem = MEASURED[name]()
    baseline = _peak_memory()
    began = time.perf_counter()
    compiled = ro.compile(problem)
    compile_seconds = time.perf_counter() - began
    solution = compiled.solve(rtol, method=method)
    peak = _peak_memory()

    from tests.reference.measure import measured_errors
    from tests.reference.systems import INDEPENDENT

    system = INDEPENDENT[name]
    error = float(measured_errors(solution, system).max())
    loop = _trajectory(compiled.system, system.stiff)
    runs = [lambda: compiled.solve(rtol, method=method), _stack(compiled.system, system.stiff)]
    solve, stacked, *single = _fastest(*runs, *loop.values(), repetitions=repetitions)
    trajectory, integrator = min(zip(single, loop, strict=True))
    stacked /= STACKED
    batch, one = _evaluation(solution, repetitions)
    return {
        "problem": name,
        "rtol": rtol,
        "success": solution.success,
        "error": error,
        "error_seen": solution.error,
        "corner_error": solution.corner_error,
        "accuracy_kept": error / rtol,
        "solve_seconds": solve,
        "trajectory_seconds": trajectory,
        "trajectory_method": integrator,
        "break_even": solve / trajectory,
        "method": solution.method,
        "stacked_seconds": stacked,
        "break_even_stacked": solve / stacked,
        "compile_seconds": compile_seconds,
        "slabs": len(solution.ranks),
        "ranks": [max(column) for column in zip(*solution.ranks, strict=True)],
        "nodes": list(solution.nodes),
        "bytes": solution.nbytes,
        "baseline_mib": baseline,
        "peak_mib": peak,
        "batch_points_per_second": batch,
        "one_point_milliseconds": one,
    }


def _trajectory(system: Any, stiff: bool) -> dict[str, Callable[[], object]]:
    """One trajectory at the centre of the box, by the generated right-hand side, and the method."""
    import numpy as np
    from scipy.integrate import solve_ivp

    centre = np.array(system.box).mean(axis=1)
    start = system.initial(centre[:, None])[:, 0]

    def rhs(t: float, u: Any) -> Any:
        return system.rhs(t, u, centre)

    def jacobian(t: float, u: Any) -> Any:
        return system.jacobian(t, u, centre)

    choices: dict[str, dict[str, Any]] = {"DOP853": {}}
    if stiff:
        choices = {"Radau": {"jac": jacobian, "atol": 1e-10}, "LSODA": {"atol": 1e-10}}
    return {
        method: partial(solve_ivp, rhs, system.horizon, start, method=method, rtol=1e-8, **options)
        for method, options in choices.items()
    }


def _stack(system: Any, stiff: bool) -> Callable[[], object]:
    """Trajectories at random points of the box in one stack, by SciPy as it is."""
    import numpy as np
    from scipy.integrate import solve_ivp
    from scipy.sparse import eye_array, kron

    lower, upper = np.array(system.box).T
    points = np.random.default_rng(0).uniform(lower, upper, (STACKED, lower.size)).T
    start = system.initial(points)
    n = len(start)
    options: dict[str, Any] = {"method": "DOP853"}
    if stiff:
        blocks = kron(np.ones((n, n)), eye_array(STACKED))
        options = {"method": "Radau", "jac_sparsity": blocks, "atol": 1e-10}

    def rhs(t: float, u: Any) -> Any:
        return system.rhs(t, u.reshape(n, -1), points).ravel()

    return partial(solve_ivp, rhs, system.horizon, start.ravel(), rtol=1e-8, **options)


def _evaluation(solution: Any, repetitions: int) -> tuple[float, float]:
    """Points per second in a batch of random points, and milliseconds for a single point."""
    import numpy as np

    rng = np.random.default_rng(0)
    count = 20_000
    intervals = {solution.metadata.time: solution.time, **solution.parameters}
    batch = {key: rng.uniform(*interval, count) for key, interval in intervals.items()}
    point = {key: float(values[0]) for key, values in batch.items()}
    solution(batch)
    runs = (lambda: solution(batch), lambda: [solution(point) for _ in range(100)])
    seconds, single = _fastest(*runs, repetitions=repetitions)
    return count / seconds, 10.0 * single


def _fastest(*runs: Callable[[], object], repetitions: int) -> list[float]:
    """Least seconds of calls made in turns; slow ones are repeated less often."""
    seconds: list[list[float]] = [[] for _ in runs]
    for number in range(repetitions):
        if number >= 3 and sum(map(sum, seconds)) > RUN_ENOUGH * len(runs):
            break
        for run, spent in zip(runs, seconds, strict=True):
            began = time.perf_counter()
            run()
            spent.append(time.perf_counter() - began)
    return [min(spent) for spent in seconds]


def _peak_memory() -> float:
    """Peak resident memory of this process so far, in MiB."""
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


# -- imports, in fresh processes ------------------------------------------------------------------


def _import_times() -> dict[str, float]:
    """Seconds to import rankone, and sympy with scipy.integrate: medians of five, interleaved."""
    clock = "import time; began = time.perf_counter()\n{}\nprint(time.perf_counter() - began)"
    statements = {"rankone": "import rankone", "baseline": "import sympy, scipy.integrate"}
    times: dict[str, list[float]] = {key: [] for key in statements}
    for repetition in range(6):
        for key, statement in statements.items():
            seconds = float(_python("-c", clock.format(statement)))
            if repetition:  # the first one reads from disk
                times[key].append(seconds)
    medians = {key: statistics.median(values) for key, values in times.items()}
    return {**medians, "ratio": medians["rankone"] / medians["baseline"]}


def _python(*arguments: str) -> str:
    paths = [str(ROOT / "src"), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    run = subprocess.run(
        [sys.executable, *arguments], stdout=subprocess.PIPE, text=True, check=True, env=environment
    )
    return run.stdout


# -- the report -----------------------------------------------------------------------------------


def update(path: Path, text: str) -> None:
    """Replace what is between the marks ``<!-- measured -->`` of a file."""
    before, _, rest = path.read_text().partition("<!-- measured -->\n")
    _, mark, after = rest.partition("<!-- /measured -->\n")
    assert mark, f"no marks in {path}"
    path.write_text(f"{before}<!-- measured -->\n{text}\n{mark}{after}")


def _update_readme(break_even: list[float]) -> None:
    """Write the least and the largest break-even into the README."""
    path = ROOT / "README.md"
    least, most = min(break_even), max(break_even)
    text, count = COST.subn(f"costs as much as {least:.0f} to {most:.0f} traj", path.read_text())
    assert count == 1, f"no sentence in {path}"
    path.write_text(text)


def machine() -> dict[str, str]:
    from importlib.metadata import version

    return {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "system": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "python": f"Python {platform.python_version()}",
        **{name: f"{name} {version(name)}" for name in ("numpy", "scipy", "sympy")},
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or "unknown"
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else "unknown"


def _markdown(report: dict[str, Any]) -> str:
    header = [
        [
            *("problem", "rtol", "method", "accuracy kept", "break-even", "stacked", "slabs"),
            *("ranks", "corner error ÷ rtol"),
        ],
        ["problem", "rtol", "solve", "trajectory", "compile", "memory", "batch", "one point"],
    ]
    ratios, absolute = [], []
    for row in report["problems"]:
        title, rtol = TITLES[row["problem"]], f"{row['rtol']:.0e}".replace("e-0", "e-")
        ratios.append(
            [
                title,
                rtol,
                row["method"],
                f"{row['accuracy_kept']:.2g}" + ("" if row["success"] else " (no success)"),
                f"{row['break_even']:.0f}",
                f"{row['break_even_stacked']:.0f}",
                str(row["slabs"]),
                ", ".join(map(str, row["ranks"])),
                f"{row['corner_error'] / row['rtol']:.2g}",
            ]
        )
        own = row["peak_mib"] - row["baseline_mib"]
        absolute.append(
            [
                title,
                rtol,
                _seconds(row["solve_seconds"]),
                f"{_seconds(row['trajectory_seconds'])} ({row['trajectory_method']})",
                _seconds(row["compile_seconds"]),
                f"{own:.0f} MiB above {row['baseline_mib']:.0f} MiB",
                f"{row['batch_points_per_second']:.1e}/s".replace("e+0", "e"),
                f"{row['one_point_milliseconds']:.3f} ms",
            ]
        )
    imports, machine = report["import"], report["machine"]
    return "\n".join(
        [
            *_table(header[0], ratios),
            "",
            "The same in absolute numbers; memory is the peak of a process that solves once, above "
            "the same process after importing rankone:",
            "",
            *_table(header[1], absolute),
            "",
            f"Import: rankone {imports['rankone']:.2f} s, sympy and scipy.integrate "
            f"{imports['baseline']:.2f} s, ratio {imports['ratio']:.2f}.",
            "",
            "Measured on " + ", ".join(machine.values()) + ".",
        ]
    )


def _table(header: list[str], rows: list[list[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    left = {"problem", "method", "ranks", "trajectory", "memory"}

    def line(cells: list[str]) -> str:
        padded = [
            cell.ljust(width) if title in left else cell.rjust(width)
            for cell, width, title in zip(cells, widths, header, strict=True)
        ]
        return "| " + " | ".join(padded) + " |"

    rule = [
        "-" * width if title in left else "-" * (width - 1) + ":"
        for width, title in zip(widths, header, strict=True)
    ]
    return [line(header), line(rule), *map(line, rows)]


def _seconds(value: float) -> str:
    return f"{1e3 * value:.3g} ms" if value < 1.0 else f"{value:.3g} s"


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
