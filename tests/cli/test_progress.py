"""Progress: callbacks and the bar."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rankone.errors import OptionError
from rankone.progress import ProgressEvent, resolve_progress

EVENT = ProgressEvent(time=1.5, fraction=0.5, attempt=1, slabs=4, rank=9)


def test_callbacks_are_handed_through() -> None:
    seen: list[ProgressEvent] = []
    with resolve_progress(seen.append) as report:
        report(EVENT)
    assert seen == [EVENT]


def test_nothing() -> None:
    with resolve_progress(False) as report:
        report(EVENT)


def test_bar(capsys: pytest.CaptureFixture[str]) -> None:
    with resolve_progress(True) as report:
        report(EVENT)
    out, err = capsys.readouterr()
    assert out == ""
    assert "solving (attempt 2)  50% |" in err
    assert "t = 1.5, 4 slabs, rank 9" in err


def test_one_slab(capsys: pytest.CaptureFixture[str]) -> None:
    with resolve_progress(True) as report:
        report(replace(EVENT, slabs=1))
    assert "t = 1.5, 1 slab, rank 9" in capsys.readouterr().err


def test_anything_else_is_an_error() -> None:
    with pytest.raises(OptionError, match="progress is 3"):
        resolve_progress(3)  # type: ignore[arg-type]
