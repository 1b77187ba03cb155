"""What each part of the check finds: ``python -m tests.honesty.parts --count 40``.

Solves random and hostile systems with one part of the check after the other left out, and prints
how many of the successes are wrong then.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import contextlib
import functools
import multiprocessing
import sys
from collections.abc import Callable
from unittest import mock

import numpy as np

from tests.honesty.cases import KINDS, case
from tests.honesty.verdicts import judged


def _nothing(*_: object) -> None:
    """No points."""


def _no_points(system: object, domain: object) -> np.ndarray:
    return np.zeros((0, len(domain.box)))  # type: ignore[attr-defined]


def _few(box: np.ndarray, count: int, *arguments: object, **options: object) -> np.ndarray:
    """A quarter of the points, and nothing beside special values."""
    from rankone.solvers.verification.points import check_points

    options.pop("cuts", None)
    return check_points(box, count // 4, *arguments, **options)  # type: ignore[arg-type]


_EFFORT = 0.3
"""Limit of the work of each solve."""
_REFERENCE = "rankone.solvers.verification.reference_set"
PARTS: dict[str, tuple[str, Callable[..., object]] | None] = {
    "nothing": None,
    "cuts of one coordinate": (
        f"{_REFERENCE}.system_cuts",
        lambda system, domain: _no_cuts(domain),
    ),
    "three quarters of the evenly spread points": (f"{_REFERENCE}.check_points", _few),
    "points where products of factors are active": (f"{_REFERENCE}.active_points", _no_points),
    "points on surfaces of several parameters": (
        f"{_REFERENCE}.surface_points",
        _no_points,
    ),
    "points of the residual": ("rankone.solvers.attempts.worst_points", _nothing),
    "steep points and narrow elements": (
        "rankone.solvers.engines.cross.cross_engine.candidate_points",
        _nothing,
    ),
    "steps made again": (
        "rankone.trajectories.integrators.defects.DefectControl.missed",
        lambda *_: np.zeros(1, dtype=bool),
    ),
}
"""For each part what it is, and what stands in for it."""


def _no_cuts(domain: object) -> tuple[object, ...]:
    from rankone.solvers.verification.cuts import Cuts

    return (Cuts(),) * (1 + len(domain.box))  # type: ignore[attr-defined]


def without(part: str, made: tuple[str, int]) -> str:
    """The verdict on a case with a part left out."""
    import rankone.solvers.engines.cross.cross_engine  # what is replaced must be there
    import rankone.trajectories.stacks.explicit  # noqa: F401

    replaced = PARTS[part]
    with mock.patch(*replaced) if replaced else contextlib.nullcontext():
        return judged(case(*made), effort=_EFFORT).verdict


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.honesty.parts", description=__doc__)
    parser.add_argument("--kind", choices=KINDS, nargs="*", default=list(KINDS))
    parser.add_argument("--count", type=int, default=40, help="cases of each kind")
    parser.add_argument("--seed", type=int, default=0, help="the first seed")
    parser.add_argument("--processes", type=int, default=1)
    given = parser.parse_args()
    print(f"| left out | {' | '.join(given.kind)} |\n| --- |{' ---: |' * len(given.kind)}")
    with multiprocessing.get_context("spawn").Pool(given.processes) as pool:
        for part in PARTS:
            wrong = []
            for kind in given.kind:
                made = [(kind, given.seed + i) for i in range(given.count)]
                found = pool.map(functools.partial(without, part), made, chunksize=1)
                bad, good = found.count("wrong"), found.count("ok")
                wrong.append(f"{bad} of {bad + good}")
            print(f"| {part} | {' | '.join(wrong)} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
