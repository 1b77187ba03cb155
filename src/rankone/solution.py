"""Solution: what users hold after a solve, for every parameter value and time at once."""

from __future__ import annotations

import html
import textwrap
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rankone.arrays import Array
from rankone.errors import EvaluationError
from rankone.evaluation import Coordinates, name_of
from rankone.solvers.outcome import Outcome, SlabRecord, Status
from rankone.tensors.evaluator import TrainEvaluator
from rankone.wording import did_you_mean, listing

if TYPE_CHECKING:
    from rankone.tensors.canonical import CanonicalForms

__all__ = ["Solution", "SolutionMetadata", "UnknownView"]

_WIDTH = 96
_MOST_NAMES = 8


@dataclass(frozen=True, slots=True)
class SolutionMetadata:
    """What was asked, in plain data: a solution needs neither SymPy nor the problem.

    Attributes
    ----------
    unknowns : tuple of str
        Names of the unknowns.
    states : tuple of str
        The unknowns, then the derivatives that became states (``x_t``, ``x_tt``, ...), in the
        order of the slabs' states.
    parameters : tuple of str
        Names of the parameters, in the order of the slabs' cores.
    box : tuple of (float, float)
        The interval of each parameter.
    time : str
        Name of time.
    horizon : tuple of float
        Start and end asked for; a partial solution ends earlier.
    rtol : float
        Relative tolerance asked for.
    method : str
        Name of the engine.
    equations : tuple of str
        The problem as text, one line for each equation and initial value.
    version : str
        Version of rankone that solved it.
    source : str or None
        Text of the generated module.
    """

    unknowns: tuple[str, ...]
    states: tuple[str, ...]
    parameters: tuple[str, ...]
    box: tuple[tuple[float, float], ...]
    time: str
    horizon: tuple[float, float]
    rtol: float
    method: str = "train"
    equations: tuple[str, ...] = ()
    version: str = ""
    source: str | None = None


