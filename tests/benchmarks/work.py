"""Compare counted work with processor time: python tests/benchmarks/work.py [--kind published]

An operation of a budget stands for a nanosecond of one quiet core. The table shows both for each
solve, and their ratio, which should be between a half and two wherever a solve takes long: then
``effort="normal"`` is about 25 seconds of a quiet core. On shared cores the ratios are smaller.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

import rankone as ro  # noqa: E402
from rankone.support.budget import limited  # noqa: E402
from tests.honesty.cases import KINDS, case  # noqa: E402
from tests.problems import EXAMPLES  # noqa: E402
from tests.reference.published import PUBLISHED  # noqa: E402

LONG = 0.1
"""Processor seconds from which a solve counts in the summary."""
Solve = tuple[str, Callable[[], object]]


def reference() -> Iterator[Solve]:
    """Reference problems with every engine that takes them."""
    for name, example in EXAMPLES.items():
        compiled = ro.compile(example.problem)
        for method in (name for name, reason in compiled.methods.items() if reason is None):
            for rtol in (1e-3,) if method == "greedy" else (1e-3, 1e-6):
                yield f"{name}, {method}, {rtol:g}", partial(compiled.solve, rtol, method=method)


def published() -> Iterator[Solve]:
    """Published systems, with the engines that are taken for them."""
    for name, entry in PUBLISHED.items():
        compiled = ro.compile(entry.problem())
        yield name, partial(compiled.solve, 1e-4)


def honesty() -> Iterator[Solve]:
    """Random and hostile systems, some of each kind."""
    for kind in KINDS:
        for seed in range(4):
            drawn = case(kind, seed)
            try:
                compiled = ro.compile(drawn.problem())
            except ro.RankoneError:
                continue
            yield f"{kind} {seed}", partial(compiled.solve, drawn.rtol)


SETS = {"reference": reference, "published": published, "honesty": honesty}


def compared(solve: Callable[[], object]) -> tuple[float, float, str]:
    """Processor seconds, operations, and how a solve ended."""
    began = time.process_time()
    with limited() as account, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            ended = str(getattr(solve(), "message", ""))
        except ro.RankoneError as error:
            ended = f"{type(error).__name__}: {error}"
    return time.process_time() - began, account.done, ended


def main() -> None:
    """Print a line for each solve, and the quantiles of the ratios."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kind", choices=SETS, help="one set alone")
    kinds = [parser.parse_args().kind] if parser.parse_args().kind else list(SETS)
    ratios = []
    for name, solve in (pair for kind in kinds for pair in SETS[kind]()):
        seconds, work, ended = compared(solve)
        ratio = 1e-9 * work / seconds
        if seconds >= LONG:
            ratios.append(ratio)
        print(f"{ratio:6.2f} {seconds:8.2f} s {1e-9 * work:8.2f}  {name}: {ended[:90]}", flush=True)
    shares = np.quantile(ratios, [0.0, 0.1, 0.5, 0.9, 1.0])
    texts = ", ".join(f"{share:.2f}" for share in shares)
    print(f"work over time of {len(ratios)} solves, least, 10 %, median, 90 %, largest: {texts}")


if __name__ == "__main__":
    main()
