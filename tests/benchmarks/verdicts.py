"""Save the verdict, the work, the rank and the error of every case of the suites, and compare.

    python tests/benchmarks/verdicts.py run PATH --suite events switches
    python tests/benchmarks/verdicts.py run PATH --suite honesty --only "pulses *" --count 20
    python tests/benchmarks/verdicts.py compare OLD NEW

``run`` adds the cases that PATH does not have yet and writes it after each, so a run that was
interrupted goes on where it ended. Without ``--suite`` it runs the short form of every suite,
``--full`` the whole of it. ``compare`` prints which verdicts changed, which of them are borderline
(an error between half and five times the tolerance, or more than half of the budget), the successes
that are wrong, and the ratio of the work. Work is counted, so a busy machine changes nothing.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import json
import math
import signal
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from fnmatch import fnmatch
from pathlib import Path
from unittest import mock

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

import rankone as ro  # noqa: E402
from rankone.support.budget import NORMAL, limited  # noqa: E402
from tests.benchmarks import events, many_states, relaxation, steep, suite, switches  # noqa: E402
from tests.honesty.cases import KINDS, case  # noqa: E402
from tests.honesty.verdicts import judged  # noqa: E402
from tests.reference.measure import measured_errors  # noqa: E402
from tests.reference.published import PUBLISHED  # noqa: E402

EFFORT = 0.6
"""Limit of the work of a case: about fifteen seconds."""
SECONDS = 120.0
"""Seconds of the processor, independent trajectories included, until a case is given up."""
WITHIN = 5.0
BORDERLINE = 0.5
"""Error over the tolerance, or work over the budget, from which a verdict is borderline."""
SEED = 5200
"""First seed of the honesty cases: others than those of its tests."""
_FEW_ORDERS, _FEW_STEEP, _FEW_HONEST = 12, 20, 5
_SMALL = ("chain of 100", "heat, 500", "truss, 200 degrees of freedom", "springs, 200")


@dataclass
class Row:
    """What a case came to."""

    verdict: str
    kept: float | None = None
    work: float = 0.0
    rank: int | None = None
    seconds: float = 0.0
    message: str = ""
    effort: float = EFFORT


class GivenUp(BaseException):
    """A case takes too long."""


# -- the suites -----------------------------------------------------------------------------------

Fill = Callable[[Row], None]
"""Solves and judges a case, and says so in its row."""
Cases = Iterator[tuple[str, bool, Fill]]
"""The name of each case, whether it belongs to the short form, and what fills its row in."""


def _judge(row: Row, solve: Callable[[], ro.Solution], rtol: float, error: Error) -> None:
    """The verdict of a solve by the error of its solution."""
    solution = solve()
    if not solution.success:
        row.verdict, row.kept, row.message = "refused", solution.error / rtol, solution.message
        return
    row.kept = error(solution) / rtol
    row.verdict = "ok" if row.kept <= WITHIN else "wrong"


Error = Callable[[ro.Solution], float]


def _published(rtol: float) -> Cases:
    for name, entry in PUBLISHED.items():

        def fill(row: Row, entry=entry) -> None:
            _judge(
                row,
                lambda: ro.solve(entry.problem(), rtol=rtol),
                rtol,
                lambda solution: float(measured_errors(solution, entry.independent).max()),
            )

        yield name, True, fill


def _stated(module: str, rtol: float, filled: suite.Fill = suite.Row.solved) -> Cases:
    for name, system in suite.systems_of(module).items():

        def fill(row: Row, name=name, system=system) -> None:
            own = suite.Row(name, rtol)
            filled(own, system, suite.Case(module, name, rtol, row.effort, "auto"))
            row.verdict, row.kept, row.message = own.verdict, own.kept, own.message
            row.work, row.rank = own.work * row.effort * NORMAL, own.rank

        yield name, True, fill


def _events() -> Cases:
    for name, (system, rtol) in events.SYSTEMS.items():

        def fill(row: Row, system=system, rtol=rtol) -> None:
            _judge(
                row,
                lambda: ro.solve(system, rtol=rtol),
                rtol,
                lambda solution: events.error(system, solution, rtol),
            )

        yield name, True, fill


def _oscillators(rtol: float = 1e-5) -> Cases:
    for name, problem in switches.oscillators().items():

        def fill(row: Row, problem=problem) -> None:
            _judge(
                row,
                lambda: ro.solve(problem, rtol=rtol),
                rtol,
                lambda solution: switches.oscillation_error(problem, solution),
            )

        yield name, True, fill


def _steep() -> Cases:
    for i, made in enumerate(steep.cases()):

        def fill(row: Row, made=made) -> None:
            _, rtol, rate, box, initial, end = made
            problem = ro.Problem(
                [steep.sp.Eq(steep.x.diff(steep.t), rate)],
                (steep.t, 0, end),
                box,
                {steep.x: initial},
            )
            _judge(
                row,
                lambda: ro.solve(problem, rtol=rtol),
                rtol,
                lambda solution: steep.error(solution, made),
            )

        yield f"{i} {made[0]}", i < _FEW_STEEP, fill


def _many_states() -> Cases:
    for name, chosen in many_states.CASES.items():

        def fill(row: Row, chosen=chosen) -> None:
            compiled = ro.compile(chosen.problem())
            _judge(
                row,
                lambda: compiled.solve(rtol=chosen.rtol),
                chosen.rtol,
                lambda solution: many_states.largest_error(compiled, solution),
            )

        yield name, name in _SMALL, fill


def _honest(names: Iterable[tuple[str, bool, Callable[[], object]]]) -> Cases:
    for name, short, make in names:

        def fill(row: Row, make=make) -> None:
            verdict = judged(make(), longest=math.inf)
            row.verdict, row.message = verdict.verdict, verdict.message
            row.kept = None if math.isnan(verdict.kept) else verdict.kept

        yield name, short, fill


def _orders(count: int) -> Cases:
    return _honest(
        (f"orders {seed}", seed < _FEW_ORDERS, lambda seed=seed: case("orders", seed))
        for seed in range(count)
    )


def _honesty(count: int, first: int) -> Cases:
    return _honest(
        (f"{kind} {seed}", seed < first + _FEW_HONEST, lambda made=(kind, seed): case(*made))
        for seed in range(first, first + count)
        for kind in KINDS
    )


def suites(count: int = 40, seed: int = SEED) -> Mapping[str, Callable[[], Cases]]:
    """What makes the cases of each suite; ``count`` honesty cases of each kind from a seed on."""
    return {
        "events": _events,
        "switches": lambda: _honest(
            (made.name, True, lambda made=made: made) for made in switches.systems()
        ),
        "kinetics": lambda: _stated("kinetics", 1e-3),
        "decades": lambda: _stated("decades", 1e-3),
        "relaxation": lambda: _stated("relaxation", 1e-3, relaxation.integrated),
        "oscillators": _oscillators,
        "published-1e-4": lambda: _published(1e-4),
        "steep": _steep,
        "orders": lambda: _orders(40),
        "honesty": lambda: _honesty(count, seed),
        "many-states": _many_states,
        "published-1e-3": lambda: _published(1e-3),
        "published-1e-6": lambda: _published(1e-6),
    }


LONG = ("published-1e-3", "published-1e-6")
"""Suites that run only if they are named, or in full."""


# -- one case -------------------------------------------------------------------------------------


@contextmanager
def _counted(row: Row) -> Iterator[None]:
    """Limit the work of solves inside, and note what the first one took and its rank."""
    solve, depth = ro.CompiledProblem.solve, 0

    def noted(compiled: ro.CompiledProblem, *arguments, **options):
        nonlocal depth
        if depth or row.work:
            return solve(compiled, *arguments, **options)
        depth += 1
        with limited() as account:
            before = account.done
            try:
                solution = solve(compiled, *arguments, **{**options, "effort": row.effort})
                row.rank = solution.rank
                return solution
            finally:
                row.work = account.done - before
                depth -= 1

    with mock.patch.object(ro.CompiledProblem, "solve", noted):
        yield


def run(fill: Fill, effort: float = EFFORT, seconds: float = SECONDS) -> Row:
    """The row of a case."""

    def give_up(*_: object) -> None:
        raise GivenUp

    row, began = Row("failed", effort=effort), time.process_time()
    signal.signal(signal.SIGPROF, give_up)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        with warnings.catch_warnings(), _counted(row):
            warnings.simplefilter("ignore")
            fill(row)
    except ro.RankoneError as error:
        row.verdict, row.message = "refused", f"{type(error).__name__}: {error}"
    except GivenUp:
        row.message = f"no answer in {seconds:g} s of the processor"
    except Exception as error:
        row.message = f"{error!r}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    row.seconds = round(time.process_time() - began, 2)
    row.message = " ".join(row.message.split())[:240]
    return row


def chosen(
    names: Iterable[str], only: Iterable[str], full: bool, count: int, seed: int
) -> Iterator[tuple[str, Fill]]:
    """Name, with the suite before it, and filler of each case that was asked for."""
    for name in names:
        for label, short, fill in suites(count, seed)[name]():
            if only and not any(fnmatch(label, pattern) for pattern in only):
                continue
            if full or short or only:
                yield f"{name}: {label}", fill


# -- what two runs differ in ----------------------------------------------------------------------


def borderline(row: Row) -> bool:
    """Whether a verdict may change with anything that changes roundings or work."""
    near = row.kept is not None and BORDERLINE <= row.kept <= WITHIN
    return near or row.work > BORDERLINE * row.effort * NORMAL


def comparison(before: Mapping[str, Row], after: Mapping[str, Row]) -> str:
    """Verdicts that changed, wrong successes and the ratio of the work, as text."""
    both = [name for name in before if name in after]
    lines = [f"{len(both)} cases in both, {len(before)} before, {len(after)} after"]
    for name in both:
        old, new = before[name], after[name]
        if old.verdict == new.verdict:
            continue
        edge = " (borderline)" if borderline(old) or borderline(new) else ""
        errors = f"{_number(old.kept)} -> {_number(new.kept)}"
        lines.append(
            f"CHANGED{edge} {name}: {old.verdict} -> {new.verdict}, error/rtol {errors}, "
            f"work {old.work:.2e} -> {new.work:.2e}; {new.message[:150]}"
        )
    for title, rows in (("before", before), ("after", after)):
        verdicts = Counter(rows[name].verdict for name in both)
        lines.append(f"{title}: " + ", ".join(f"{n} {v}" for v, n in sorted(verdicts.items())))
        lines += [f"WRONG {title} {name}" for name in both if rows[name].verdict == "wrong"]
    same = [
        (after[name].work / before[name].work, name)
        for name in both
        if before[name].verdict == after[name].verdict and before[name].work and after[name].work
    ]
    if same:
        mean = math.exp(sum(math.log(ratio) for ratio, _ in same) / len(same))
        total = sum(after[n].work for _, n in same) / sum(before[n].work for _, n in same)
        lines.append(f"work of {len(same)}: geometric mean {mean:.4f}, sum {total:.4f}")
        changed = sorted(pair for pair in same if abs(pair[0] - 1.0) > 0.02)
        ends = changed if len(changed) <= 10 else [*changed[:5], *changed[-5:]]
        lines += [f"    {ratio:.3f} {name}" for ratio, name in ends]
    return "\n".join(lines)


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.2g}"


def read(path: Path) -> dict[str, Row]:
    """The rows that a run saved."""
    if not path.exists():
        return {}
    return {name: Row(**row) for name, row in json.loads(path.read_text()).items()}


def write(path: Path, rows: Mapping[str, Row]) -> None:
    """Save rows, so that an interruption leaves the file whole."""
    beside = path.with_suffix(".part")
    beside.write_text(json.dumps({name: asdict(row) for name, row in rows.items()}, indent=1))
    beside.replace(path)


def line(name: str, row: Row) -> str:
    """What a case came to, as a line."""
    message = "" if row.verdict == "ok" else row.message[:100]
    return (
        f"{name}: {row.verdict} {_number(row.kept)} work {row.work:.2e} {row.seconds:.1f} s "
        f"{message}"
    )


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options that say which cases are asked for."""
    parser.add_argument("--suite", nargs="+", choices=suites(), default=[], metavar="SUITE")
    parser.add_argument("--only", nargs="+", default=[], help="names of cases, with wildcards")
    parser.add_argument("--full", action="store_true", help="whole suites")
    parser.add_argument("--count", type=int, default=40, help="honesty cases of each kind")
    parser.add_argument("--seed", type=int, default=SEED, help="the first seed of honesty")


def asked(options: argparse.Namespace) -> Iterator[tuple[str, Fill]]:
    """The cases that such options ask for."""
    names = options.suite or [name for name in suites() if options.full or name not in LONG]
    return chosen(names, options.only, options.full, options.count, options.seed)


def main() -> None:
    """Run suites, or compare two runs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    running = commands.add_parser("run")
    running.add_argument("path", type=Path)
    add_options(running)
    running.add_argument("--effort", type=float, default=EFFORT)
    running.add_argument("--seconds", type=float, default=SECONDS)
    comparing = commands.add_parser("compare")
    comparing.add_argument("old", type=Path)
    comparing.add_argument("new", type=Path)
    options = parser.parse_args()
    if options.command == "compare":
        print(comparison(read(options.old), read(options.new)))
        return
    rows = read(options.path)
    for name, fill in asked(options):
        if name in rows:
            continue
        rows[name] = row = run(fill, options.effort, options.seconds)
        write(options.path, rows)
        print(line(name, row), flush=True)
    print(Counter(row.verdict for row in rows.values()))


if __name__ == "__main__":
    main()
