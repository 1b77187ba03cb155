"""Name what ends branches of steady states: python -m tests.benchmarks.steady_states

A Markdown table of the thirty problems of ``tests/reference/steady_states.py``. A bifurcation is
read from the attribute ``bifurcation`` of the error or of the solution, with ``.kind``,
``.parameter`` and ``.value`` (and, with several parameters, the others in the mapping ``.point``);
without such an attribute from the message. It is *located* if it is off by at most 1e-6 of the
interval.

A problem without a bifurcation is right if none is named and no false reason is given; if it has a
steady state everywhere, it also has to be solved, within 5 × rtol of the exact one at eight points.
A success farther off is *wrong*. Seconds are those of the processor.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import fnmatch
import re
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

import rankone as ro
from tests.reference.steady_states import KINDS, STEADY, Resting

LOCATED = 1e-6  # of the interval
WITHIN = 5.0  # of rtol
_POINTS = 8
_NUMBER = r"([-+]?\d[\d.]*(?:e[-+]?\d+)?)"
_NAMED = re.compile("|".join(KINDS), re.IGNORECASE)


@dataclass(frozen=True)
class Named:
    """A bifurcation as it was reported: its kind, and the parameters there by name."""

    kind: str
    at: dict[str, float]


@dataclass(frozen=True)
class Row:
    """A line of the table: off is the distance from the bifurcation in intervals, or the error."""

    case: Resting
    found: str
    off: float
    verdict: str
    seconds: float
    message: str

    def text(self) -> str:
        off = f"{self.off:.1e}" if np.isfinite(self.off) else ""
        cells = [self.case.name, _expected(self.case), self.found, off, self.verdict]
        return f"| {' | '.join(cells)} | {self.seconds:.1f} | {self.message[:110]} |"


def _expected(case: Resting) -> str:
    return case.kind if case.kind in KINDS else f"none, {case.fate}"


def reported(of: object, message: str, parameters: list[str]) -> Named | None:
    """The bifurcation that an error or a solution names, if any."""
    told = getattr(of, "bifurcation", None)
    texts = re.findall(rf"\b({'|'.join(map(re.escape, parameters))}) = {_NUMBER}", message)
    written = {name: float(number) for name, number in reversed(texts)}  # the first of each counts
    if told is not None:
        return Named(told.kind, {**written, **told.parameters})
    word = _NAMED.search(message) if not hasattr(of, "bifurcation") else None
    return Named(word[0].lower().replace("hopf", "Hopf"), written) if word else None


def error(case: Resting, solution: ro.Solution) -> float:
    """The largest error of a solution, relative to the largest value of each unknown."""
    box = np.array(list(case.system.parameters.values()))
    points = np.random.default_rng(11).uniform(*box.T, (_POINTS, len(box)))
    names = list(case.system.parameters)
    exact = np.array([case.exact(**dict(zip(names, p, strict=True))) for p in points]).T
    values = solution(dict(zip(names, points.T, strict=True)))
    rows = [list(case.system.rates).index(name) for name in solution.states]
    sizes = np.abs(exact).max(axis=1, keepdims=True)
    sizes = np.where(sizes > 0.0, sizes, max(1.0, sizes.max()))
    return float((np.abs(values - exact[rows]) / sizes[rows]).max())


def judged(case: Resting, of: object, message: str) -> tuple[str, float, str]:
    """What was found, how far off it is, and the verdict."""
    names = list(case.system.parameters)
    named = reported(of, message, names)
    success = bool(getattr(of, "success", False))
    if case.kind in KINDS:
        if named is None:
            return ("solved" if success else "refused"), np.nan, "not named"
        low, high = case.system.parameters[case.parameter]
        others = {name: named.at.get(name, np.nan) for name in names if name != case.parameter}
        there = named.at.get(case.parameter, np.nan)
        known = np.isfinite([there, *others.values()]).all()
        off = abs(there - case.value(**others)) / (high - low) if known else np.nan
        if named.kind.lower() != case.kind.lower():
            return named.kind, off, "another kind"
        return named.kind, off, "right" if off <= LOCATED else "named, not located"
    found = named.kind if named else "solved" if success else "refused"
    off = error(case, of) if success and case.exact is not None else np.nan
    if success and not off <= WITHIN * case.rtol:
        return found, off, "WRONG"
    if named is not None:
        return found, off, "named, but none"
    if any(word in message for word in case.false):
        return found, off, "false reason"
    if case.fate == "solved" and not success:
        return found, off, "not solved"
    return found, off, "right"


def measured(case: Resting, effort: str) -> Row:
    """A row of the table."""
    began = time.process_time()
    of: object
    try:
        of = ro.steady_state(
            case.system.problem(), settle=case.settle, rtol=case.rtol, effort=effort
        )
        message = of.message
    except ro.RankoneError as refused:
        of, message = refused, str(refused)
    except Exception as crash:
        of, message = crash, f"CRASH {type(crash).__name__}: {crash}"
    seconds = time.process_time() - began
    found, off, verdict = judged(case, of, message)
    if message.startswith("CRASH"):
        found, verdict = "crash", "CRASH"
    return Row(case, found, off, verdict, seconds, " ".join(message.split()))


def summary(rows: list[Row]) -> Iterator[str]:
    """How many are right, by kind and in all."""
    for kind in (*KINDS, "none"):
        of_kind = [row for row in rows if row.case.kind == kind]
        named = sum(row.verdict in ("right", "named, not located") for row in of_kind)
        right = sum(row.verdict == "right" for row in of_kind)
        yield f"{kind:<14} {named} of {len(of_kind)} named rightly, {right} right in all"
    verdicts = Counter(row.verdict for row in rows)
    right = verdicts.pop("right", 0)
    others = ", ".join(f"{count} {verdict}" for verdict, count in sorted(verdicts.items()))
    yield f"{right} of {len(rows)} right (named, located to {LOCATED:g} of the interval); {others}"


def main() -> None:
    """Print the table and its summary."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="*", help="names, with wildcards")
    parser.add_argument("--effort", default="normal")
    chosen = parser.parse_args()
    print("| problem | expected | found | off | verdict | s | message |")
    print("|---|---|---|---|---|---|---|")
    rows = []
    for case in STEADY:
        if fnmatch.fnmatch(case.name, chosen.only):
            rows.append(measured(case, chosen.effort))
            print(rows[-1].text(), flush=True)
    print()
    print("\n".join(summary(rows)))


if __name__ == "__main__":
    main()
