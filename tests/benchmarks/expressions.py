"""Digits of generated functions: python tests/benchmarks/expressions.py

Two thousand random expressions as rates, initial values, values after jumps, and outputs, against
values with 400 digits; ``pytest -m slow`` tries the first 600. Prints those that have fewer digits
than their condition leaves; the exit status is 1 if there are any.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

import rankone as ro  # noqa: E402
from tests.compiler.codegen.condition import PART, check_part  # noqa: E402


def main() -> int:
    """Check one part after the other."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", type=int, default=100, help=f"parts of {PART} expressions")
    count = parser.parse_args().parts
    warnings.simplefilter("ignore", ro.RankoneWarning)
    failures = []
    for part in range(count):
        try:
            check_part(part)
        except AssertionError as error:
            failures.append(str(error))
            print(f"part {part}: {error}", flush=True)
    print(f"{count * PART} expressions, {len(failures)} of {count} parts fail")
    return int(bool(failures))


if __name__ == "__main__":
    sys.exit(main())