class Solution:
    """The unknowns as functions of time and of all parameters.

    Call it with times and parameter values, or index it to get one unknown:

    - ``solution(t=1.0, x0=9.0, y0=5.0)`` has the shape (unknowns,);
    - ``solution(times, {x0: 9, y0: [4.5, 5.5]})`` broadcasts as NumPy does and has the shape
      (unknowns, *broadcast shape); keys are symbols or names;
    - ``solution[x](t=times, x0=9, y0=5)`` has the broadcast shape alone;
    - ``solution.grid(t=times, x0=..., y0=...)`` evaluates every combination.

    Values outside of the box or of the horizon are errors; nothing is extrapolated.

    Parameters
    ----------
    outcome : Outcome
        What the engine returned.
    metadata : SolutionMetadata
        What was asked.

    Attributes
    ----------
    outcome, metadata
        As given.
    """

    def __init__(self, outcome: Outcome, metadata: SolutionMetadata) -> None:
        self.outcome = outcome
        self.metadata = metadata
        self._rows = {name: row for row, name in enumerate(metadata.states)}
        self._unknowns = slice(0, len(metadata.unknowns))
        self._coordinates = Coordinates(
            (metadata.time, *metadata.parameters), (self.time, *metadata.box)
        )

    # --- evaluation ----------------------------------------------------------------------------

    def __call__(self, time: Any = None, values: Any = None, /, **named: Any) -> Array:
        """Evaluate all unknowns.

        Parameters
        ----------
        time : array_like, optional
            Times, or a mapping which holds them as well; they can also be given by name.
        values : mapping, optional
            From symbols or names to values.
        **named
            Values by name.

        Returns
        -------
        ndarray (unknowns, *broadcast shape of the values)

        Raises
        ------
        EvaluationError
            If a coordinate is missing, unknown, given twice, not a real number, or outside of
            the box or the horizon.
        """
        return self._evaluate(self._coordinates.gather(time, values, named), self._unknowns)

    def grid(self, time: Any = None, values: Any = None, /, **named: Any) -> Array:
        """Evaluate all unknowns for every combination of values, one axis per coordinate.

        Arguments and errors are those of a call; each value is a number or one-dimensional.

        Returns
        -------
        ndarray (unknowns, times, values of parameter 1, values of parameter 2, ...)
        """
        axes = self._coordinates.axes(self._coordinates.gather(time, values, named))
        return self._evaluator.grid(axes, self._unknowns)

    def __getitem__(self, unknown: Any) -> UnknownView:
        """Return one unknown, or one derivative that is a state: ``solution[x.diff(t)]``."""
        name = name_of(unknown, self.metadata.time)
        if name not in self._rows:
            raise EvaluationError(
                f"no unknown `{name}`{did_you_mean(name, self.metadata.states)}; "
                f"the solution holds {listing(self.metadata.states)}",
                term=unknown,
            )
        return UnknownView(self, name)

    def __iter__(self) -> Any:
        raise TypeError("a Solution is not iterable; its unknowns are in `.unknowns`")

    def _evaluate(self, given: list[Any], rows: slice) -> Array:
        evaluator = self._evaluator
        numbers = self._coordinates.numbers(given)
        if numbers is not None:
            return evaluator.one(numbers, rows)
        points, shape = self._coordinates.broadcast(self._coordinates.arrays(given))
        if shape == ():
            return evaluator.one(points[:, 0].tolist(), rows)
        return evaluator.many(points, rows).reshape(rows.stop - rows.start, *shape)

    @cached_property
    def _evaluator(self) -> TrainEvaluator:
        if not self.outcome.slabs:
            raise EvaluationError(f"nothing was solved: {self.message}")
        return TrainEvaluator(self.outcome.slabs)

    # --- what was asked and what came out ------------------------------------------------------

    @property
    def success(self) -> bool:
        """Whether the measured error is within the tolerance asked; False if it is not known."""
        return self.outcome.status is Status.CONVERGED

    @property
    def status(self) -> Status:
        """How the solve ended."""
        return self.outcome.status

    @property
    def message(self) -> str:
        """How the solve ended, why, and what to do."""
        return self.outcome.message

    @property
    def error(self) -> float:
        """Largest measured error over all states, relative to each one's size; NaN if unchecked.

        Derivatives that became states count as well.
        """
        return self._worst("interior")

    @property
    def errors(self) -> dict[str, float]:
        """Measured error of each state, unknowns first; NaN if unchecked."""
        measured = self.outcome.measured
        if measured is None:
            return dict.fromkeys(self.metadata.states, float("nan"))
        return dict(zip(self.metadata.states, measured.interior, strict=True))

    @property
    def corner_error(self) -> float:
        """Largest measured error at corners of the box; NaN if there are none or unchecked."""
        return self._worst("corners")

    def _worst(self, where: str) -> float:
        measured = self.outcome.measured
        values = () if measured is None else getattr(measured, where)
        return float(np.max(values)) if len(values) else float("nan")

    @property
    def rtol(self) -> float:
        """Relative tolerance asked for."""
        return self.metadata.rtol

    @property
    def unknowns(self) -> tuple[str, ...]:
        """Names of the unknowns, in the order of the values."""
        return self.metadata.unknowns

    @property
    def parameters(self) -> dict[str, tuple[float, float]]:
        """The box: the interval of each parameter."""
        return dict(zip(self.metadata.parameters, self.metadata.box, strict=True))

    @property
    def time(self) -> tuple[float, float]:
        """Start and end of what was solved."""
        start, end = self.metadata.horizon
        if not self.outcome.slabs:
            return start, start
        reached = self.outcome.slabs[-1].end
        return start, end if abs(end - reached) <= 1e-10 * (end - start) else reached

    @property
    def ranks(self) -> tuple[tuple[int, ...], ...]:
        """For each slab the ranks of its train: time | parameter 1 | parameter 2 | ..."""
        return tuple(slab.ranks for slab in self.outcome.slabs)

    @property
    def rank(self) -> int:
        """The largest rank; 1 without parameters, 0 if nothing was solved."""
        return max((max(ranks, default=1) for ranks in self.ranks), default=0)

    @property
    def nodes(self) -> tuple[int, ...]:
        """For each parameter the largest number of nodes over the slabs."""
        sizes = [[basis.size for basis in slab.bases] for slab in self.outcome.slabs]
        return tuple(max(column) for column in zip(*sizes, strict=True))

    @property
    def history(self) -> tuple[SlabRecord, ...]:
        """Every slab tried, accepted or not, over all attempts."""
        return self.outcome.history

    @property
    def timings(self) -> dict[str, float]:
        """Seconds by stage."""
        return dict(self.outcome.timings)

    @property
    def nbytes(self) -> int:
        """Bytes of the tensor trains."""
        return sum(core.nbytes for slab in self.outcome.slabs for core in slab.cores)

    # --- other forms ---------------------------------------------------------------------------

    def to_canonical(self, rtol: float = 1e-6, *, max_rank: int = 500) -> CanonicalForms:
        """Write each unknown as a sum of products of functions of one coordinate.

        ``u(t, p_1, ..., p_d) = sum_i amplitudes[i] T_i(t) P_i^1(p_1) ... P_i^d(p_d)`` over the
        whole horizon, with factors of unit mean square. In one parameter this is the singular
        value decomposition: the modes are orthonormal, the amplitudes its singular values.

        Parameters
        ----------
        rtol : float
            Largest error of each unknown in the mean square over box and horizon, relative to
            its own mean square.
        max_rank : int
            Most terms for each unknown.

        Returns
        -------
        CanonicalForms
            A mapping from unknowns to :class:`~rankone.tensors.canonical.CanonicalForm`.

        Raises
        ------
        OptionError
            If an option is out of its range.

        Warns
        -----
        RankoneWarning
            If ``max_rank`` terms do not suffice; the form says the error reached.
        """
        from rankone.tensors.canonical import CanonicalForms, canonical_form

        self._evaluator  # noqa: B018 - raises if nothing was solved
        names = (self.metadata.time, *self.metadata.parameters)
        forms = {}
        for row, name in enumerate(self.unknowns):
            forms[name] = canonical_form(
                self.outcome.slabs, row, names, rtol=rtol, max_rank=max_rank, label=name
            )
        return CanonicalForms(forms)

    @cached_property
    def modes(self) -> CanonicalForms:
        """The canonical form of each unknown to 1e-3, for plots; see :meth:`to_canonical`."""
        return self.to_canonical(1e-3)

    def save(self, path: str | PathLike[str], *, overwrite: bool = False) -> Path:
        """Write the solution to a file in the open format of :mod:`rankone.storage`.

        Parameters
        ----------
        path : path-like
            Used as given; the usual suffix is ``.npz``.
        overwrite : bool
            Whether to replace an existing file.

        Returns
        -------
        Path

        Raises
        ------
        StorageError
            If the file exists and is not to be replaced, or cannot be written. A file is either
            complete or not there, also after an interrupt.
        """
        from rankone.storage import save

        return save(self, path, overwrite=overwrite)

    def export(
        self, path: str | PathLike[str], *, overwrite: bool = False, allow_failed: bool = False
    ) -> Path:
        """Write a solved model in Python or C99; see :func:`rankone.export.export_model`."""
        from rankone.export import export_model

        return export_model(self, path, overwrite=overwrite, allow_failed=allow_failed)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.outcome, self.metadata)

    # --- display -------------------------------------------------------------------------------

    def _summary(self) -> list[tuple[str, str]]:
        """Headings and texts of the summary."""
        measured = self.outcome.measured
        asked = f"tolerance {self.rtol:.3g}"
        if measured is None:
            error = f"not measured, {asked}"
        else:
            error = f"{self.error:.2g} measured on {measured.points} trajectories, {asked}"
            if len(self.errors) > 1:
                error += "; " + _some(
                    [f"{name} {value:.2g}" for name, value in self.errors.items()]
                )
        start, end = self.time
        lower, upper = self.metadata.horizon
        partial = "" if end == upper else f" of [{lower:g}, {upper:g}]"
        box = [f"{name} in [{lo:g}, {hi:g}]" for name, (lo, hi) in self.parameters.items()]
        count = len(self.outcome.slabs)
        train = [f"{count} slab" + ("" if count == 1 else "s"), f"rank {self.rank}"]
        if self.nodes:
            largest = (max(column) for column in zip(*self.ranks, strict=True))
            train.append(f"ranks up to ({_some(map(str, largest))})")
            train.append(f"nodes up to ({_some(map(str, self.nodes))})")
        train.append(f"{self.nbytes / 1e6:.2g} MB")
        timings = [f"{stage} {seconds:.3g} s" for stage, seconds in self.timings.items()]
        return [
            ("unknowns", _some(self.unknowns)),
            ("over", _some([f"{self.metadata.time} in [{start:g}, {end:g}]{partial}", *box])),
            ("success", f"{'yes' if self.success else 'no'}: {self.message}"),
            ("error", error),
            (self.metadata.method, ", ".join(train)),
            ("timings", ", ".join(timings) or "none"),
        ]

    def __repr__(self) -> str:
        lines = [f"Solution (rankone {self.metadata.version})".replace(" (rankone )", "")]
        for heading, text in self._summary():
            lines += textwrap.wrap(
                text,
                _WIDTH,
                initial_indent=f"  {heading:<10}",
                subsequent_indent=" " * 12,
                break_long_words=False,
            )
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><th style='text-align:left'>{html.escape(heading)}</th>"
            f"<td style='text-align:left'>{html.escape(text)}</td></tr>"
            for heading, text in self._summary()
        )
        return f"<table><caption>Solution</caption><tbody>{rows}</tbody></table>"


