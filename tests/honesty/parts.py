"""What each mechanism for hostile or rare input is worth: python -m tests.honesty.parts

    python -m tests.honesty.parts reach REACH.json --rows BASE.json
    python -m tests.honesty.parts without REACH.json OUT.json --base BASE.json
    python -m tests.honesty.parts table BASE.json REACH.json OUT.json

``reach`` solves the cases of tests/benchmarks/verdicts.py (``--suite``, ``--only``, ``--full``,
``--count`` and ``--seed`` as there) and notes which mechanisms each of them reaches, and which act:
their answer is another one than that of what stands in for them. ``without`` solves the cases in
which a mechanism acts once more with the stand-in; ``--most`` leaves out dear cases. Both add to
their files what these do not have yet. A success that is wrong without a mechanism is what it
prevents.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import inspect
import json
import math
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from rankone.compiler import reformulated
from rankone.solvers import attempts, branches, branching, selection, stretches_by_markers, ways
from rankone.solvers.engines import cross_engine, greedy_engine, train_engine
from rankone.solvers.verification import points, reference_set, resolution
from rankone.solvers.verification.cuts import Cuts
from rankone.tensors import adaptive
from rankone.trajectories.events import markers
from rankone.trajectories.integrators import defects, integrator_choice, workers
from rankone.trajectories.stacks import stack
from tests.benchmarks import verdicts

Acts = Callable[..., bool]
"""Whether an answer, with the arguments after it, is another one than that of the stand-in."""


@dataclass(frozen=True)
class Place:
    """An attribute that is replaced, what stands in for it, and when it acts."""

    owner: Any
    name: str
    instead: Callable[..., Any]
    acts: Acts = lambda answer, *_: answer is not None

    @property
    def original(self) -> Callable[..., Any]:
        return getattr(self.owner, self.name)

    def replaced(self, function: Callable[..., Any]) -> Any:
        """A function in the form of the attribute."""
        kind = inspect.getattr_static(self.owner, self.name)
        if isinstance(kind, classmethod | staticmethod):
            return staticmethod(function)
        return property(function) if isinstance(kind, property) else function

    def noting(self, note: Callable[[bool], None]) -> Any:
        """The attribute, which notes when it is called and whether it acts."""
        kind = inspect.getattr_static(self.owner, self.name)
        original = kind.fget if isinstance(kind, property) else self.original

        def noted(*arguments: Any, **options: Any) -> Any:
            note(False)
            answer = original(*arguments, **options)
            note(bool(self.acts(answer, *arguments)))
            return answer

        return self.replaced(noted)


# -- stand-ins ------------------------------------------------------------------------------------


def _none(*_: object, **__: object) -> None:
    return None


def _never(*_: object, **__: object) -> bool:
    return False


def _zero(*_: object, **__: object) -> int:
    return 0


def _empty(*_: object, **__: object) -> np.ndarray:
    return np.empty(0)


def _nothing(*_: object, **__: object) -> list[object]:
    return []


def _first(first: object, *_: object, **__: object) -> object:
    return first


def _no_points(_system: object, domain: Any) -> np.ndarray:
    return np.zeros((0, len(domain.box)))


def _no_cuts(_system: object, domain: Any) -> tuple[Cuts, ...]:
    return (Cuts(),) * (1 + len(domain.box))


def _no_cut_of_parameters(system: object, domain: Any) -> tuple[Cuts, ...]:
    in_time, *others = _SYSTEM_CUTS(system, domain)
    return in_time, *(Cuts(),) * len(others)


def _few(box: np.ndarray, count: int, *arguments: Any, **options: Any) -> np.ndarray:
    """A quarter of the points, and nothing beside special values."""
    options.pop("cuts", None)
    return points.check_points(box, count // 4, *arguments, **options)


def _not_beside(box: np.ndarray, count: int, *arguments: Any, **options: Any) -> np.ndarray:
    options.pop("cuts", None)
    return points.check_points(box, count, *arguments, **options)


_SYSTEM_CUTS = reference_set.system_cuts


def _any(answer: Any, *_: object) -> bool:
    return len(answer) > 0


def _true(answer: Any, *_: object) -> bool:
    return bool(answer)


def _always(*_: object) -> bool:
    return True


def _other(answer: Any, *arguments: object, **_: object) -> bool:
    """Whether it is none of the arguments."""
    return all(answer is not argument for argument in arguments)


def _no_elements(marcher: Any, _nodes: int) -> list[adaptive.KnownElements]:
    return [adaptive.KnownElements()] * len(marcher.reference_set.domain.box)


def _known(elements: Sequence[adaptive.KnownElements], *_: object) -> bool:
    return any(each != adaptive.KnownElements() for each in elements)


def _cut(cuts: Sequence[Cuts], *_: object) -> bool:
    return any(each.points for each in cuts)


def _has(answer: Any, *_: object) -> bool:
    """Whether some column was missed."""
    return bool(np.any(answer))


PARTS: dict[str, tuple[Place, ...]] = {
    # verification
    "finer trajectories": (
        Place(
            attempts,
            "_confirmed",
            lambda _marcher, attempt, _rtol: attempt,
            lambda answer, _marcher, attempt, _rtol: (
                answer is not attempt or answer.result.stopped is not None
            ),
        ),
    ),
    "worst points": (Place(attempts, "worst_points", _none),),
    "a failed attempt measured again": (Place(attempts, "_restated", _first, _other),),
    "steep points and narrow elements": (Place(cross_engine, "candidate_points", _none),),
    "cuts of one coordinate": (Place(reference_set, "system_cuts", _no_cuts, _cut),),
    "cuts of parameters": (
        Place(
            reference_set,
            "system_cuts",
            _no_cut_of_parameters,
            lambda cuts, *_: _cut(cuts[1:]),
        ),
    ),
    "three quarters of the evenly spread points": (
        Place(reference_set, "check_points", _few, _always),
    ),
    "points beside cuts": (Place(reference_set, "check_points", _not_beside, _always),),
    "points where products of factors are active": (
        Place(reference_set, "active_points", _no_points, _any),
    ),
    "points on surfaces of several parameters": (
        Place(reference_set, "surface_points", _no_points, _any),
    ),
    "points in narrow cells": (
        Place(reference_set, "cell_points", lambda domain, _: _no_points(_, domain), _any),
    ),
    "points inside jumps": (
        Place(reference_set, "inside_jumps", _first, lambda a, b, *_: (a != b).any()),
    ),
    "narrow times of quantities": (Place(reference_set, "narrow_times", _empty, _any),),
    "coverage of decades": (Place(points, "_spans_decades", _never, _true),),
    "digits that quantities lose": (
        Place(reference_set.ReferenceSet, "_resolving", _first, _other),
    ),
    "resolution of small states": (Place(resolution.Resolution, "refined", _never, _true),),
    "tolerances lowered for dips": (Place(resolution.Resolution, "lowered", _never, _true),),
    "shared references": (
        Place(
            stretches_by_markers,
            "reference_set_of",
            lambda *arguments: reference_set.ReferenceSet.of(*arguments),
            _always,
        ),
    ),
    "safe intervals beside a blow-up": (Place(attempts, "safe_intervals", lambda *_: (), _any),),
    # branches of events
    "branches of orders": (Place(ways, "solve_in_branches", _none),),
    "openings after a turn": (Place(branching, "opened_after", _none),),
    "openings at a beginning": (Place(branching, "opened_at_beginning", _none),),
    "openings alike": (Place(branching._Branching, "_opened_alike", _none),),
    "orders that are grazed": (Place(branching._Branching, "_may_be_grazed", _never, _true),),
    "steep orders in branches": (
        Place(ways.Engine, "_solve_steep", lambda _e, _s, _r, _p, steep: steep, _other),
    ),
    "branches: points near changes": (
        Place(branches, "points_near_changes", lambda _e, c: np.zeros((0, len(c.box))), _any),
    ),
    "branches: points with other events": (
        Place(
            branches,
            "points_with_other_events",
            lambda _e, _s, _o, c: np.zeros((0, len(c.box))),
            _any,
        ),
    ),
    "branches: undecided share": (Place(branches, "undecided_share", lambda *_: 0.0, _true),),
    # switches, markers, periods
    "held switches": (Place(reformulated, "held_form", _none),),
    "levels": (Place(reformulated, "levelled", _nothing, _any),),
    "markers": (Place(stretches_by_markers, "chosen_markers", lambda *_: (), _any),),
    "events in step": (Place(ways, "goes_in_step", _never, _true),),
    "late fronts": (Place(stretches_by_markers, "late_front", _none),),
    "periods that repeat": (
        Place(stretches_by_markers, "repeating_from", _zero, _true),
        Place(markers, "repeating_from", _zero, _true),
    ),
    "marks that are foreseen": (Place(stretches_by_markers, "_foreseeing", _first, _always),),
    "more events than the first ones met": (Place(ways, "SOLVE", _zero, _always),),
    # integrators
    "steps made again": (
        Place(defects.DefectControl, "missed", lambda *_: np.zeros(1, dtype=bool), _has),
    ),
    "steps made again at random places": (
        Place(
            defects.DefectControl,
            "_at_random",
            lambda control, _: np.zeros(control.parameters.shape[1]),
            lambda errors, *_: bool((errors > defects._DEFECTS.most_at_random).any()),
        ),
    ),
    "steps made again at crossings": (
        Place(
            defects.DefectControl,
            "_at_crossings",
            lambda control, *_: np.zeros(control.parameters.shape[1]),
            lambda errors, *_: bool((errors > defects._DEFECTS.most_at_crossings).any()),
        ),
    ),
    "kinks of stacks": (Place(stack.Kinks, "of", _none),),
    "groups of stacks": (
        Place(
            workers.GroupedStacks, "groups", lambda _s, _y, p: [p], lambda each, *_: len(each) > 1
        ),
    ),
    "stacks that are watched": (Place(integrator_choice._Watch, "__call__", _none, _always),),
    "Taylor steps": (Place(stack.TaylorTerms, "cost", lambda *_: math.inf, _always),),
    # interpolation
    "choice of scales": (
        Place(
            adaptive,
            "best_coordinates",
            lambda lines, *_: list(lines),
            lambda lines, *_: any(not line.basis.scale.is_identity for line in lines),
        ),
    ),
    "known elements": (Place(cross_engine.CrossMarcher, "_known_elements", _no_elements, _known),),
    "lines through the worst points": (Place(cross_engine.CrossMarcher, "_worst_lines", _none),),
    "slabs halved": (Place(cross_engine.CrossMarcher, "_halve_slabs", _none, _always),),
    "jumps looked for early": (Place(cross_engine, "first_jump", _none),),
    "divisions taken back": (
        Place(adaptive.AdaptiveInterpolation, "undo_division", _never, _true),
    ),
    "first lines of the engine in the reference": (
        Place(cross_engine, "_first_points", lambda s, r: np.zeros((0, len(r.domain.box))), _any),
    ),
    "growth of errors": (
        Place(train_engine, "amplification", lambda _: lambda _t: 1.0, _always),
        Place(greedy_engine, "amplification", lambda _: lambda _t: 1.0, _always),
    ),
    # the solve
    "a second engine": (Place(selection, "_FINAL", _zero, _always),),
    "attempts that persist": (Place(attempts.Progress, "pays", _never, _true),),
    "explanation of a failure": (
        Place(selection, "remedied", _first, _other),
        Place(selection, "remedied_error", _first, _other),
    ),
    "the steep parameter of a failure": (
        Place(
            cross_engine.CrossMarcher,
            "explained",
            lambda _m, s, _a: (s, None),
            lambda a, *_: a[1] is not None,
        ),
    ),
    "a narrower box predicted": (Place(attempts, "_narrowed", _nothing, _any),),
}
"""For each mechanism what is replaced by what."""

_NUMBERS: dict[str, tuple[Any, str, Any]] = {
    "more events than the first ones met": (ways, "SOLVE", replace(ways.SOLVE, most_more_events=0)),
    "a second engine": (selection, "_FINAL", tuple(ways.Status)),
}
"""Those that are switched off by a number."""


@contextmanager
def without(part: str) -> Iterator[None]:
    """Put stand-ins in place of a mechanism."""
    with ExitStack() as stack:
        if part in _NUMBERS:
            stack.enter_context(mock.patch.object(*_NUMBERS[part]))
        else:
            for place in PARTS[part]:
                new = place.replaced(place.instead)
                stack.enter_context(mock.patch.object(place.owner, place.name, new))
        yield


@contextmanager
def noting() -> Iterator[dict[str, str]]:
    """What is reached inside: for each mechanism ``called`` or ``acts``."""
    reached: dict[str, str] = {}

    def note(part: str, acts: bool) -> None:
        if acts or part not in reached:
            reached[part] = "acts" if acts else "called"

    with ExitStack() as stack:
        for part, places in PARTS.items():
            if part in _NUMBERS:
                continue
            for place in places:
                new = place.noting(lambda acts, part=part: note(part, acts))
                stack.enter_context(mock.patch.object(place.owner, place.name, new))
        yield reached


# -- runs -----------------------------------------------------------------------------------------


def reach(path: Path, rows_path: Path, cases: Sequence[tuple[str, verdicts.Fill]]) -> None:
    """Note what each case reaches, and its row."""
    reached = _read(path)
    rows = verdicts.read(rows_path)
    for name, fill in cases:
        if name in reached:
            continue
        with noting() as parts:
            row = verdicts.run(fill)
        rows[name], reached[name] = row, parts
        verdicts.write(rows_path, rows)
        _write(path, reached)
        print(verdicts.line(name, row), flush=True)


def solve_without(
    reached: Mapping[str, Mapping[str, str]],
    path: Path,
    parts: Sequence[str],
    cases: Sequence[tuple[str, verdicts.Fill]],
    most: int,
) -> None:
    """Solve cases in which a mechanism acts without it."""
    rows = verdicts.read(path)
    for part in parts:
        acting = [
            (name, fill)
            for name, fill in cases
            if part in _NUMBERS or reached.get(name, {}).get(part) == "acts"
        ]
        for name, fill in acting[:most]:
            key = f"{part} | {name}"
            if key in rows:
                continue
            with without(part):
                rows[key] = verdicts.run(fill)
            verdicts.write(path, rows)
            print(verdicts.line(key, rows[key]), flush=True)


def table(
    before: Mapping[str, verdicts.Row],
    reached: Mapping[str, Mapping[str, str]],
    after: Mapping[str, verdicts.Row],
) -> str:
    """A line for each mechanism, and below it the verdicts that changed."""
    lines = [
        "| left out | cases that reach it | it acts in | run without | verdicts changed | wrong "
        "| work |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    changes = list[str]()
    for part in PARTS:
        kinds = Counter(of_case[part] for of_case in reached.values() if part in of_case)
        rows = {
            name: row
            for key, row in after.items()
            for own, name in [key.split(" | ", 1)]
            if own == part and name in before
        }
        changed = [name for name, row in rows.items() if row.verdict != before[name].verdict]
        wrong = [name for name in changed if rows[name].verdict == "wrong"]
        work = sum(row.work for row in rows.values())
        share = work / (sum(before[name].work for name in rows) or 1.0)
        cells = sum(kinds.values()), kinds["acts"], len(rows), len(changed), len(wrong)
        lines.append(f"| {part} | {' | '.join(map(str, cells))} | {share:.2f} |")
        for name in changed:
            edge = " (borderline)" if verdicts.borderline(before[name]) else ""
            changes.append(
                f"{part} | {name}{edge}: {before[name].verdict} -> {rows[name].verdict} "
                f"{rows[name].kept} {rows[name].message[:80]}"
            )
    return "\n".join([*lines, "", *changes])


def _read(path: Path) -> dict[str, dict[str, str]]:
    return json.loads(path.read_text()) if path.exists() else {}


def _write(path: Path, reached: Mapping[str, Mapping[str, str]]) -> None:
    beside = path.with_suffix(".part")
    beside.write_text(json.dumps(reached, indent=1))
    beside.replace(path)


def main() -> int:
    """Run, or print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.honesty.parts")
    commands = parser.add_subparsers(dest="command", required=True)
    for command in ("reach", "without"):
        added = commands.add_parser(command)
        added.add_argument("reach", type=Path)
        if command == "reach":
            added.add_argument("--rows", type=Path, required=True)
        else:
            added.add_argument("rows", type=Path)
            added.add_argument("--base", type=Path, required=True, help="rows with everything")
            added.add_argument("--part", nargs="+", choices=PARTS, default=[*PARTS], metavar="PART")
            added.add_argument("--most", type=int, default=12, help="cases of each mechanism")
            added.add_argument("--work", type=float, default=3e9, help="leave out dearer cases")
        verdicts.add_options(added)
    printing = commands.add_parser("table")
    for name in ("base", "reach", "rows"):
        printing.add_argument(name, type=Path)
    options = parser.parse_args()
    if options.command == "table":
        rows = verdicts.read(options.base), _read(options.reach), verdicts.read(options.rows)
        print(table(*rows))
        return 0
    cases = list(verdicts.asked(options))
    if options.command == "reach":
        reach(options.reach, options.rows, cases)
        return 0
    base = verdicts.read(options.base)
    cases = [case for case in cases if case[0] in base and base[case[0]].work <= options.work]
    cases.sort(key=lambda case: base[case[0]].seconds)
    solve_without(_read(options.reach), options.rows, options.part, cases, options.most)
    return 0


if __name__ == "__main__":
    sys.exit(main())
