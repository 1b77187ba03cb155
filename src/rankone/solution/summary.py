"""What a solution says about itself when it is printed."""

from __future__ import annotations

import html
import textwrap
from collections.abc import Iterable
from typing import Any

from rankone.ir.metadata import with_unit
from rankone.support.wording import listing

__all__ = ["summary_html", "summary_text"]

_WIDTH = 96
_MOST_NAMES = 8


def summary_text(solution: Any) -> str:
    """The summary in lines."""
    lines = [f"Solution (rankone {solution.metadata.version})".replace(" (rankone )", "")]
    for heading, text in _summary(solution):
        lines += textwrap.wrap(
            text,
            _WIDTH,
            initial_indent=f"  {heading:<10}",
            subsequent_indent=" " * 12,
            break_long_words=False,
        )
    return "\n".join(lines)


def summary_html(solution: Any) -> str:
    """The summary as a table, for notebooks."""
    rows = "".join(
        f"<tr><th style='text-align:left'>{html.escape(heading)}</th>"
        f"<td style='text-align:left'>{html.escape(text)}</td></tr>"
        for heading, text in _summary(solution)
    )
    return f"<table><caption>Solution</caption><tbody>{rows}</tbody></table>"


def _summary(solution: Any) -> list[tuple[str, str]]:
    """Headings and texts of the summary."""
    measured = solution.outcome.measured
    asked = f"tolerance {solution.rtol:.3g}"
    if measured is None:
        error = f"not measured, {asked}"
    else:
        error = f"{solution.error:.2g} measured on {measured.points} trajectories, {asked}"
        if measured.drift is not None:
            error += f", lifted states drift by {measured.drift:.2g}"
        if measured.counted is not None:
            error = f"of {listing(solution.states[i] for i in measured.counted)} {error}"
        if measured.quantile is not None:
            error += f", 95 % below {measured.quantile:.2g}"
        if len(solution.errors) > 1:
            error += "; " + _some(
                [f"{name} {value:.2g}" for name, value in solution.errors.items()]
            )
    start, end = solution.time
    lower, upper = solution.metadata.horizon
    whole = "" if end == upper else f" of [{lower:g}, {upper:g}]"
    units = dict(solution.metadata.units)
    named = [f"{name} [{units[name]}]" if name in units else name for name in solution.unknowns]
    clock = f"{solution.metadata.time} in [{start:g}, {end:g}]{whole}"
    clock = with_unit(clock, units, solution.metadata.time)
    given = dict(solution.metadata.distributions)
    box = [
        with_unit(f"{name} in [{lo:g}, {hi:g}]", units, name)
        + (f" ~ {given[name]}" if name in given else "")
        for name, (lo, hi) in solution.parameters.items()
    ]
    over = _some(box if solution.metadata.timeless else [clock, *box]) or "nothing"
    if solution.metadata.fixed:
        over += "; at " + _some(f"{name} = {value:g}" for name, value in solution.metadata.fixed)
    count = len(solution.outcome.slabs)
    train = [f"{count} slab" + ("" if count == 1 else "s"), f"rank {solution.rank}"]
    if solution.nodes:
        largest = (max(column) for column in zip(*solution.ranks, strict=True))
        train.append(f"ranks up to ({_some(map(str, largest))})")
        train.append(f"nodes up to ({_some(map(str, solution.nodes))})")
    train.append(f"{solution.nbytes / 1e6:.2g} MB")
    timings = [f"{stage} {seconds:.3g} s" for stage, seconds in solution.timings.items()]
    return [
        ("unknowns", _some(named)),
        ("over", over),
        ("success", f"{'yes' if solution.success else 'no'}: {solution.message}"),
        ("error", error),
        (solution.metadata.method, ", ".join(train)),
        ("timings", ", ".join(timings) or "none"),
    ]


def _some(texts: Iterable[str]) -> str:
    """Join texts, leaving out the middle of many."""
    shown = list(texts)
    if len(shown) > _MOST_NAMES:
        hidden = len(shown) - _MOST_NAMES + 1
        shown[_MOST_NAMES - 2 : -1] = [f"... ({hidden} more)"]
    return ", ".join(shown)
