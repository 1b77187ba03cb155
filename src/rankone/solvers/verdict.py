"""What a user reads of how a solve ended: cause, figures, what stood in the way, remedy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rankone.ir.outcome import Measured, Status
from rankone.solvers.march import MarchResult
from rankone.support.wording import listing, quote

__all__ = ["Verdict", "spent_sentence"]

_STAGES = {
    "reference": "the reference trajectories",
    "samples": "samples",
    "march": "the march",
    "ranks": "ranks",
    "check": "the check",
}
"""What the stages of a solve are called."""
_NAMED = 4
"""Most unknowns that are named."""
_SAID = 0.005
"""Share of the budget from which a stage is named."""


@dataclass(frozen=True)
class Verdict:
    """How a solve ended, in pieces; ``str`` makes a sentence of them.

    Attributes
    ----------
    status : Status
    cause : str
        Why it ended.
    rtol : float
        The tolerance asked for.
    measured : Measured or None
    result : MarchResult
        What the best attempt came to.
    states : sequence of str
        Names of the states.
    work : mapping of str to float
        Operations by stage.
    budget : float
        Operations that there were in all; infinite without a limit.
    remedy : str or None
    """

    status: Status
    cause: str
    rtol: float
    measured: Measured | None
    result: MarchResult
    states: Sequence[str]
    work: Mapping[str, float]
    budget: float
    remedy: str | None = None

    def __str__(self) -> str:
        converged = self.status is Status.CONVERGED
        text = self.cause + (self._in_the_interior if converged else "") + self._figures
        notes = [] if converged else [*self._unknowns, *self._extent, *self._spent]
        remedy = [] if self.remedy is None else [self.remedy]
        return "; ".join([text, *notes, *remedy])

    @property
    def _in_the_interior(self) -> str:
        return " in the interior of the box" if self._corners else ""

    @property
    def _corners(self) -> float:
        """The error at corners where it is the worse one, or 0."""
        if self.measured is None:
            return 0.0
        corner = self.measured.corner_error
        return corner if corner > max(self.rtol, self.measured.error) else 0.0

    @property
    def _figures(self) -> str:
        if self.measured is None:
            return ""
        error = self.measured.error
        figures = f": {error:.1e} of {self.rtol:.1e}"
        if self.status is not Status.CONVERGED:
            worst = f" in {quote(self._name(self._by_error[0]))}" if self._several else ""
            figures = f": measured error {error:.1e}{worst}, asked {self.rtol:.1e}"
        if self._corners:
            figures += (
                f" (up to {self._corners:.1e} at the corners, which cover='box' asks for too)"
            )
        return figures

    @property
    def _several(self) -> bool:
        """Whether several unknowns count."""
        return len(self._by_error) > 1

    @property
    def _by_error(self) -> list[int]:
        """The states that count, the worst first."""
        assert self.measured is not None
        errors, counted = self.measured.interior, self.measured.counted
        chosen = range(len(errors)) if counted is None else counted
        return sorted(chosen, key=lambda i: -errors[i])

    def _name(self, state: int) -> str:
        return self.states[state]

    @property
    def _unknowns(self) -> list[str]:
        """Which unknowns are accurate enough, if others are not."""
        if self.measured is None or self.result.stopped is not None:
            return []
        errors = self.measured.interior
        enough = sorted(i for i in self._by_error if errors[i] <= self.rtol)
        failed = [i for i in self._by_error if errors[i] > self.rtol]
        if not enough or not failed:
            return []
        if len(enough) <= _NAMED:
            names = [self._name(i) for i in enough]
            are, it = ("is", "it") if len(names) == 1 else ("are", "them")
            return [f"{listing(names)} {are} within it: unknowns={names!r} asks for {it} alone"]
        worst = listing(self._name(i) for i in failed[:_NAMED])
        others = f" and {len(failed) - _NAMED} more" if len(failed) > _NAMED else ""
        return [f"all but {worst}{others} are within it: unknowns= asks for some alone"]

    @property
    def _extent(self) -> list[str]:
        """How much of the horizon or of the box was solved."""
        if self.result.stopped is None:
            return []
        if self.result.whole:
            return ["rank 1: nothing was interpolated yet, the values are those at the centre"]
        slabs = self.result.slabs
        return [f"stopped at t = {slabs[-1].end:.6g}" if slabs else "stopped before the first slab"]

    @property
    def _spent(self) -> list[str]:
        sentence = spent_sentence(self.work, self.budget)
        return [sentence] if sentence else []


def spent_sentence(work: Mapping[str, float], budget: float) -> str:
    """The shares of the budget that each stage took; empty without a budget."""
    shares = {stage: done / budget for stage, done in work.items()}
    told = [(_STAGES[s], 100.0 * share) for s, share in shares.items() if share >= _SAID]
    if not told:
        return ""
    (first, share), *others = told
    further = "".join(f", {stage} {part:.0f} %" for stage, part in others)
    return f"{first} took {share:.0f} % of the budget{further}"
