"""Progress: callbacks and the bar."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest

import rankone as ro
from rankone.support.budget import ProgressEvent, resolve_progress
from rankone.support.errors import OptionError

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


def test_cross_moves_within_an_attempt() -> None:
    box = dict.fromkeys("abcd", (0.0, 1.0))
    problem = ro.Problem.from_strings({"x": "-a*x + sin(b*t) + c*d*x**2"}, {"x": "0"}, box, (0, 1))
    events: list[ProgressEvent] = []
    assert ro.solve(problem, 1e-5, method="cross", progress=events.append).success
    for attempt in range(events[-1].attempt + 1):
        fractions = [event.fraction for event in events if event.attempt == attempt]
        assert len(fractions) >= 5
        assert all(later > earlier for earlier, later in pairwise(fractions))
        assert fractions[0] < 0.2
        assert fractions[-1] == 1.0
    assert all(event.time == 0.0 for event in events if event.fraction < 1.0)
    assert events[-1].time == 1.0
    ranks = [event.rank for event in events if event.attempt == 0]
    assert ranks[-2] > 1


def test_an_exception_of_a_callback_stops_cross_between_batches() -> None:
    problem = ro.Problem.from_strings({"x": "-a*x"}, {"x": "b"}, {"a": (1, 2), "b": (1, 2)}, (0, 1))

    def stop(event: ProgressEvent) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ro.solve(problem, method="cross", progress=stop)
