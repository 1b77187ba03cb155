"""A solution in other forms: canonical sums, tables, figures, pages, and exported models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

from rankone.solution.evaluation.presentation import dataset
from rankone.solution.evaluation.smaller import merged, state_rows, with_states
from rankone.solution.statistics.densities import DistributionOverBox
from rankone.support.errors import OptionError, optional_module
from rankone.support.wording import shown
from rankone.tensors.trains.canonical import CanonicalForms, canonical_form

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


class OtherForms(DistributionOverBox):
    """What a solution can be written as."""

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
            A mapping from unknowns to :class:`~rankone.tensors.trains.canonical.CanonicalForm`.
            The form of a derivative that is a state is computed when it is asked for:
            ``forms[x.diff(t)]`` or ``forms["x_t"]``.

        Raises
        ------
        OptionError
            If an option is out of its range.

        Warns
        -----
        RankoneWarning
            If ``max_rank`` terms do not suffice; the form says the error reached.
        """
        self._evaluator  # noqa: B018 - raises if nothing was solved
        names = (self.metadata.time, *self.metadata.parameters)
        slabs = self.outcome.slabs_over_clock_time("to_canonical")
        form = partial(canonical_form, slabs, names, rtol=rtol, max_rank=max_rank)
        return CanonicalForms(form, self.states, self.unknowns, self.metadata.hint)

    @cached_property
    def modes(self) -> CanonicalForms:
        """The canonical form of each unknown to 1e-3, for plots; see :meth:`to_canonical`."""
        return self.to_canonical(1e-3)

    def to_xarray(self, values: Mapping[Any, Any] | None = None, /, **named: object) -> xr.Dataset:
        """The unknowns on the grid of all combinations of values, with labels.

        Parameters
        ----------
        values, **named
            For time and each parameter, by symbols or names, a number or one-dimensional values.
            Without times there are 101 over the horizon, if the solution depends on time.

        Returns
        -------
        xarray.Dataset
            A variable for each unknown with its measured error as an attribute, a dimension for
            each coordinate that is not a number.

        Raises
        ------
        RankoneError
            If xarray is not installed.
        EvaluationError
            As for a call.
        """
        return dataset(self, merged(values, named))

    def to_dataframe(
        self, values: Mapping[Any, Any] | None = None, /, **named: Any
    ) -> pd.DataFrame:
        """The same as :meth:`to_xarray` as a table, a row for each point of the grid."""
        data = self.to_xarray(values, **named)
        names = self.metadata.coordinates
        return (data if data.sizes or not names else data.expand_dims(names[0])).to_dataframe()

    def export(
        self,
        path: str | PathLike[str],
        *,
        states: Literal["unknowns", "all"] | Sequence[str] = "unknowns",
        rtol: float | None = None,
        overwrite: bool = False,
        allow_failed: bool = False,
        fmi: Literal["2.0", "3.0"] | None = None,
    ) -> Path:
        """Write a model for evaluation only: in Python, C99 or JavaScript, an FMU, or a page.

        Parameters
        ----------
        path : path-like
            ``.py`` writes a Python module that needs only NumPy, with an ``.npz`` beside it if
            there are many coefficients; ``.c`` writes C99 source and its header ``.h``; ``.js`` or
            ``.mjs`` writes an ES module for Node and browsers and its TypeScript declarations;
            ``.html`` writes a page, as :meth:`explore` does; ``.fmu`` writes an FMU for
            co-simulation, with a binary if there is a C compiler.
        states : {"unknowns", "all"} or sequence of str
            Whether the model evaluates the unknowns alone or derivatives that are states as well,
            as a page always does; or the names of those that it has, ``["x"]``.
        rtol : float, optional
            By how much the model may differ from the solution, relative to the size of each
            unknown, to be smaller and faster; 1e-12 to 0.1. The difference is measured at 4200
            random points and by climbing from the worst of them, and said in the model. Without
            it the model is the solution.
        overwrite : bool
            Whether to replace existing files.
        allow_failed : bool
            Whether a solution may be exported that is not a success.
        fmi : {"2.0", "3.0"}, optional
            Version of FMI for an FMU, by default 2.0.

        Returns
        -------
        Path
            The file, or the first of several.

        Raises
        ------
        ExportError
            If the solution is not a success, or the path has another suffix, exists or cannot be
            written; for a page also if nothing depends on time.
        OptionError
            If there is no such choice of states or no such version of FMI, or ``rtol`` is out of
            its range.

        Warns
        -----
        RankoneWarning
            If an FMU has no binary, because nothing could be compiled.
        """
        from rankone.share.export import export_model

        options = {"overwrite": overwrite, "allow_failed": allow_failed}
        exported, group = self, states
        if not isinstance(group, str):
            rows = state_rows(self.states, group)
            exported, group = type(self)(*with_states(self.outcome, self.metadata, rows)), "all"
        choice = cast('Literal["unknowns", "all"]', group)
        return export_model(exported, path, states=choice, rtol=rtol, fmi=fmi, **options)

    def plot(self, values: Mapping[Any, Any] | None = None, /, **options: Any) -> Any:
        """Draw the solution: curves at values of the parameters, or bands over the box without any.

        Parameters
        ----------
        values, **options
            Values of the parameters, and options of
            :func:`rankone.share.plotting.plot_trajectories`; without values those of
            :func:`rankone.share.plotting.plot_bands`, such as ``unknowns``, ``t`` and ``ax``.

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        RankoneError
            If Matplotlib is not installed.
        EvaluationError
            If nothing depends on time.
        OptionError
            If the values are no mapping, such as the name of an unknown.
        """
        plotting = optional_module(
            "rankone.share.plotting", "plots need Matplotlib", "pip install it"
        )
        if values is not None and not isinstance(values, Mapping):
            raise OptionError(
                f"plot takes values of the parameters by name, not {shown(values)}",
                term=values,
                remedy=f"choose unknowns by a keyword: solution.plot(unknowns={shown(values)})",
            )
        if values or not self.metadata.parameters or set(options) & set(self.metadata.parameters):
            return plotting.plot_trajectories(self, values, **options)
        return plotting.plot_bands(self, **options)

    def explore(
        self,
        path: str | PathLike[str],
        *,
        title: str | None = None,
        rtol: float | None = None,
        overwrite: bool = False,
        allow_failed: bool = False,
    ) -> Path:
        """Write a page with a slider for each parameter, and the curves that follow.

        It is one HTML file that works offline, in any browser of the last years.

        Parameters
        ----------
        path : path-like
            Ends in ``.html``.
        title : str, optional
            The heading; by default the name of the problem, or else that of the file.
        rtol : float, optional
            By how much the curves may differ from the solution, relative to the size of each
            unknown, to make the file smaller; 1e-12 to 0.1.
        overwrite : bool
            Whether to replace an existing file.
        allow_failed : bool
            Whether to write a page of a solution that is not a success; the page says so.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        ExportError
            If the solution is not a success or does not depend on time, or the path has another
            suffix, exists or cannot be written.
        OptionError
            If the title is not text, or ``rtol`` is out of its range.
        """
        from rankone.share.export.explorer import export_page

        options = {"overwrite": overwrite, "allow_failed": allow_failed}
        return export_page(self, path, title=title, rtol=rtol, **options)
