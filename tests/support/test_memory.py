"""Amounts of memory, and the limit that needs are compared with."""

import math
import pickle

import pytest

from rankone.support.budget import OutOfMemoryError, Reached, hold, limited, memory_left, reserve
from rankone.support.errors import OptionError
from rankone.support.options import checked_memory, in_words


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


def test_amounts_are_shown_as_they_were_given():
    for amount in ("3MB", 3e6):
        message = f"max_memory={amount!r} is too little; remedy: give at least 50 MB"
        with pytest.raises(OptionError, match=message):
            checked_memory("max_memory", amount)


def test_in_words():
    assert in_words(2.15e9) == "2.15 GB"
    assert in_words(5e8) == "500 MB"
    assert in_words(1234) == "1.23 kB"


def test_needs_are_compared_with_the_smallest_limit():
    reserve(1e30)
    with limited(memory=1e9), limited(memory=2e9):
        assert memory_left() == 1e9
        reserve(1e9)
        with pytest.raises(OutOfMemoryError) as caught:
            reserve(1.1e9)
    assert memory_left() == math.inf
    out = caught.value.at(Reached(0.5, 3, None))
    again = pickle.loads(pickle.dumps(out))
    assert (again.needed, again.limit, again.reached) == (1.1e9, 1e9, out.reached)


def test_bytes_are_held_as_long_as_their_owner_lives():
    def owner():
        return lambda: None

    hold(owner(), 1e30)
    with limited(memory=1e9):
        first, second = owner(), owner()
        hold(first, 6e8)
        with limited(memory=8e8), pytest.raises(OutOfMemoryError) as caught:
            hold(second, 3e8, expected=1e8)
        assert (caught.value.needed, caught.value.limit) == (1e9, 8e8)
        assert memory_left() == 4e8
        with pytest.raises(OutOfMemoryError):
            reserve(5e8)
        del first
        assert memory_left() == 1e9
        hold(second, 1e9)
