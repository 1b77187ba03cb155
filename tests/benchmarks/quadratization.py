"""How many unknowns lifting and lowering add: ``python tests/benchmarks/quadratization.py``.

Lifted unknowns have differential equations of their own; products of states are algebraic. QBee
makes a quadratic system, so that its unknowns serve as both.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

import rankone as ro
from tests.reference.quadratization import PROBLEMS


def added(rates: dict[str, str]) -> tuple[int, int]:
    """Lifted unknowns and products of a system."""
    problem = ro.Problem.from_strings(rates, dict.fromkeys(rates, 1), {}, (0, 1))
    compiled = ro.compile(problem)
    if compiled.quadratic is not None:
        return 0, len(compiled.quadratic.products)
    return compiled.lifted.lifting.count, len(compiled.lifted.quadratic.products)


def main() -> None:
    print("| problem | unknowns | QBee | lifted | products | together, beyond QBee |")
    print("| --- | ---: | ---: | ---: | ---: | ---: |")
    for name, (rates, others) in PROBLEMS.items():
        lifted, products = added(rates)
        beyond = lifted + products - others
        print(f"| {name} | {len(rates)} | {others} | {lifted} | {products} | {beyond:+d} |")


if __name__ == "__main__":
    main()