@dataclass(frozen=True, repr=False)
class UnknownView:
    """One unknown of a solution, as a function of time and the parameters.

    Attributes
    ----------
    solution : Solution
    name : str
        Name of the unknown, or of a derivative that is a state.
    """

    solution: Solution
    name: str

    @property
    def _row(self) -> slice:
        row = self.solution._rows[self.name]
        return slice(row, row + 1)

    def __call__(self, time: Any = None, values: Any = None, /, **named: Any) -> Any:
        """Evaluate: arguments and errors as for a solution, shape of the result as broadcast."""
        given = self.solution._coordinates.gather(time, values, named)
        return self.solution._evaluate(given, self._row)[0]

    def grid(self, time: Any = None, values: Any = None, /, **named: Any) -> Array:
        """Evaluate for every combination of values: shape (times, values of parameter 1, ...)."""
        coordinates = self.solution._coordinates
        axes = coordinates.axes(coordinates.gather(time, values, named))
        values_: Array = self.solution._evaluator.grid(axes, self._row)[0]
        return values_

    @property
    def error(self) -> float:
        """Measured error, relative to the unknown's size; NaN if unchecked."""
        return self.solution.errors[self.name]

    def __repr__(self) -> str:
        coordinates = ", ".join(self.solution._coordinates.names)
        return f"{self.name}({coordinates}) of a Solution, measured error {self.error:.2g}"


def _some(texts: Iterable[str]) -> str:
    """Join texts, leaving out the middle of many."""
    shown = list(texts)
    if len(shown) > _MOST_NAMES:
        hidden = len(shown) - _MOST_NAMES + 1
        shown[_MOST_NAMES - 2 : -1] = [f"... ({hidden} more)"]
    return ", ".join(shown)
