"""What the suites of tests/benchmarks share: a process for each system, its verdict, the table.

Verdicts: *ok*, ``success`` and within 5 × rtol of independent trajectories; *wrong*, ``success``
but beyond; *refused*, an error or ``success`` false, with the message; *failed*, the process died
or broke outside the solve.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import json
import multiprocessing
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from fnmatch import fnmatch
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

import rankone as ro  # noqa: E402
from rankone.support.budget import effort_of, limited, operations_for  # noqa: E402
from tests.reference.stated import Stated  # noqa: E402

WITHIN = 5.0
"""Measured error over tolerance up to which a solution counts as right."""
LIMIT = 900.0
"""Seconds allowed for a system; what takes longer has failed."""
VERDICTS = ("ok", "refused", "wrong", "failed")


@dataclass(frozen=True)
class Case:
    """A system of a suite, and how to solve it."""

    module: str
    name: str
    rtol: float
    effort: str | float
    method: str


@dataclass
class Row:
    """A line of the table."""

    system: str
    rtol: float
    dimensions: str = ""
    method: str = ""
    rank: int | None = None
    attempts: int | None = None
    kept: float | None = None
    work: float = 0.0
    shares: dict[str, float] = field(default_factory=dict)
    seconds: float = 0.0
    verdict: str = "failed"
    message: str = ""

    def solved(self, system: Stated, case: Case) -> None:
        """Solve the system and compare the solution with independent trajectories."""
        problem, budget = system.problem(), operations_for(case.effort)
        self.dimensions = f"{len(system.rates)} × {len(system.parameters)}"
        began = time.process_time()
        with limited() as account:
            try:
                solution = ro.solve(problem, case.rtol, effort=case.effort, method=case.method)
            except ro.RankoneError as error:
                self.verdict, self.message = "refused", f"{type(error).__name__}: {error}"
                solution = getattr(error, "solution", None)
        self.seconds, self.work = time.process_time() - began, account.done / budget
        if solution is None:
            return
        self.method, self.rank = solution.method, solution.rank
        self.shares = {stage: done / budget for stage, done in solution.work.items()}
        self.attempts = len({record.attempt for record in solution.history})
        if self.message:
            return
        if not solution.success:
            self.verdict, self.message, self.kept = (
                "refused",
                solution.message,
                solution.error / case.rtol,
            )
            return
        self.kept = float(system.errors(solution).max()) / case.rtol
        self.verdict = "ok" if self.kept <= WITHIN else "wrong"


Fill = Callable[[Row, Stated, Case], None]


def main(
    description: str,
    module: str,
    rtols: Sequence[float],
    method: str = "auto",
    fill: Fill = Row.solved,
) -> None:
    """Run the suite whose systems are in a module of tests/reference, and print its table."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--only", nargs="+", metavar="NAME", help="names, with wildcards")
    parser.add_argument("--rtol", nargs="+", type=float, default=list(rtols))
    parser.add_argument("--effort", type=effort_of, default="normal")
    parser.add_argument("--method", default=method)
    parser.add_argument("--json", metavar="PATH", type=Path, help="write the numbers to PATH")
    arguments = parser.parse_args()
    names = [
        name
        for name in systems_of(module)
        if not arguments.only or any(fnmatch(name, pattern) for pattern in arguments.only)
    ]
    if not names:
        parser.error(f"no system matches {' '.join(arguments.only)}")
    rows = []
    for rtol in arguments.rtol:
        for name in names:
            row = _run(Case(module, name, rtol, arguments.effort, arguments.method), fill)
            print(f"{name} {rtol:g}: {row.verdict} {row.message}", file=sys.stderr, flush=True)
            rows.append(row)
            if arguments.json:
                text = json.dumps([asdict(row) for row in rows], indent=2)
                arguments.json.write_text(text + "\n")
    print(table(rows))
    for rtol in arguments.rtol:
        print(f"\n{summary([row for row in rows if row.rtol == rtol], rtol)}")


def systems_of(module: str) -> Mapping[str, Stated]:
    """The systems of a module of tests/reference, which are its only mapping in capitals."""
    loaded = __import__(f"tests.reference.{module}", fromlist=[module.upper()])
    return getattr(loaded, module.upper())  # type: ignore[no-any-return]


def _run(case: Case, fill: Fill) -> Row:
    """The row of a system, from a process of its own."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        try:
            return pool.submit(_row, case, fill).result(LIMIT)
        except Exception as error:
            for process in (pool._processes or {}).values():
                process.kill()
            return Row(case.name, case.rtol, message=f"{type(error).__name__}: {error}")


def _row(case: Case, fill: Fill) -> Row:
    row = Row(case.name, case.rtol)
    try:
        fill(row, systems_of(case.module)[case.name], case)
    except Exception as error:
        frame = traceback.extract_tb(error.__traceback__)[-1]
        row.verdict = "failed"
        row.message = f"{type(error).__name__} in {frame.name}: {error}"
    return row


# -- the table ------------------------------------------------------------------------------------


def table(rows: Sequence[Row]) -> str:
    """The rows in Markdown; work and its stages in per cent of the budget."""
    lines = [
        "| system | rtol | states × parameters | method | rank | attempts | error kept "
        "| work % | of it | seconds | verdict |",
        "| --- | ---: | --- | --- | ---: | ---: | ---: | ---: | --- | ---: | --- |",
    ]
    for row in rows:
        message = " ".join(row.message.split()).replace("|", "\\|")
        stages = ", ".join(f"{stage} {100 * share:.1f}" for stage, share in row.shares.items())
        cells = [
            row.system,
            f"{row.rtol:g}",
            row.dimensions,
            row.method,
            "" if row.rank is None else str(row.rank),
            "" if row.attempts is None else str(row.attempts),
            "" if row.kept is None else f"{row.kept:.2g}",
            f"{100 * row.work:.1f}",
            stages,
            f"{row.seconds:.2f}",
            row.verdict + (f": {message}" if message else ""),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def summary(rows: Sequence[Row], rtol: float) -> str:
    """How many of each verdict, the largest share of the reference, and the total time."""
    count = Counter(row.verdict for row in rows)
    verdicts = ", ".join(f"{count[verdict]} {verdict}" for verdict in VERDICTS)
    reference = max((row.shares.get("reference", 0.0) for row in rows), default=0.0)
    seconds = sum(row.seconds for row in rows)
    return (
        f"{len(rows)} systems at rtol {rtol:g}: {verdicts}; reference at most "
        f"{100 * reference:.0f} % of the budget; {seconds:.0f} s"
    )
