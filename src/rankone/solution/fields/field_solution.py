"""What users hold after a reduced solve of fields."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from rankone.solution.evaluation.domains import merged
from rankone.solution.fields.field_core import FieldCore
from rankone.solution.fields.field_presentation import field_dataset
from rankone.solution.fields.field_quantities import (
    compared_with_solve,
    functional_solution,
    largest_values,
    linear_outputs,
)
from rankone.solution.fields.field_statistics import SobolByUnknown
from rankone.solution.fields.field_view import FieldView
from rankone.solution.outputs.interpolation import DEFAULT_MARGIN
from rankone.solution.solution import Solution, load, loaded
from rankone.solution.statistics.over_box import Times
from rankone.solution.storage import read_fields
from rankone.solution.storage.field_contents import FieldContent, write_fields
from rankone.solvers.reduced.functionals import Functional
from rankone.solvers.selection import RECORDS
from rankone.support.arrays import Array
from rankone.support.errors import (
    ExportError,
    OptionError,
    StorageError,
    listing,
    optional_module,
    quote,
    shown,
)
from rankone.support.files import free_target, write_files
from rankone.support.options import OUTPUT_RTOLS, RTOLS, checked_number
from rankone.tensors.joint_distribution import Correlations, Under
from rankone.trajectories.fields.field_system import Unknown
from rankone.trajectories.system.verdict import Status

if TYPE_CHECKING:
    import xarray as xr

    from rankone.inference.estimation.design import Design
    from rankone.inference.estimation.fit import Fit
    from rankone.inference.estimation.minimize import Optimum
    from rankone.inference.estimation.posterior import Posterior


Observed = Mapping[str, Any] | None
"""Outputs by names, as for :meth:`FieldSolution.output`."""


class PageOptions(TypedDict, total=False):
    """What pages of all solutions take."""

    title: str | None
    rtol: float | None
    overwrite: bool
    allow_failed: bool


@dataclass(frozen=True, repr=False, eq=False)
class FieldSolution(FieldCore):
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
    ) -> SobolByUnknown:
        """First-order and total Sobol indices of all entries, by unknowns or their names."""
        return SobolByUnknown(
            (name, self[name].sobol(t, under=under, correlation=correlation))
            for name in self.unknowns
        )

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

    # --- outputs and applications ----------------------------------------------------------------

    def output(
        self, quantities: Mapping[str, Any], *, rtol: float | None = None, **options: Any
    ) -> Solution:
        """Quantities of interest as a plain solution: with densities, fits, exports and pages.

        Parameters
        ----------
        quantities : mapping of str to view or Expr
            For each name a single entry, ``solution[u][3]``, or an expression of scalar unknowns,
            parameters, time and of functionals: ``rankone.apply(row, u)`` with a matrix of one row,
            and ``rankone.apply(row, u**2)`` or other products of two fields. A row of at most 32
            entries that are not zero takes any function, ``rankone.apply(row, exp(u))``. Integrals
            over time, maxima and the like are as in :meth:`rankone.Solution.output`.
        rtol : float, optional
            Tolerance, relative to the largest value of each quantity. By default 1.5 times what
            errors of the fields' tolerance could bring, at least 1.5 times that tolerance and at
            most 0.1. Where entries cancel, this is far more than what the solve asked for: an
            average of a hundredth of the field may be wrong by a hundred times its tolerance. The
            message then begins with the error and the tolerance of the solve, also where
            ``success`` says that the error is within the tolerance of the output. Give ``rtol``
            to have ``success`` judged by it.
        **options
            As for :meth:`rankone.Solution.output`.

        Returns
        -------
        Solution
            Sums of functionals alone are exact sums of the coefficients: nothing is interpolated.
            The error of an output is what the measured errors of the fields change it by at most,
            such as the error of a field times the sum of the absolute weights of its entries, plus
            that of the interpolation, relative to the largest value of the output.

        Raises
        ------
        OptionError
            If an expression has a whole field, a field that the solution does not hold, a
            derivative of one, or a function of many entries that is no polynomial of second degree;
            and as for :meth:`rankone.Solution.output`.
        """
        self.coefficients._evaluator  # noqa: B018 - raises if nothing was solved
        if not isinstance(quantities, Mapping) or not quantities:
            raise OptionError(
                f"{shown(quantities)} is not a mapping from names to quantities",
                term=quantities,
                remedy='give for example {"tip": solution[u][3]}',
            )
        lowering = optional_module(
            "rankone.compiler.field_outputs",
            "outputs are given as expressions of SymPy",
            "pip install sympy",
        )
        entry_of = lowering.entry_of
        terms = {name: self._written(name, each, entry_of) for name, each in quantities.items()}
        asked = lowering.field_outputs(terms, self.modes, self.metadata)
        if asked.linear is not None and not options:
            tolerance = self._output_tolerance(rtol, [*asked.linear.values()])
            linear = asked.linear, asked.texts, tolerance, self.status
            outputs = linear_outputs(self.coefficients, *linear)
            return compared_with_solve(outputs, self.rtol) if rtol is None else outputs
        if not asked.states:
            raise OptionError(
                f"the outputs {listing(quantities)} name neither a field nor a scalar unknown",
                term=quantities,
                remedy='give for example {"tip": solution[u][3]}',
            )
        states = functional_solution(self.coefficients, asked.states, self.status)
        solution = states.output(asked.outputs, rtol=rtol, **options)
        own = zip(solution.unknowns, solution.metadata.equations, strict=True)
        equations = tuple(asked.texts.get(name, equation) for name, equation in own)
        outputs = Solution(solution.outcome, replace(solution.metadata, equations=equations))
        return compared_with_solve(outputs, self.rtol) if rtol is None else outputs

    def _written(
        self, name: str, term: object, entry_of: Callable[[Unknown, int, str], object]
    ) -> object:
        """A quantity as an expression where it is a view."""
        if not isinstance(term, FieldView):
            return term
        if term.size != 1:
            raise OptionError(
                f"the output {quote(name)} is {term.size} entries of `{term.name}`, and an output "
                "is one number",
                term=name,
                remedy="give entries one by one: solution[u][3]",
            )
        unknown = self.modes.unknowns[self._position(term.name)]
        return entry_of(unknown, int(term.positions.ravel()[0]), self.metadata.time)

    def _output_tolerance(self, rtol: float | None, functionals: list[Functional]) -> float:
        """The tolerance of sums of functionals."""
        if rtol is not None:
            return float(checked_number("rtol", rtol, *OUTPUT_RTOLS, float))
        sizes = largest_values(self.coefficients, functionals)
        pairs = zip(functionals, sizes, strict=True)
        effect = self.rtol * max((each.size / size for each, size in pairs if size), default=1.0)
        default = DEFAULT_MARGIN * max(self.rtol, effect)
        return float(min(default, max(max(RTOLS), self.rtol)))

    def fit(
        self, times: object, data: Any = None, *, observe: Observed = None, **options: Any
    ) -> Fit:
        """Parameters from data of sensors: ``observe={"s1": solution[u][3]}``.

        Parameters
        ----------
        times, data, **options
            As for :meth:`rankone.Solution.fit`; data by the names of the sensors.
        observe : mapping
            What the sensors measure, as for :meth:`output`.
        """
        sensors = self._sensors("fit", observe)
        return sensors.fit(times, data, observe=[*sensors.unknowns], **options)

    def posterior(
        self, times: object, data: Any = None, *, observe: Observed = None, **options: Any
    ) -> Posterior:
        """The distribution of the parameters given data of sensors; see :meth:`fit`."""
        sensors = self._sensors("posterior", observe)
        return sensors.posterior(times, data, observe=[*sensors.unknowns], **options)

    def minimize(
        self, objective: object, t: Any = None, *, observe: Observed = None, **options: Any
    ) -> Optimum:
        """The parameters for which a quantity is least: an expression of those in ``observe``.

        Other arguments are those of :meth:`rankone.Solution.minimize`.
        """
        return self._sensors("minimize", observe).minimize(objective, t, **options)

    def design(
        self, times: int, candidates: Any = None, *, observe: Observed = None, **options: Any
    ) -> Design:
        """When to read sensors, to learn the most; see :meth:`rankone.Solution.design`."""
        sensors = self._sensors("design", observe)
        return sensors.design(times, candidates, observe=[*sensors.unknowns], **options)

    def _sensors(self, use: str, observe: Observed) -> Solution:
        """The outputs that a use of a solution reads."""
        if observe is None:
            name = self.unknowns[0]
            raise OptionError(
                f"{use} of fields does not say what is read",
                term=use,
                remedy='give observe={"a": solution["' + name + '"][3], ...}, entries or '
                "expressions such as rankone.apply(row, u)",
            )
        return self.output(observe)

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

    # --- other forms -----------------------------------------------------------------------------

    def to_xarray(
        self,
        values: Mapping[Any, Any] | None = None,
        /,
        *,
        coordinates: Mapping[str, ArrayLike | tuple[str, ArrayLike]] | None = None,
        **named: object,
    ) -> xr.Dataset:
        """All unknowns on the grid of all combinations of values, with labels.

        Parameters
        ----------
        values, **named
            As for :meth:`rankone.Solution.to_xarray`.
        coordinates : mapping, optional
            Names and values along each axis of the grid that the entries are on, the last axis
            running first: ``{"x": x, "y": y}`` where entry ``i*len(y) + j`` is at ``x[i], y[j]``.
            On another mesh arrays with a number for each entry, ``{"x": x_of_entries}``, or the
            same as ``{"x": ("entry", x_of_entries)}``.

        Returns
        -------
        xarray.Dataset
            A variable for each unknown with its error and scale as attributes. Its dimensions are
            those of the grid, or ``entry``, or ``u_entry`` if fields differ in size; then time and
            the parameters that are no numbers.

        Raises
        ------
        OptionError
            If no field has as many entries as the grid has points, or a name is taken.
        RankoneError
            If xarray is not installed.
        EvaluationError
            As for a call.
        """
        verdict = {"success": int(self.success), "comment": self.message}
        at, grid = merged(values, named), coordinates or {}
        return field_dataset(self.coefficients, self.modes, at, grid, verdict)

    def export(
        self,
        path: str | PathLike[str],
        *,
        rtol: float | None = None,
        overwrite: bool = False,
        allow_failed: bool = False,
    ) -> Path:
        """Write a model of the coefficients, and their modes: in Python, C99 or JavaScript.

        ``model.c`` is the model as :meth:`rankone.Solution.export` writes it, of the coefficients;
        ``model_fields.c`` has the modes and a function that makes all entries of them:
        ``model_fields(coefficients, entries)``, in the other languages ``fields(coefficients)``.
        Few entries and functionals are smaller and faster as outputs:
        ``solution.output({...}).export("model.c")``. ``.html`` writes a page, as :meth:`explore`.

        Parameters
        ----------
        path : path-like
            Ends in ``.py``, ``.c``, ``.js``, ``.mjs`` or ``.html``.
        rtol : float, optional
            By how much the model of the coefficients may differ from these.
        overwrite : bool
            Whether to replace existing files.
        allow_failed : bool
            Whether fields may be exported that are not a success.

        Returns
        -------
        Path
            The model of the coefficients.

        Raises
        ------
        ExportError
            If the fields are not a success, or the path has another suffix, exists or cannot be
            written.
        """
        if Path(path).suffix == ".html":
            return self.explore(path, rtol=rtol, overwrite=overwrite, allow_failed=allow_failed)
        from rankone.share.export.field_model import field_files

        if not (self.success or allow_failed):
            raise ExportError(
                f"the fields are not a success: {self.message}",
                remedy="solve them to the tolerance, or give allow_failed=True",
            )
        norm = "measured at all entries, relative to the largest value of each field"
        remarks = (
            f"Generated by rankone {self.metadata.version}.",
            f"Errors, {norm}: "
            + ", ".join(f"{name} {error:.2g}" for name, error in self.errors.items())
            + ".",
        )
        files = field_files(path, self.modes, remarks)
        for place in files:
            free_target(place, overwrite, ExportError)
        model = self.coefficients.export(path, rtol=rtol, overwrite=overwrite, allow_failed=True)
        write_files(files, overwrite, ExportError)
        return model

    def explore(
        self,
        path: str | PathLike[str],
        *,
        coordinates: Mapping[str, ArrayLike | tuple[str, ArrayLike]] | None = None,
        places: ArrayLike | None = None,
        triangles: ArrayLike | None = None,
        displacement: Sequence[Any] | None = None,
        **options: Unpack[PageOptions],
    ) -> Path:
        """Write a page with a slider for each parameter, and pictures of the fields that follow.

        It is one HTML file that works offline. Fields whose entries are as many as points of the
        layout are drawn there, others as curves over the index of their entries; ordinary unknowns
        are curves over time.

        Parameters
        ----------
        path : path-like
            Ends in ``.html``.
        coordinates : mapping, optional
            Names and values along the axes of a line or a plane, as for :meth:`to_xarray`:
            ``{"x": x}`` or ``{"x": x, "y": y}``; with a number for each entry, places of a mesh.
        places : array_like (entries, 2), optional
            The places of the entries of a mesh in the plane, drawn as points.
        triangles : array_like of int (triangles, 3), optional
            Indices of the places at the corners of each triangle: a field is linear in between.
        displacement : sequence of two unknowns or views, optional
            How far the places move along x and y: ``(ux, uy)``, or for a field that has both in
            turn ``(solution[u][0::2], solution[u][1::2])``. Its length is a picture of its own.
        **options
            ``title``, ``rtol``, ``overwrite`` and ``allow_failed`` as for
            :meth:`rankone.Solution.explore`; ``rtol`` is about the coefficients of the modes.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        OptionError
            If the layout is none, or does not fit the fields; and as for the other page.
        ExportError
            As for the page of a solution.
        """
        from rankone.share.export.field_layout import displacement_views, layout_of
        from rankone.share.export.field_page import export_field_page

        moves = displacement_views(displacement, self)
        layout = layout_of(self.modes, coordinates, places, triangles, moves)
        return export_field_page(self, path, layout, **options)

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
            If nothing was solved, the name has another suffix, the file exists and must not be
            replaced, or it cannot be written. The file is complete or absent, even after an
            interrupt.
        OptionError
            If the modes are to be other numbers.
        """
        if modes not in ("float64", "float32"):
            raise OptionError(
                f"modes={shown(modes)} is neither", term=modes, remedy='give "float64" or "float32"'
            )
        if not self.coefficients.outcome.is_solved:
            raise StorageError(
                f"nothing was solved, so there is nothing to save: {self.message}", term=path
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
