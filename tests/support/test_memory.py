"""Amounts of memory, and the limit that needs are compared with."""

import math
import pickle

import pytest

from rankone.support.budget import OutOfMemoryError, limited, memory_limit, reserve
from rankone.support.errors import OptionError
from rankone.support.memory import checked_memory, in_words


@pytest.mark.parametrize(
    ("amount", "count"),
    [
        (10**9, 1e9),
        ("2GB", 2e9),
        ("1.5 gib", 1.5 * 2**30),
        ("500MB", 5e8),
        ("100000000", 1e8),
        (" .5 G ", 5e8),
    ],
)
def test_amounts(amount, count):
    assert checked_memory("max_memory", amount) == count


@pytest.mark.parametrize("amount", ["2 G B", "much", "-1GB", "", 0, True, -1e9, math.nan, "1kB"])
def test_what_is_no_amount(amount):
    with pytest.raises(OptionError, match="max_memory="):
        checked_memory("max_memory", amount)


def test_in_words():
    assert in_words(2.15e9) == "2.15 GB"
    assert in_words(5e8) == "500 MB"
    assert in_words(1234) == "1.23 kB"


def test_needs_are_compared_with_the_smallest_limit():
    reserve(1e30)
    with limited(memory=1e9), limited(memory=2e9):
        assert memory_limit() == 1e9
        reserve(1e9)
        with pytest.raises(OutOfMemoryError) as caught:
            reserve(1.1e9)
    assert memory_limit() == math.inf
    again = pickle.loads(pickle.dumps(caught.value))
    assert (again.needed, again.limit) == (1.1e9, 1e9)
