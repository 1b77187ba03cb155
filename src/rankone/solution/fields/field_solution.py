"""What users hold after a reduced solve of fields."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, Literal, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from rankone.solution.fields.field_statistics import FieldSobol
from rankone.solution.fields.field_summary import field_summary_html, field_summary_text
from rankone.solution.fields.field_view import FieldView
from rankone.solution.solution import RECORDS, Solution, load, loaded
from rankone.solution.statistics.over_box import Times
from rankone.solution.storage import read_fields
from rankone.solution.storage.field_contents import FieldContent, write_fields
from rankone.solvers.outcome import SlabRecord, SolutionMetadata
from rankone.solvers.reduced.field_modes import FieldModes
from rankone.support.arrays import Array
from rankone.support.errors import (
    EvaluationError,
    OptionError,
    did_you_mean,
    listing,
    quote,
    shown,
)
from rankone.tensors.bases.coordinates import name_of
from rankone.tensors.bases.joint_distribution import Correlations, Under
from rankone.trajectories.system.verdict import Status


@dataclass(frozen=True, repr=False, eq=False)
class FieldSolution:
    """Fields as functions of time and of all parameters: modes times coefficients.

    - ``solution(t=1.0, k=2.0)`` has all entries of all unknowns, stacked;
    - ``solution[u](t=1.0, k=2.0)`` has those of one unknown, by its symbol or its name: the
      entries are the first axis, then comes the shape to which the values broadcast;
    - ``solution[u][3]`` and ``solution[u][[3, 17]]`` are some of its entries.

    Parameters
    ----------
    coefficients : Solution
        Of the coefficients of the modes. Its ``rtol`` is the tolerance of the fields.
    modes : FieldModes
        What makes fields of coefficients, and the errors of these, measured against full
        trajectories that no mode was made of.
    message : str
        How the solve ended, why, and what to do; by default what the status says.
    status : Status, optional
        How it ended; by default what the measured errors say.

    Raises
    ------
    OptionError
        If the coefficients are not those of the modes.
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
        return self.unknowns.index(name)

    def __iter__(self) -> NoReturn:
        raise TypeError("a FieldSolution is not iterable; its unknowns are in `.unknowns`")

    # --- statistics ------------------------------------------------------------------------------

    def mean(
        self, t: Times = None, *, under: Under = None, correlation: Correlations = None
    ) -> Array:
        """Means of all entries over the box, (entries of all unknowns, *shape of t).

        Arguments of this and all other statistics are those of a plain solution: see
        :meth:`rankone.Solution.mean`.
        """
        return self.modes.fields(self.coefficients.mean(t, under=under, correlation=correlation))

    def var(
        self, t: Times = None, *, under: Under = None, correlation: Correlations = None
    ) -> Array:
        """Variances of all entries over the box, (entries of all unknowns, *shape of t)."""
        views = self._views
        return np.concatenate([v.var(t, under=under, correlation=correlation) for v in views])

    def std(
        self, t: Times = None, *, under: Under = None, correlation: Correlations = None
    ) -> Array:
        """Standard deviations of all entries over the box."""
        return np.asarray(np.sqrt(self.var(t, under=under, correlation=correlation)))

    def sobol(
        self, t: Times = None, *, under: Under = None, correlation: Correlations = None
    ) -> dict[str, FieldSobol]:
        """First-order and total Sobol indices of all entries, for each unknown by its name."""
        return {
            name: self[name].sobol(t, under=under, correlation=correlation)
            for name in self.unknowns
        }

    def quantile(
        self,
        q: ArrayLike,
        t: Times = None,
        *,
        under: Under = None,
        correlation: Correlations = None,
        count: int = 2**13,
    ) -> Array:
        """Quantiles of all entries, (*shape of q, entries of all unknowns, *shape of t).

        ``solution[u].quantile(...)`` has half-widths besides.
        """
        blocks = [
            np.asarray(view.quantile(q, t, under=under, correlation=correlation, count=count))
            for view in self._views
        ]
        return np.concatenate(blocks, axis=np.ndim(q))

    def sample(
        self,
        count: int,
        *,
        seed: int | None = None,
        under: Under = None,
        correlation: Correlations = None,
    ) -> dict[str, Array]:
        """Random values of the parameters, by name: ``solution(t=1.0, **solution.sample(100))``."""
        return self.coefficients.sample(count, seed=seed, under=under, correlation=correlation)

    @property
    def _views(self) -> list[FieldView]:
        """All unknowns with an axis of entries, also those that are scalars."""
        return [self[name] if self[name].shape else self[name].reshape(1) for name in self.unknowns]

    # --- smaller solutions and derivatives -------------------------------------------------------

    def fix(self, values: Mapping[Any, Any] | None = None, /, **named: object) -> FieldSolution:
        """The fields for given values of some parameters; see :meth:`rankone.Solution.fix`."""
        return replace(self, coefficients=self.coefficients.fix(values, **named))

    def restrict(
        self, intervals: Mapping[Any, Any] | None = None, /, **named: object
    ) -> FieldSolution:
        """The fields on smaller intervals; see :meth:`rankone.Solution.restrict`."""
        return replace(self, coefficients=self.coefficients.restrict(intervals, **named))

    def at(self, t: float) -> FieldSolution:
        """The fields at one time, as functions of the parameters alone."""
        return replace(self, coefficients=self.coefficients.at(t))

    def diff(self, coordinate: object) -> FieldSolution:
        """The derivatives of the fields with respect to a parameter or to time.

        Their errors are not measured, so that ``success`` is False.
        """
        derivative = self.coefficients.diff(coordinate)
        return FieldSolution(
            derivative, replace(self.modes, errors=()), derivative.message, derivative.status
        )

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

    # --- files -----------------------------------------------------------------------------------

    def save(
        self,
        path: str | PathLike[str],
        *,
        overwrite: bool = False,
        modes: Literal["float64", "float32"] = "float64",
    ) -> Path:
        """Write coefficients and modes to an ``.npz`` file, without pickle; ``load`` reads it.

        Parameters
        ----------
        path : path-like
            Ends in ``.npz``.
        overwrite : bool
            Whether to replace an existing file.
        modes : {"float64", "float32"}
            Numbers of the modes. Single precision takes half the space; what it changes the fields
            by at most, some 1e-7 of their largest value, adds to the saved errors.

        Raises
        ------
        StorageError
            If the name has another suffix, the file exists and must not be replaced, or it cannot
            be written. The file is complete or absent, even after an interrupt.
        OptionError
            If the modes are to be other numbers.
        """
        if modes not in ("float64", "float32"):
            raise OptionError(
                f"modes={shown(modes)} is neither", term=modes, remedy='give "float64" or "float32"'
            )
        saved = self if modes == "float64" else self._in_single_precision()
        solved = saved.coefficients
        content = FieldContent(
            solved.outcome, solved.metadata, saved.modes, saved.status, saved.message
        )
        return write_fields(path, content, modes, overwrite)

    def _in_single_precision(self) -> FieldSolution:
        """The fields with rounded modes, whose errors are that much larger.

        No coefficient is larger than the field, since modes are orthonormal in the mean.
        """
        rounded = tuple(own.astype(np.float32).astype(np.float64) for own in self.modes.modes)
        pairs = zip(rounded, self.modes.modes, strict=True)
        moved = [float(np.abs(a - b).sum(axis=1).max()) for a, b in pairs]
        errors = tuple(map(float, np.add(self.modes.errors, moved))) if self.modes.errors else ()
        modes = replace(self.modes, modes=rounded, errors=errors)
        within = max(errors, default=0.0) <= self.rtol
        if self.status is not Status.CONVERGED or within:
            return replace(self, modes=modes)
        return FieldSolution(self.coefficients, modes)

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


def load_saved(path: str | PathLike[str]) -> Solution | FieldSolution:
    """Read what :meth:`Solution.save` or :meth:`FieldSolution.save` wrote.

    Nothing in the file is executed.

    Returns
    -------
    Solution or FieldSolution
        Evaluates to exactly the same values as what was saved; fields whose modes were saved in
        single precision, to these.

    Raises
    ------
    StorageError
        If there is no such file, it is not a rankone solution, it is damaged, a newer version of
        rankone wrote it, or a package that it needs is not installed.
    """
    content = read_fields(path, RECORDS)
    if content is None:
        return load(path)
    coefficients = loaded(path, content.outcome, content.metadata)
    return FieldSolution(coefficients, content.modes, content.message, content.status)
