"""What every engine offers, and what it is asked."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from rankone.ir.domain import Domain
from rankone.ir.outcome import Outcome, SlabRecord
from rankone.ir.system import System
from rankone.support.errors import OptionError
from rankone.support.options import Options, checked_number
from rankone.support.progress import Report, quiet

__all__ = ["Engine", "Report", "Request"]

_TIGHTEST, _LOOSEST = 1e-10, 0.1
_CHECK_POINTS = 96
_COVERS = ("interior", "box")

AnyOptions = TypeVar("AnyOptions", bound=Options)


@dataclass(frozen=True)
class Request(Generic[AnyOptions]):
    """What is asked of a solve.

    Attributes
    ----------
    rtol : float
        Largest measured error asked for, relative to the size of each unknown.
    points : int
        Number of interior check points; 0 skips the check.
    options : Options
        Limits and discretisation, those of the engine.
    cover : {"interior", "box"} or None
        Whether success covers the corners of the box; None where there are few parameters.
    counted : tuple of int or None
        The states whose error counts; None for all.
    """

    rtol: float
    points: int
    options: AnyOptions
    cover: str | None = None
    counted: tuple[int, ...] | None = None


@dataclass(frozen=True)
class Engine(Generic[AnyOptions]):
    """A way to solve a generated system for a whole box.

    ``name`` is the ``method`` of ``rankone.solve``; ``record`` is what the history consists of. The
    status of the Outcome is CONVERGED only if the measured error is within the tolerance asked.
    """

    name: str
    options: type[AnyOptions]
    record: type[SlabRecord]
    solve: Callable[[System, Domain, Request[AnyOptions], Report], Outcome]

    def request(
        self,
        rtol: float,
        check: bool | int,
        options: Mapping[str, Any],
        keywords: Sequence[str] = (),
        cover: str | None = None,
    ) -> Request[AnyOptions]:
        """What is asked, or an OptionError: 96 points for ``check=True``, none for False.

        ``keywords`` are what the caller takes beside options.
        """
        rtol = checked_number("rtol", rtol, _TIGHTEST, _LOOSEST, float)
        points = (
            _CHECK_POINTS * check if isinstance(check, bool) else checked_number("check", check, 0)
        )
        if cover is not None and (not isinstance(cover, str) or cover not in _COVERS):
            raise OptionError(
                f"cover={cover!r} is not valid", remedy="choose 'interior' or 'box'", term=cover
            )
        return Request(rtol, points, self.options.of(keywords, **options), cover)

    def run(
        self,
        system: System,
        rtol: float = 1e-6,
        *,
        domain: Domain | None = None,
        check: bool | int = True,
        report: Report = quiet,
        **options: Any,
    ) -> Outcome:
        """Solve a generated system directly, by default on the domain it was written for."""
        request = self.request(rtol, check, options)
        return self.solve(system, domain or Domain.of(system), request, report)
