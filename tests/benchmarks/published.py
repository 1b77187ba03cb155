"""Solve every published system and print a Markdown table: python tests/benchmarks/published.py

For each system of tests/reference/published.py: dimensions (parameters and time), the method that
gave the solution, its rank, the measured error divided by the tolerance (256 random points × 21
times against independent trajectories, tests/reference/measure.py), the seconds of compiling and
solving, and the break-even: the solve time divided by the time of one ``solve_ivp`` trajectory at
the centre of the box (DOP853, or LSODA if stiff, rtol 1e-8; the right-hand side by SymPy's lambdify
on plain floats, faster than NumPy for small systems).

Verdicts: *ok*, ``success`` and within 5 × rtol; *wrong*, ``success`` but beyond; *refused*, an
error or ``success`` false, with the message; *failed*, the process died, ran out of time or broke
outside the solve. Every system runs in a process of its own with one BLAS thread.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import json
import multiprocessing
import sys
import time
from collections import Counter
from dataclasses import asdict, dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

WITHIN = 5.0
"""Measured error over tolerance up to which a solution counts as right."""
MEASURING = 600.0
"""Seconds allowed for the independent trajectories."""
VERDICTS = ("ok", "refused", "wrong", "failed")


@dataclass
class Row:
    """A line of the table."""

    system: str
    kind: str
    dimensions: int
    method: str = ""
    rank: int | None = None
    kept: float | None = None
    seconds: float | None = None
    break_even: float | None = None
    verdict: str = "failed"
    message: str = ""


def main() -> None:
    from tests.reference.published import PUBLISHED

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--method", help="the engine; the library's default if left out")
    parser.add_argument("--rtol", type=float, default=1e-4)
    parser.add_argument("--only", nargs="+", metavar="NAME", help="names or kinds, with wildcards")
    parser.add_argument("--seconds", type=float, default=60.0, help="limit of each solve")
    parser.add_argument("--json", metavar="PATH", type=Path, help="write the numbers to PATH")
    arguments = parser.parse_args()
    if arguments.seconds <= 0.0:
        parser.error("--seconds must be positive")

    chosen = [
        entry
        for entry in PUBLISHED.values()
        if not arguments.only
        or any(fnmatch(entry.name, p) or fnmatch(entry.kind, p) for p in arguments.only)
    ]
    if not chosen:
        parser.error(f"no system or kind matches {' '.join(arguments.only)}")
    rows = []
    for entry in chosen:
        row = Row(entry.name, entry.kind, 1 + len(entry.parameters))
        _run(row, arguments.method, arguments.rtol, arguments.seconds)
        print(f"{row.system}: {row.verdict} {row.message}".rstrip(), file=sys.stderr, flush=True)
        rows.append(row)
        if arguments.json:
            arguments.json.write_text(json.dumps([asdict(row) for row in rows], indent=2) + "\n")
    print(table(rows))
    print()
    print(summary(rows, arguments.rtol))


# -- one system, in its own process ---------------------------------------------------------------


def _run(row: Row, method: str | None, rtol: float, seconds: float) -> None:
    """Fill in a row from a child process, which is ended when its time is up."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    child = context.Process(target=_solve, args=(theirs, row.system, method, rtol), daemon=True)
    child.start()
    theirs.close()
    try:
        # imports and the trajectory at the centre, then the solve, then the measurement
        for stage, limit in (("start", MEASURING), ("solve", seconds), ("measure", MEASURING)):
            if not ours.poll(limit):
                row.verdict, row.message = "failed", f"{stage}: no answer in {limit:g} s"
                return
            facts = ours.recv()
            for key, value in facts.items():
                setattr(row, key, value)
            if row.message:
                return
    except EOFError:
        child.join()
        row.verdict, row.message = "failed", f"the process died (exit code {child.exitcode})"
    finally:
        child.kill()
        child.join()
        ours.close()


