"""The summary of a solution of fields, as text and as a table."""

from __future__ import annotations

from rankone.solution.evaluation.presentation import in_lines, in_table, over, some, trains
from rankone.solution.solution import Solution
from rankone.solvers.reduced.field_modes import FieldModes
from rankone.support.errors import count, shortened


def field_summary_text(coefficients: Solution, modes: FieldModes, verdict: str) -> str:
    """The summary in lines; the verdict says whether it is a success, and why."""
    title = f"FieldSolution (rankone {coefficients.metadata.version})".replace(" (rankone )", "")
    return in_lines(title, _summary(coefficients, modes, verdict))


def field_summary_html(coefficients: Solution, modes: FieldModes, verdict: str) -> str:
    """The summary as a table, for notebooks."""
    return in_table("FieldSolution", _summary(coefficients, modes, verdict))


def _summary(coefficients: Solution, modes: FieldModes, verdict: str) -> list[tuple[str, str]]:
    """Headings and texts of the summary."""
    unknowns = [
        f"{unknown.name} ({count(len(own), 'entry', 'entries')}, {count(own.shape[1], 'mode')})"
        if unknown.is_field
        else unknown.name
        for unknown, own in zip(modes.unknowns, modes.modes, strict=True)
    ]
    timings = [f"{stage} {seconds:.3g} s" for stage, seconds in coefficients.timings.items()]
    return [
        ("unknowns", some(unknowns)),
        ("over", over(coefficients)),
        ("success", shortened(verdict)),
        ("error", _error(coefficients, modes)),
        (coefficients.method, trains(coefficients.outcome)),
        *([("timings", ", ".join(timings))] if timings else []),
    ]


def _error(coefficients: Solution, modes: FieldModes) -> str:
    """The measured errors, and of which norm."""
    tolerance = f"tolerance {coefficients.rtol:.3g}"
    if not modes.errors:
        return f"not measured, {tolerance}"
    text = f"{max(modes.errors):.2g} measured at all entries, relative to the largest value of the "
    text += (
        f"field, {tolerance}; {count(modes.trajectories, 'full trajectory', 'full trajectories')}"
    )
    if len(modes.errors) > 1:
        pairs = zip(modes.unknowns, modes.errors, strict=True)
        text += "; " + some(f"{unknown.name} {error:.2g}" for unknown, error in pairs)
    return text
