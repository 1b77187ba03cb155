"""Generated functions of random expressions have the digits that their condition leaves.

``pytest -m slow`` tries 200 of them, ``python tests/benchmarks/expressions.py`` 2,000.
"""

import pytest

from tests.compiler.codegen.condition import KINDS, check, check_part

pytestmark = pytest.mark.filterwarnings("ignore:parameter .* appears nowhere")


@pytest.mark.parametrize("kind", KINDS)
def test_some(kind):
    check(kind, 5000 + 100 * KINDS.index(kind), 5)


@pytest.mark.slow
def test_further_ones():
    """One of the hundred parts that tests/benchmarks/expressions.py checks."""
    check_part(0)
