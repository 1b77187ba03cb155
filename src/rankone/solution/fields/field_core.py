"""Fields at times and parameters, and how they were found.

:class:`~rankone.solution.fields.field_solution.FieldSolution` adds statistics, outputs and files.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from rankone.solution.fields.field_presentation import field_summary_html, field_summary_text
from rankone.solution.fields.field_view import FieldView, missing_member
from rankone.solution.solution import Solution
from rankone.solvers.outcome import SlabRecord, SolutionMetadata
from rankone.solvers.reduced.field_modes import FieldModes
from rankone.support.arrays import Array
from rankone.support.errors import (
    EvaluationError,
    OptionError,
    count,
    did_you_mean,
    listing,
    quote,
)
from rankone.tensors.coordinates import name_of
from rankone.trajectories.system.timeline import BranchedTimeline, Timeline
from rankone.trajectories.system.verdict import Status


@dataclass(frozen=True, repr=False, eq=False)
class FieldCore:
    """Fields as functions of time and of all parameters: modes times coefficients.

    Its arguments are those of :class:`~rankone.solution.fields.field_solution.FieldSolution`.
    """

    coefficients: Solution
    modes: FieldModes
    message: str = ""
    status: Status = None  # type: ignore[assignment]  # completed below

    def __post_init__(self) -> None:
        if self.coefficients.unknowns != self.modes.names:
            raise OptionError(
                f"the solution of coefficients has {listing(self.coefficients.unknowns)}, and "
                f"the modes need {listing(self.modes.names)}",
                remedy="solve for the coefficients of the modes, in their order",
            )
        if self.status is None:
            object.__setattr__(self, "status", self._measured_status())
        if not self.message:
            object.__setattr__(self, "message", self.status.value)

    def _measured_status(self) -> Status:
        """What the measured errors say."""
        if not self.modes.errors:
            return Status.UNCHECKED
        return Status.CONVERGED if self.error <= self.rtol else Status.TOLERANCE

    # --- evaluation ----------------------------------------------------------------------------

    def __call__(
        self, *at: object, max_memory: str | float | None = None, **named: object
    ) -> Array:
        """Evaluate all entries of all unknowns.

        Arguments and errors are those of a call of a :class:`~rankone.Solution`.

        Returns
        -------
        ndarray (entries of all unknowns, *broadcast shape of the values)
        """
        solved = self.coefficients
        gathered = solved._coordinates.gather(at, named)
        point = solved._coordinates.numbers(gathered) if max_memory is None else None
        if point is not None:
            return self.modes.fields(solved._evaluator.one(point, solved._unknowns))

        def evaluate(arrays: Any) -> Array:
            return self.modes.fields(solved._evaluate_block(arrays, solved._unknowns))

        solved._evaluator  # noqa: B018 - raises if nothing was solved
        return solved._within(max_memory, gathered, (self.size,), evaluate)

    def grid(self, *at: object, max_memory: str | float | None = None, **named: object) -> Array:
        """Evaluate all entries for every combination of values, one axis per coordinate.

        Returns
        -------
        ndarray (entries of all unknowns, times, values of parameter 1, ...)
        """
        return self.modes.fields(self.coefficients.grid(*at, max_memory=max_memory, **named))

    def gradient(
        self, *at: object, max_memory: str | float | None = None, **named: object
    ) -> Array:
        """Derivatives of all entries with respect to all parameters, at times and values.

        Returns
        -------
        ndarray (entries of all unknowns, parameters, *broadcast shape of the values)
        """
        slopes = self.coefficients.gradient(*at, max_memory=max_memory, **named)
        return self.modes.fields(slopes)

    def __getitem__(self, unknown: object) -> FieldView:
        """Return one unknown, by its symbol or its name."""
        k = self._position(unknown)
        modes, is_field = self.modes.modes[k], self.modes.unknowns[k].is_field
        return FieldView(
            self.coefficients,
            self.unknowns[k],
            np.arange(len(modes)) if is_field else np.zeros((), dtype=np.intp),
            modes if is_field else modes[0],
            self.modes.coefficients_of(k),
            self.modes.scales[k],
            self.errors[self.unknowns[k]],
        )

    def modes_of(self, unknown: object) -> Array:
        """The modes of an unknown, (entries, modes), orthonormal in the mean over the entries."""
        return self.modes.modes[self._position(unknown)]

    def _position(self, unknown: object) -> int:
        """Which unknown it is, or an EvaluationError."""
        name = name_of(unknown, self.metadata.time)
        if name not in self.unknowns:
            raise EvaluationError(
                f"no unknown {quote(name)}{did_you_mean(name, self.unknowns)}; "
                f"the solution holds {listing(self.unknowns, name)}",
                term=unknown,
            )
        k = self.unknowns.index(name)
        size, own = getattr(unknown, "size", None), len(self.modes.modes[k])
        if not isinstance(unknown, str) and size not in (None, own):
            raise EvaluationError(
                f"the field {quote(name)} has {count(own, 'entry', 'entries')} in this solution, "
                f"and {size} in the field that is asked for",
                term=unknown,
                remedy=f'use the field of the problem, or its name, "{name}"',
            )
        return k

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> NoReturn:
            raise missing_member(name, "solutions of fields", "solution[u]")

    def __iter__(self) -> NoReturn:
        raise TypeError("a FieldSolution is not iterable; its unknowns are in `.unknowns`")

    # --- how it was found ------------------------------------------------------------------------

    @property
    def success(self) -> bool:
        """Whether the errors were measured, and the largest is within the tolerance."""
        return self.status is Status.CONVERGED and self.error <= self.rtol

    @property
    def error(self) -> float:
        """Largest measured error of all fields; NaN if it was not measured.

        It is the largest over entries, times and check points, relative to the largest value of
        the field, not of each of its entries.
        """
        return max(self.modes.errors, default=float("nan"))

    @property
    def errors(self) -> dict[str, float]:
        """Measured error of each unknown by its name, relative to the largest value of it."""
        every = self.modes.errors or (float("nan"),) * len(self.unknowns)
        return dict(zip(self.unknowns, every, strict=True))

    @property
    def unknowns(self) -> tuple[str, ...]:
        """Names of the unknowns, in the order of the values."""
        return tuple(unknown.name for unknown in self.modes.unknowns)

    @property
    def size(self) -> int:
        """Number of all entries of all unknowns."""
        return sum(len(modes) for modes in self.modes.modes)

    @property
    def rtol(self) -> float:
        """Relative tolerance asked for."""
        return self.coefficients.rtol

    @property
    def method(self) -> str:
        """Name of the method that found it."""
        return self.coefficients.method

    @property
    def rank(self) -> int:
        """The largest rank of the coefficients."""
        return self.coefficients.rank

    @property
    def history(self) -> tuple[SlabRecord, ...]:
        """Every slab tried for the coefficients."""
        return self.coefficients.history

    @property
    def timings(self) -> dict[str, float]:
        """Seconds by stage."""
        return self.coefficients.timings

    @property
    def work(self) -> dict[str, float]:
        """Operations counted by stage."""
        return self.coefficients.work

    @property
    def nbytes(self) -> int:
        """Bytes of the coefficients and of the modes."""
        return self.coefficients.nbytes + sum(modes.nbytes for modes in self.modes.modes)

    @property
    def metadata(self) -> SolutionMetadata:
        """What was asked, of the coefficients."""
        return self.coefficients.metadata

    @property
    def parameters(self) -> dict[str, tuple[float, float]]:
        """The box: the interval of each parameter."""
        return self.coefficients.parameters

    @property
    def box(self) -> tuple[tuple[float, float], ...]:
        """The interval of each parameter, in their order."""
        return self.metadata.box

    @property
    def time(self) -> tuple[float, float]:
        """Start and end of what was solved."""
        return self.coefficients.time

    # --- events ---------------------------------------------------------------------------------

    @property
    def timeline(self) -> Timeline | BranchedTimeline:
        """The events that end the stretches of all trajectories; see :attr:`Solution.timeline`."""
        return self.coefficients.timeline

    def event_times(self, event: object, *at: object, **named: object) -> Array:
        """When an event occurs: ``solution.event_times("dose", k=2.0)``.

        Arguments, values and errors are those of :meth:`rankone.Solution.event_times`.
        """
        return self.coefficients.event_times(event, *at, **named)

    def end(self, *at: object, **named: object) -> Array:
        """When the solution ends: at a terminal event, or at the end of the horizon."""
        return self.coefficients.end(*at, **named)

    # --- display ---------------------------------------------------------------------------------

    def summary(self) -> str:
        """How it was found, in lines: what ``repr`` shows."""
        return field_summary_text(self.coefficients, self.modes, self._verdict)

    def __repr__(self) -> str:
        return self.summary()

    def _repr_html_(self) -> str:
        return field_summary_html(self.coefficients, self.modes, self._verdict)

    @property
    def _verdict(self) -> str:
        return f"{'yes' if self.success else 'no'}: {self.message}"
