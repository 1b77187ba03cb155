"""Solve 12 stiff kinetic networks: python tests/benchmarks/kinetics.py [--only NAME --rtol 1e-3]

The networks of tests/reference/kinetics.py, 15 to 40 states, three constants × and ÷ 1.5. The
reference trajectories should take at most 30 % of the budget. For the columns and the verdicts see
tests/benchmarks/suite.py.
"""

from pathlib import Path
from sys import path

path[:0] = [str(Path(__file__).resolve().parents[2])]

from tests.benchmarks import suite  # noqa: E402

if __name__ == "__main__":
    suite.main(__doc__.splitlines()[0], "kinetics", (1e-3, 1e-4))
