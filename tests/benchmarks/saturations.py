"""Solve sixty systems that saturate, stick, rest or switch: python tests/benchmarks/saturations.py

At rtol 1e-4, as engineers write them (tests/reference/saturations.py). *kept* is the largest error
over the tolerance at 24 random points × 40 times, against modes written by hand; a success is *ok*
up to 5 and *wrong* above. *error* is an exception that is none of rankone's, or a process that
died; *slow* is no answer in 90 s of the processor. Seconds are those of the processor, compiling
included, and work is in 10⁹ counted operations. The bar is 55 *ok* in at most 10 s, no error, and
one verdict for the spellings of one system. ``--references`` compares the references with narrow
smooth steps and with single trajectories instead.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import json
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import scipy.integrate
import sympy as sp

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

import rankone as ro  # noqa: E402
from rankone.support.budget import limited  # noqa: E402
from tests.benchmarks.apart import Failed, each_apart  # noqa: E402
from tests.reference.saturations import RTOL, SATURATIONS, Array, Switched  # noqa: E402

WITHIN = 5.0
"""Measured error over tolerance up to which a solution counts as right."""
SECONDS = 10.0
"""Seconds of the processor in which the bar wants an answer."""
LIMIT = 90.0
"""Seconds of the processor after which a solve is slow."""
_AFTER = 120.0
"""Seconds of the processor for the trajectories that a solution is compared with."""
_MOST_UNDECIDED, _FEW_UNDECIDED = 0.01, 2
"""Share of the box, and points of 24, at which a declared sliver may leave no values."""
VERDICTS = ("ok", "refused", "wrong", "slow", "error")


@dataclass
class Row:
    """A line of the table."""

    name: str
    verdict: str = "error"
    kept: float = float("nan")
    seconds: float = float("nan")
    work: float = float("nan")
    message: str = ""


def row(name: str) -> Row:
    """Solve a system, and compare the solution with its reference."""
    case, line = SATURATIONS[name], Row(name)
    solution = None
    warnings.simplefilter("ignore")
    began = time.process_time()
    with limited() as account:
        try:
            solution = ro.solve(case.problem(), RTOL)
        except ro.RankoneError as error:
            line.verdict, line.message = "refused", f"{type(error).__name__}: {error}"
        except Exception as error:
            frame = traceback.extract_tb(error.__traceback__)[-1]
            line.message = f"{type(error).__name__} in {frame.name}: {error}"
    line.seconds, line.work = time.process_time() - began, account.done / 1e9
    if line.seconds > LIMIT:
        line.verdict = "slow"
    elif solution is not None and not solution.success:
        line.verdict, line.message = "refused", solution.message
    elif solution is not None:
        line.kept = float(errors(case, solution).max()) / RTOL
        line.verdict = "ok" if line.kept <= WITHIN else "wrong"
    return line


def errors(case: Switched, solution: ro.Solution) -> Array:
    """The largest error of each compared state over its largest value, resets left out."""
    times, exact, found, beside = case.times(), [], [], []
    for p in case.points():
        exact.append(case.reference(p, times))
        found.append([solution[state](t=times, **vars(p)) for state in case.asked])
        at = np.array([np.inf, *case.resets(p)])
        beside.append(np.abs(times[:, None] - at).min(axis=1) <= RTOL * case.end)
    truth, values, left_out = np.array(exact), np.array(found), np.array(beside)
    empty = np.isnan(values).any(axis=(1, 2))
    timeline = getattr(solution.outcome, "timeline", None)
    undecided = getattr(timeline, "undecided", 0.0)
    if 0.0 < undecided <= _MOST_UNDECIDED and empty.sum() <= _FEW_UNDECIDED:
        left_out |= empty[:, None]
    apart = np.where(left_out[:, None, :], 0.0, np.abs(values - truth))
    size = np.abs(truth).max(axis=(0, 2))
    worst = np.nan_to_num(apart, nan=np.inf).max(axis=(0, 2))
    return np.asarray(worst / np.where(size > 0.0, size, 1.0))


# -- the references, by a second way --------------------------------------------------------------


def compared(name: str) -> str:
    """How far the reference is from smooth steps of two widths, and from single trajectories."""
    case, worst = SATURATIONS[name], []
    warnings.simplefilter("ignore")
    problem, times = case.problem(), case.times()
    for p in case.points(2):
        exact = case.reference(p, times)
        size = np.abs(exact).max(axis=1)

        def apart(values: Array, exact: Array = exact, size: Array = size) -> float:
            return float((np.abs(values - exact).max(axis=1) / np.where(size > 0, size, 1)).max())

        found = []
        for width in (1e-4, 1e-5):
            try:
                found.append(f"{apart(smoothed(case, vars(p), times, width)):.0e}")
            except (ArithmeticError, TypeError, ValueError) as error:
                found.append(f"{type(error).__name__}: {error}"[:60])
        try:
            run = problem.trajectory(times, rtol=1e-9, **vars(p))
            rows = [list(case.rates).index(state) for state in case.asked]
            found.append(f"{apart(np.asarray(run)[rows]):.0e}")
        except Exception as error:
            found.append(f"{type(error).__name__}: {error}"[:60])
        worst.append(" / ".join(found))
    return "; ".join(worst)


def smoothed(case: Switched, values: Mapping[str, float], times: Array, width: float) -> Array:
    """A trajectory whose switches are narrow smooth steps of the sizes of their arguments."""
    if case.events:
        raise ArithmeticError("events")
    t, states = sp.Symbol("t"), [sp.Symbol(name, real=True) for name in case.rates]
    known = {"t": t, **{name: sp.Symbol(name, real=True) for name in (*case.rates, *case.box)}}
    for name, text in case.definitions.items():
        known[name] = sp.sympify(text, locals=known)
    at = {known[name]: value for name, value in values.items()}

    def share(condition: sp.Basic) -> sp.Expr:
        if condition in (sp.true, sp.false):
            return sp.S.One if condition == sp.true else sp.S.Zero
        if isinstance(condition, sp.And):
            return sp.Mul(*map(share, condition.args))
        if isinstance(condition, sp.Or):
            return 1 - sp.Mul(*(1 - share(each) for each in condition.args))
        if isinstance(condition, sp.Not):
            return 1 - share(condition.args[0])
        if isinstance(condition, sp.ITE):
            which, yes, no = map(share, condition.args)
            return which * yes + (1 - which) * no
        return step(smooth(condition.gts - condition.lts))

    def step(x: sp.Expr) -> sp.Expr:
        return (1 + sp.tanh(x / width)) / 2

    def smooth(part: sp.Basic) -> sp.Expr:
        if isinstance(part, sp.Piecewise):
            total, rest = sp.S.Zero, sp.S.One
            for branch, condition in part.args:
                total += rest * share(condition) * smooth(branch)
                rest *= 1 - share(condition)
            return total
        if isinstance(part, sp.Heaviside):
            return step(smooth(part.args[0]))
        if isinstance(part, sp.sign):
            return sp.tanh(smooth(part.args[0]) / width)
        return part.func(*map(smooth, part.args)) if part.args else part

    rates = [smooth(sp.sympify(text, locals=known)).subs(at) for text in case.rates.values()]
    rhs = sp.lambdify([t, states], rates, "math")
    start = [float(sp.sympify(case.initial[s], locals=known).subs(at)) for s in case.rates]
    pieces, u = [np.array(start)[:, None]], np.array(start)
    resets = dict(case.jumps or {})
    for a, b in zip([0.0, *resets], [*resets, case.end]):
        if a in resets:
            named = dict(zip(states, u.tolist()))
            after = {s: sp.sympify(text, locals=known) for s, text in resets[a].items()}
            u = np.array(
                [float(sp.sympify(after.get(s, known[s])).subs(named)) for s in case.rates]
            )
        inside = times[(times > a) & (times <= b)]
        run = scipy.integrate.solve_ivp(
            rhs,
            (a, b),
            u,
            "Radau",
            dense_output=True,
            rtol=1e-8,
            atol=1e-10,
            max_step=case.end / 300,
        )
        if not run.success:
            raise ArithmeticError(run.message)
        pieces.append(run.sol(inside))
        u = run.y[:, -1]
    every = np.concatenate(pieces, axis=1)
    return every[[list(case.rates).index(state) for state in case.asked]]


# -- the table ------------------------------------------------------------------------------------


def summary(rows: Sequence[Row]) -> str:
    """How many of each verdict, how many in time, and the groups whose verdicts differ."""
    count = Counter(line.verdict for line in rows)
    quick = sum(line.verdict == "ok" and line.seconds <= SECONDS for line in rows)
    kinds: dict[str, list[Row]] = {}
    groups: dict[str, list[Row]] = {}
    for line in rows:
        case = SATURATIONS[line.name]
        kinds.setdefault(case.kind, []).append(line)
        if case.group:
            groups.setdefault(case.group, []).append(line)
    lines = [
        f"{len(rows)} systems: " + ", ".join(f"{count[verdict]} {verdict}" for verdict in VERDICTS),
        f"{quick} ok in at most {SECONDS:g} s",
    ]
    for kind, some in kinds.items():
        lines.append(f"{kind}: {sum(line.verdict == 'ok' for line in some)} of {len(some)}")
    split = {g: some for g, some in groups.items() if len({line.verdict for line in some}) > 1}
    lines.append(f"{len(groups) - len(split)} of {len(groups)} groups have one verdict")
    for group, some in split.items():
        fates = ", ".join(f"{line.name.partition(': ')[2]} {line.verdict}" for line in some)
        lines.append(f"  {group}: {fates}")
    return "\n".join(lines)


def main() -> None:
    """Print a table, and what it comes to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", metavar="NAME", help="names, with wildcards")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--json", metavar="PATH", type=Path, help="write the numbers to PATH")
    parser.add_argument("--references", action="store_true", help="check the references instead")
    options = parser.parse_args()
    names = [
        name
        for name in SATURATIONS
        if not options.only or any(fnmatch(name, pattern) for pattern in options.only)
    ]
    if not names:
        parser.error(f"no system matches {' '.join(options.only)}")
    if options.references:
        print("smooth steps of 1e-4 / of 1e-5 / single trajectory; at two points")
        for name, found in each_apart(compared, names, 600.0, options.processes):
            print(f"{name}: {found}", flush=True)
        return
    rows = []
    print("| system | verdict | kept | seconds | work | message |")
    print("| --- | --- | ---: | ---: | ---: | --- |")
    for name, found in each_apart(row, names, LIMIT + _AFTER, options.processes):
        if isinstance(found, Failed):
            found = Row(name, "slow" if found.slow else "error", message=found.reason)
        rows.append(found)
        message = " ".join(found.message.split()).replace("|", "\\|")
        print(
            f"| {name} | {found.verdict} | {found.kept:.2g} | {found.seconds:.1f} "
            f"| {found.work:.2f} | {message[:160]} |",
            flush=True,
        )
        if options.json:
            options.json.write_text(json.dumps([asdict(line) for line in rows], indent=2) + "\n")
    print(f"\n{summary(rows)}")


if __name__ == "__main__":
    main()
