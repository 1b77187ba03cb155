"""Lists of names in messages."""

import pytest

from rankone.support.errors import listing

MANY = [f"x{i}" for i in range(300)]


@pytest.mark.parametrize(
    ("subjects", "near", "text"),
    [
        ([], None, ""),
        (["a"], None, "`a`"),
        (["a", "b", "c"], None, "`a`, `b` and `c`"),
        (
            iter("abcdefghijklmnop"),
            None,
            "`a`, `b`, `c`, `d`, `e`, `f`, `g`, `h`, `i`, `j`, `k`, `l`, `m`, `n`, `o` and `p`",
        ),
        (MANY, None, "`x0`, `x1`, `x2`, `x3`, `x4`, `x5` and 294 others"),
    ],
)
def test_lists(subjects, near, text):
    assert listing(subjects, near) == text


def test_long_lists_begin_with_the_nearest():
    text = listing(MANY, "xx207")
    assert text.startswith("`x207`")
    assert text.endswith("and 294 others")
    assert len(text) < 80
