"""What happened in the loops of the classic method, as data."""

from __future__ import annotations

from dataclasses import dataclass

from rankone.ir.outcome import SlabRecord


@dataclass(frozen=True, slots=True)
class ModeRecord:
    """One enrichment.

    Attributes
    ----------
    differences : tuple of float
        Change of the mode in each pass of the fixed point, relative to the mode.
    amplitude : float
        Its norm when it was found, in units of the state's size.
    residual : float
        Residual ``||D(U) - G||`` after the projection or update, in units of the state's size:
        with ``projection="minimal-residual"`` the norm over the box, otherwise the norm of the
        residual tested with the shape functions.
    """

    differences: tuple[float, ...]
    amplitude: float
    residual: float


@dataclass(frozen=True, slots=True)
class EquationRecord:
    """One solve of one equation with lagged terms.

    Attributes
    ----------
    iteration : int
        Number of the update of the lagged terms, from 0.
    state : str
        The state solved for.
    modes : tuple of ModeRecord
        Enrichments in this solve; none if the modes of the iteration before sufficed.
    amplitudes : tuple of float
        Amplitudes of all modes afterwards, descending, in units of the state's size.
    residual : float
        Residual at the end, tested with the shape functions or, with
        ``projection="minimal-residual"``, with the operator applied to them: what stops a loop.
    change : float
        Distance to the unknown of the iteration before, in units of the state's size.
    """

    iteration: int
    state: str
    modes: tuple[ModeRecord, ...]
    amplitudes: tuple[float, ...]
    residual: float
    change: float


@dataclass(frozen=True, slots=True)
class GreedySlabRecord(SlabRecord):
    """One slab of the classic method.

    ``residuals`` holds the largest change of a state in each update of the lagged terms, ``ranks``
    the number of modes of each state, ``nodes`` those in time and in the parameters.

    Attributes
    ----------
    equations : tuple of EquationRecord
        Every solve of every equation, in order.
    """

    equations: tuple[EquationRecord, ...] = ()