def _solve(pipe: Any, name: str, method: str | None, rtol: float) -> None:
    """In the child: three answers, each a dictionary of fields of the row."""
    import rankone as ro
    from tests.reference.measure import measured_errors
    from tests.reference.published import PUBLISHED

    entry = PUBLISHED[name]
    try:
        trajectory = _trajectory(entry)
    except Exception as error:
        pipe.send({"message": f"trajectory: {_text(error)}"})
        return
    pipe.send({})

    began = time.perf_counter()
    solution = None
    answer: dict[str, Any] = {}
    try:
        problem = entry.problem()
        solution = ro.solve(problem, rtol=rtol, **({"method": method} if method else {}))
    except ro.RankoneError as error:
        answer = {"verdict": "refused", "message": _text(error)}
    except Exception as error:
        answer = {"message": f"solve: {_text(error)}"}
    answer["seconds"] = time.perf_counter() - began
    if solution is not None:
        answer["method"] = getattr(solution, "method", None) or solution.metadata.method
        answer["rank"] = solution.rank
        answer["break_even"] = solution.timings.get("solve", answer["seconds"]) / trajectory
    pipe.send(answer)
    if solution is None:
        return

    try:
        kept = float(measured_errors(solution, entry.independent).max()) / rtol
    except Exception as error:
        if solution.success:
            pipe.send({"message": f"measurement: {_text(error)}"})
        else:
            pipe.send({"verdict": "refused", "message": solution.message})
        return
    if not solution.success:
        pipe.send({"kept": kept, "verdict": "refused", "message": solution.message})
    else:
        pipe.send({"kept": kept, "verdict": "ok" if kept <= WITHIN else "wrong"})


def _trajectory(entry: Any) -> float:
    """Seconds of one trajectory at the centre of the box, on plain floats: the least of three."""
    import numpy as np
    import scipy.integrate
    import sympy as sp

    import rankone as ro

    first, system = ro.first_order(entry.problem()), entry.independent
    clock, *parameters = (coordinate.symbol for coordinate in first.coordinates)
    generated = sp.lambdify([clock, first.functions, parameters], first.rhs, "math", cse=True)
    centre = np.array(system.box).mean(axis=1)
    start = np.array([float(value) for value in system.initial(centre)])
    values = centre.tolist()

    def rhs(t: float, u: Any) -> Any:
        return generated(t, u.tolist(), values)

    times = []
    for _ in range(3):
        began = time.perf_counter()
        result = scipy.integrate.solve_ivp(
            rhs,
            (system.start, system.end),
            start,
            method="LSODA" if system.stiff else "DOP853",
            rtol=1e-8,
            atol=1e-10 * np.array(system.sizes),
        )
        times.append(time.perf_counter() - began)
        if not result.success:
            raise RuntimeError(result.message)
    return min(times)


def _text(error: BaseException) -> str:
    lines = str(error).splitlines()
    return f"{type(error).__name__}: {' '.join(line.strip() for line in lines)}"


# -- the table ------------------------------------------------------------------------------------


def table(rows: list[Row]) -> str:
    """The rows in Markdown."""
    lines = [
        "| system | dimensions | method | rank | error kept | seconds | break-even | verdict |",
        "| --- | ---: | --- | ---: | ---: | ---: | ---: | --- |",
    ]
    for row in rows:
        verdict = row.verdict + (f": {_short(row.message)}" if row.message else "")
        cells = [
            row.system,
            str(row.dimensions),
            row.method,
            "" if row.rank is None else str(row.rank),
            _number(row.kept, ".2g"),
            _number(row.seconds, ".2f"),
            _number(row.break_even, ".0f"),
            verdict,
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def summary(rows: list[Row], rtol: float) -> str:
    """One line: how many of each verdict, and the total time."""
    count = Counter(row.verdict for row in rows)
    verdicts = ", ".join(f"{count[verdict]} {verdict}" for verdict in VERDICTS)
    seconds = sum(row.seconds or 0.0 for row in rows)
    share = count["ok"] / len(rows)
    return f"{len(rows)} systems at rtol {rtol:g}: {verdicts}; {share:.0%} ok; {seconds:.0f} s"


def _number(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


def _short(message: str, width: int = 100) -> str:
    message = message.replace("|", "\\|")
    return message if len(message) <= width else message[: width - 3] + "..."


if __name__ == "__main__":
    main()
