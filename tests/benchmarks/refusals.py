"""Refuse systems that are beyond reach: python tests/benchmarks/refusals.py

The systems of tests/reference/refusals.py at normal effort. Work is in 10⁹ counted operations, of
which the bar allows 15; seconds are those of the processor, compiling included. The first remedies
that a message offers in so many words are tried: a looser rtol, narrower intervals, an earlier end,
a larger effort; *remedy* is what becomes of the best of them. A success needs none.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import json
import math
import re
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

import rankone as ro  # noqa: E402
from rankone.support.budget import limited  # noqa: E402
from tests.benchmarks.apart import Failed, apart, each_apart  # noqa: E402
from tests.reference.refusals import REFUSALS, Refusal  # noqa: E402

WORK = 15.0
"""10⁹ operations in which the bar wants a refusal."""
LIMIT = 300.0
"""Seconds of the processor after which a solve has failed."""
REMEDY_LIMIT = 120.0
"""Seconds of the processor after which a remedy has failed."""
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_INTERVAL = re.compile(rf"`(\w+)` to [\[(]({_NUMBER}), ({_NUMBER})[\])]")
_SIDE = re.compile(rf"narrow the box: `(\w+)` (below|above) ({_NUMBER}) would do")
_RTOL = re.compile(rf"(?:try|loosen) rtol\s*(?:=|to)\s*({_NUMBER})")
_EFFORT = re.compile(rf"effort\s*(?:=|to)\s*['\"]?(low|normal|high|{_NUMBER})")
_END = re.compile(rf"(?:end the horizon before t = |t_final\s*=\s*)({_NUMBER})")


@dataclass(frozen=True)
class Try:
    """A remedy as it is applied: the box narrowed, and options of the solve."""

    says: str
    box: Mapping[str, tuple[float, float]]
    options: Mapping[str, Any]


@dataclass
class Row:
    """A line of the table."""

    name: str
    verdict: str = "error"
    seconds: float = float("nan")
    work: float = float("nan")
    message: str = ""
    remedy: str = "no remedy"


# -- a function for each kind of remedy -----------------------------------------------------------


def looser(message: str, case: Refusal) -> Try | None:
    """A looser tolerance: ``try rtol=1e-3``."""
    found = _RTOL.search(message)
    return found and Try(f"rtol={found[1]}", {}, {"rtol": float(found[1])})


def narrower(message: str, case: Refusal) -> Try | None:
    """Narrower intervals: narrow `a` to [3.1, 4] and `b` to [0, 1]."""
    box = {
        name: (float(low), float(high))
        for name, low, high in _INTERVAL.findall(message)
        if name in case.box and _inside((float(low), float(high)), case.box[name])
    }
    side = _SIDE.search(message)
    if not box and side and side[1] in case.box:
        (low, high), end = case.box[side[1]], float(side[3])
        box = {side[1]: (low, end) if side[2] == "below" else (end, high)}
    says = " and ".join(f"{name} in [{low:g}, {high:g}]" for name, (low, high) in box.items())
    share = math.prod(
        (high - low) / (case.box[name][1] - case.box[name][0]) for name, (low, high) in box.items()
    )
    return Try(f"{says} ({share:.1%} of the box)", box, {}) if box else None


def shorter(message: str, case: Refusal) -> Try | None:
    """An earlier end: ``end the horizon before t = 2.5``."""
    found = _END.search(message)
    return found and Try(f"t_final={found[1]}", {}, {"t_final": 0.999 * float(found[1])})


def harder(message: str, case: Refusal) -> Try | None:
    """A larger effort: ``effort="high"``, or "raise effort" without a number, which is tenfold."""
    found = _EFFORT.search(message)
    if not found and "raise effort" not in message:
        return None
    text = found[1] if found else "high"
    effort = text if text.isalpha() else float(text)
    return Try(f"effort={effort}", {}, {"effort": effort})


REMEDIES: tuple[Callable[[str, Refusal], Try | None], ...] = (looser, narrower, shorter, harder)


def _inside(part: tuple[float, float], whole: tuple[float, float]) -> bool:
    slack = 1e-9 * (whole[1] - whole[0])
    return whole[0] - slack <= part[0] < part[1] <= whole[1] + slack and part != whole


# -- one system -----------------------------------------------------------------------------------


def solved(name: str, attempt: Try | None = None) -> Row:
    """Solve a system, perhaps with a remedy."""
    case, line = REFUSALS[name], Row(name)
    box = attempt.box if attempt else {}
    options = {"rtol": case.rtol, **(attempt.options if attempt else {})}
    warnings.simplefilter("ignore")
    began = time.process_time()
    with limited() as account:
        try:
            solution = ro.solve(case.problem(box), **options)
            line.verdict = "ok" if solution.success else "refused"
            line.message = solution.message
        except ro.RankoneError as error:
            line.verdict, line.message = "refused", f"{type(error).__name__}: {error}"
        except Exception as error:
            frame = traceback.extract_tb(error.__traceback__)[-1]
            line.message = f"{type(error).__name__} in {frame.name}: {error}"
    line.seconds, line.work = time.process_time() - began, account.done / 1e9
    return line


def remedied(line: Row, limit: float) -> str:
    """What becomes of the remedies that a message offers, up to the first that succeeds."""
    case, fates = REFUSALS[line.name], []
    for kind in REMEDIES:
        attempt = kind(line.message, case)
        if attempt is None:
            continue
        found = apart(solved, (line.name, attempt), limit)
        fate = "slow" if isinstance(found, Failed) else found.verdict
        fates.append(f"{attempt.says}: {fate}")
        if fate == "ok":
            break
    return "; ".join(fates) or "no remedy"


def main() -> None:
    """Print a table, and what it comes to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", metavar="NAME", help="names, with wildcards")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--no-remedies", action="store_true", help="do not try the remedies")
    parser.add_argument("--json", metavar="PATH", type=Path, help="write the numbers to PATH")
    options = parser.parse_args()
    names = [
        name
        for name in REFUSALS
        if not options.only or any(fnmatch(name, pattern) for pattern in options.only)
    ]
    if not names:
        parser.error(f"no system matches {' '.join(options.only)}")
    rows = []
    print("| system | kind | verdict | seconds | work | remedy | message |")
    print("| --- | --- | --- | ---: | ---: | --- | --- |")
    for name, found in each_apart(solved, names, LIMIT, options.processes):
        if isinstance(found, Failed):
            found = Row(name, "slow" if found.slow else "error", message=found.reason)
        if found.verdict == "ok":
            found.remedy = ""
        elif options.no_remedies:
            found.remedy = "not tried"
        else:
            found.remedy = remedied(found, REMEDY_LIMIT)
        rows.append(found)
        lines = found.message.splitlines() or [""]
        message = lines[0].replace("|", "\\|")
        print(
            f"| {name} | {REFUSALS[name].kind} | {found.verdict} | {found.seconds:.1f} "
            f"| {found.work:.1f} | {found.remedy} | {message[:240]} |",
            flush=True,
        )
        if options.json:
            options.json.write_text(json.dumps([asdict(line) for line in rows], indent=2) + "\n")
    print(f"\n{summary(rows)}")


def summary(rows: list[Row]) -> str:
    """How many of each verdict, how many refusals within the bar, and how many remedies work."""
    count = Counter(line.verdict for line in rows)
    refused = [line for line in rows if line.verdict != "ok"]
    quick = sum(line.work <= WORK for line in refused)
    worked = sum(line.remedy.endswith(": ok") for line in refused)
    offered = sum(line.remedy not in ("no remedy", "not tried") for line in refused)
    return (
        f"{len(rows)} systems: "
        + ", ".join(f"{number} {verdict}" for verdict, number in count.items())
        + f"; of {len(refused)} that are not ok {quick} end within {WORK:g}e9 operations, "
        f"{offered} offer a remedy that can be read, and {worked} of these succeed"
    )


if __name__ == "__main__":
    main()
