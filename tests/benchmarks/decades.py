"""Solve 15 systems with parameters over decades: python tests/benchmarks/decades.py [--only NAME]

The systems of tests/reference/decades.py, whose intervals do not say that they are logarithmic;
half of the points at which solutions are measured are drawn in logarithms. For the columns and the
verdicts see tests/benchmarks/suite.py.
"""

from pathlib import Path
from sys import path

path[:0] = [str(Path(__file__).resolve().parents[2])]

from tests.benchmarks import suite  # noqa: E402

if __name__ == "__main__":
    suite.main(__doc__.splitlines()[0], "decades", (1e-3,))
