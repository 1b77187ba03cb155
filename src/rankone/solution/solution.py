"""Solution: what users hold after a solve, for every parameter value and time at once."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import cached_property, partial
from itertools import chain
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np

from rankone.compiler.codegen.layout import Quantities
from rankone.solution.evaluation.core import SolutionCore
from rankone.solution.evaluation.domains import (
    at_time,
    derived,
    joined,
    merged,
    state_rows,
    with_fixed,
    with_restricted,
    with_states,
)
from rankone.solution.evaluation.event_times import EventTimes
from rankone.solution.evaluation.presentation import dataset, summary_html, summary_text
from rankone.solution.outputs.quantity_solutions import (
    OutputRequest,
    at_instant,
    derivative,
    met_before_end,
    over_clock_time,
    samples_of,
    with_outputs,
)
from rankone.solution.statistics.densities import DistributionOverBox
from rankone.solution.storage import read, write
from rankone.solvers.outcome import Outcome, Piece, SlabRecord, SolutionMetadata
from rankone.solvers.selection import RECORDS
from rankone.support.arrays import Array
from rankone.support.budget import Report, resolve_progress
from rankone.support.errors import (
    EvaluationError,
    OptionError,
    StorageError,
    check_kind,
    optional_module,
    shown,
)
from rankone.support.options import RTOL
from rankone.support.tasks import ExecutorLike, checked_executor, one_thread, open_pool
from rankone.tensors.branch_evaluator import BranchEvaluator, PieceEvaluator, Tiling
from rankone.tensors.canonical import CanonicalForms, canonical_form
from rankone.tensors.distributions import from_text
from rankone.tensors.joint_distribution import copula_of
from rankone.tensors.slab import SlabTrain
from rankone.tensors.timeline_evaluator import TimelineEvaluator
from rankone.trajectories.system.timeline import Timeline

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from rankone.inference.estimation import design, minimize, posterior, search
    from rankone.inference.populations import population


class Application:
    """A method that another room defines as a function of the solution.

    Parameters
    ----------
    module : str
        The module of the function, below ``rankone``.
    name : str
        The name of the function; its first argument is the solution.
    """

    def __init__(self, module: str, name: str) -> None:
        self.module = module
        self.name = name

    def __get__(self, instance: object | None, owner: type) -> Callable[..., Any]:
        """The function where it is read from the class, the method of an instance otherwise."""
        function = getattr(importlib.import_module(f"rankone.{self.module}"), self.name)
        bound: Callable[..., Any] = function.__get__(instance, owner)
        return bound


class Solution(DistributionOverBox, EventTimes):
    """The unknowns as functions of time and of all parameters.

    It is evaluated like :class:`~rankone.solution.evaluation.core.SolutionCore`, whose methods it
    has: ``solution(t=1.0, x0=9.0, y0=5.0)``, ``solution[x](...)``, ``solution.grid(...)``. Beside
    that it says how it was found, and can be written in other forms.

    Parameters
    ----------
    outcome : Outcome
        What the engine returned.
    metadata : SolutionMetadata
        What was asked.
    """

    # --- applications --------------------------------------------------------------------------

    if TYPE_CHECKING:
        fit = search.fit
        posterior = posterior.posterior
        minimize = minimize.minimize
        design = design.design
        fit_population = population.fit_population
    else:
        fit = Application("inference.estimation.search", "fit")
        posterior = Application("inference.estimation.posterior", "posterior")
        minimize = Application("inference.estimation.minimize", "minimize")
        design = Application("inference.estimation.design", "design")
        fit_population = Application("inference.populations.population", "fit_population")

    # --- how it was found ----------------------------------------------------------------------

    @property
    def ranks(self) -> tuple[tuple[int, ...], ...]:
        """For each slab the ranks of its train: time | parameter 1 | parameter 2 | ..."""
        return tuple(slab.ranks for slab in self._slabs)

    @property
    def rank(self) -> int:
        """The largest rank; 1 without parameters, 0 if nothing was solved."""
        return max((max(ranks, default=1) for ranks in self.ranks), default=0)

    @property
    def nodes(self) -> tuple[int, ...]:
        """For each parameter the largest number of nodes over the slabs.

        They are those of the coordinate in which the parameter needs fewest, such as its logarithm.
        """
        d = len(self.metadata.parameters)  # branches may have further coordinates
        sizes = [[basis.size for basis in slab.bases[:d]] for slab in self._slabs]
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
    def work(self) -> dict[str, float]:
        """Operations counted by stage: what of the budget that ``effort`` sets each one took."""
        return dict(self.outcome.work)

    @property
    def nbytes(self) -> int:
        """Bytes of the tensor trains."""
        return sum(core.nbytes for slab in self._slabs for core in slab.cores)

    @property
    def _slabs(self) -> list[SlabTrain]:
        """The slabs of all pieces."""
        pieces = [piece.outcome for piece in self.outcome.pieces] or [self.outcome]
        return [slab for outcome in pieces for slab in outcome.slabs]

    # --- pieces of the box ---------------------------------------------------------------------

    @classmethod
    def join(cls, pieces: Iterable[Solution]) -> Solution:
        """One solution over the box that solutions on pieces of it tile.

        Each point is evaluated by the piece that holds it, an edge by the piece above it. What
        belongs to the unknowns goes on: gradients, statistics, fits, plots, files, derivatives,
        outputs and smaller solutions.

        Parameters
        ----------
        pieces : iterable of Solution
            Of one problem, on boxes without gaps and overlaps, such as those of
            :meth:`rankone.Problem.split`; in any order.

        Returns
        -------
        Solution
            Its errors are those of the worst piece, relative to the sizes there; it is a success
            if all pieces are. ``pieces`` has them one by one.

        Raises
        ------
        OptionError
            If pieces overlap or leave a gap, which the message names, or belong to different
            problems, or one has nothing to evaluate.
        """
        listed = [pieces] if isinstance(pieces, Solution) else list(pieces)
        remedy = "give solutions: ro.Solution.join(ro.solve_many(...))"
        for piece in listed:
            check_kind("join", piece, Solution, remedy=remedy)
        if len(listed) == 1:
            return listed[0]
        return cls(*joined([Piece(piece.outcome, piece.metadata) for piece in listed]))

    @cached_property
    def pieces(self) -> tuple[Solution, ...]:
        """The solutions that this one was joined of; itself alone if it was not."""
        pieces = self.outcome.pieces
        return tuple(Solution(p.outcome, p.metadata) for p in pieces) if pieces else (self,)

    def _in_pieces(self, of: Callable[[Solution], Solution]) -> Solution:
        """What is made of each piece, joined again."""
        return Solution.join(map(of, self.pieces))

    _write = staticmethod(write)

    # --- derivatives and smaller solutions -----------------------------------------------------

    def diff(self, coordinate: object) -> Solution:
        """The derivatives of all unknowns with respect to a parameter or to time, as a solution.

        Exact for the trains: they are polynomials on elements. The error is not measured, so that
        ``success`` is False; it is about that of the solution times the degree squared over the
        width of the elements. A solution with events is interpolated anew, as by :meth:`output`;
        derivatives are at fixed times there, while events move with the parameters.

        Parameters
        ----------
        coordinate : str or Symbol

        Raises
        ------
        OptionError
            If there is no such coordinate.
        """
        self._evaluator  # noqa: B018 - raises if nothing was solved
        if self.outcome.pieces:
            return self._in_pieces(lambda piece: piece.diff(coordinate))
        if self.outcome.timeline is not None:
            return Solution(*derivative(self, coordinate))
        return Solution(*derived(self.outcome, self.metadata, coordinate))

    def gradient(
        self, *at: object, max_memory: str | float | None = None, **named: object
    ) -> Array:
        """Derivatives of all unknowns with respect to all parameters, at times and values.

        Arguments and errors are those of a call.

        Returns
        -------
        ndarray (unknowns, parameters, *broadcast shape of the values)
        """
        gathered = self._coordinates.gather(at, named)
        self._evaluator  # noqa: B018 - raises if nothing was solved
        each = len(self.unknowns), len(self.metadata.parameters)
        return self._within(max_memory, gathered, each, self._gradient_of_block)

    def _gradient_of_block(self, arrays: Sequence[Array]) -> Array:
        """The gradient at arrays that fit into the memory."""
        if isinstance(self._evaluator, PieceEvaluator):
            return self._gradient_in_pieces(self._evaluator.tiling, arrays)
        if isinstance(self._evaluator, TimelineEvaluator | BranchEvaluator):
            together = np.broadcast_arrays(*self._coordinates.arrays(arrays))
            times, *points = (array.ravel() for array in together)
            free, stacked = range(len(points)), np.array(points).reshape(-1, times.size)
            _, moved = self._evaluator.linearised(times[None], stacked, self._unknowns, free)
            moved = np.moveaxis(moved[:, 0], 2, 1)
            return np.asarray(moved.reshape(*moved.shape[:2], *together[0].shape))
        slopes = [slope._evaluate_block(arrays, slope._unknowns) for slope in self._slopes]
        if not slopes:
            unknowns = self._evaluate_block(arrays, self._unknowns)
            return np.zeros((len(unknowns), 0, *unknowns.shape[1:]))
        return np.stack(slopes, axis=1)

    def _gradient_in_pieces(self, tiling: Tiling, arrays: Sequence[Array]) -> Array:
        """The gradient at each point of the piece that holds it."""
        points, shape = self._coordinates.broadcast(self._coordinates.arrays(arrays))
        moved = np.empty((len(self.unknowns), len(points) - 1, points.shape[1]))
        names = (() if self.metadata.timeless else (self.metadata.time,), self.metadata.parameters)
        asked = points[1:] if self.metadata.timeless else points
        for position, here in tiling.groups(points[1:]):
            at = dict(zip(chain(*names), asked[:, here], strict=True))
            moved[:, :, here] = self.pieces[position].gradient(at)
        return moved.reshape(*moved.shape[:2], *shape)

    @cached_property
    def _slopes(self) -> list[Solution]:
        """The derivative with respect to each parameter."""
        return [self.diff(name) for name in self.metadata.parameters]

    def output(
        self,
        quantities: Mapping[str, Any] | str | Sequence[str],
        *,
        rtol: float | None = None,
        effort: str | float = "normal",
        max_seconds: float | None = None,
        units: Mapping[str, str] | None = None,
        executor: ExecutorLike | None = None,
        progress: bool | Report = False,
    ) -> Solution:
        """Quantities of interest as a solution of their own.

        Parameters
        ----------
        quantities : mapping of str to Expr or str, or definitions by name
            For each name an expression of unknowns, their time derivatives, parameters, time, and
            of the problem's constants and definitions. ``"F"``, or a list of names, asks for
            definitions of the problem as they are. A list of unknowns alone, ``["x", "y"]``, is
            the part of this solution that has these, with their errors; nothing is interpolated.
            ``Integral(x, (t, a, b))`` is an integral over time, to ``t`` as upper limit a running
            one; :func:`rankone.maximum`, :func:`rankone.minimum`, :func:`rankone.duration` and
            :func:`rankone.first_crossing` are functions of a whole function of time, and
            :func:`rankone.event_time` and :func:`rankone.at_event` ask for events. In a text
            write ``integral(x, a, b)``, ``maximum(x)``, ``at_event(x, bounce, 0)`` and so on.
            Where there are events, outputs may not depend on time.
        rtol : float, optional
            Tolerance, relative to the largest value of each quantity. By default 1.5 times what
            errors of the solution's tolerance in every unknown would bring, or that tolerance.
        effort : {"low", "normal", "high"} or float
            Budget of counted work: 0.2, 1 or 10 times what a core does in about 25 seconds, or
            another factor. When it is spent, the best so far is returned.
        max_seconds : float, optional
            Time limit on the clock besides.
        units : mapping of str to str, optional
            Units of quantities; definitions asked for by name have their own.
        executor : int, concurrent.futures.Executor, distributed.Client or str, optional
            Who evaluates them at many points, with the same bits: a number of processes, which are
            started and end with the call, an executor or a client of dask, which are left running,
            or the address of a scheduler of dask. By default this process.
        progress : bool or callable
            True shows a bar on standard error. A function is called with a
            :class:`~rankone.support.budget.ProgressEvent` at each step of an attempt over the
            parameters; an exception it raises stops.

        Returns
        -------
        Solution
            Of the parameters alone if no quantity depends on time. Its error is that of the
            interpolation, measured, and what the errors of the solution change the quantities
            by; that of time derivatives is not known, unless they are states.

        Raises
        ------
        OptionError
            If an expression has something that the solution does not hold, or cannot be sent to a
            worker.
        EvaluationError
            If a quantity is not finite somewhere in the box, or a level is not crossed.
        ConvergenceError
            If the budget is spent, or the time limit reached, before there is anything.
        RankoneError
            If SymPy is not installed.
        """
        wanted = None if executor is None else checked_executor("executor", executor)
        own_pool = nullcontext() if wanted is None else open_pool(wanted)
        with resolve_progress(progress) as report, own_pool as pool, one_thread():
            request = OutputRequest(rtol, effort, max_seconds, units, pool, report)
            return self._output(quantities, request)

    def _output(
        self, quantities: Mapping[str, Any] | str | Sequence[str], request: OutputRequest
    ) -> Solution:
        """Quantities of interest of a solution, or of each of its pieces."""
        self._evaluator  # noqa: B018 - raises if nothing was solved
        if isinstance(quantities, list | tuple) and quantities and {*quantities} <= {*self.states}:
            rows = state_rows(self.states, quantities)
            return Solution(*with_states(self.outcome, self.metadata, rows))
        if self.outcome.pieces:
            return self._in_pieces(lambda piece: piece._output(quantities, request))
        expressions = optional_module(
            "rankone.compiler.codegen.output_expressions",
            "outputs are given as expressions of SymPy",
            "pip install sympy",
        )
        metadata, horizon = self.metadata, self.time

        def of_branch(part: SolutionCore, timeline: Timeline | None) -> Quantities:
            times, p, states = samples_of(part)  # a branch may have coordinates behind p
            samples = times, p[: len(metadata.parameters)], states
            met = timeline and met_before_end(part, timeline)
            asked = quantities, metadata, horizon, samples, met
            formulas = expressions.output_formulas(*asked, with_sums=timeline is None)
            return cast(Quantities, formulas.over(metadata.box, horizon))

        if request.units is None and isinstance(quantities, Mapping):
            request = replace(request, units={})
        return Solution(*with_outputs(self, of_branch, request))

    def fix(self, values: Mapping[Any, Any] | None = None, /, **named: object) -> Solution:
        """The solution for given values of some parameters, as a solution of the others.

        Nothing is sampled. ``errors`` are those measured on the whole box, relative to the sizes
        there; where corners did not count and are above the tolerance, ``success`` is False.

        Raises
        ------
        OptionError
            If there is no such parameter, or its value is outside its range.
        """
        self._evaluator  # noqa: B018 - raises if nothing was solved
        return Solution(*with_fixed(self.outcome, self.metadata, merged(values, named)))

    def at(self, t: float) -> Solution:
        """The solution at one time, as a solution of the parameters alone.

        Nothing is sampled; ``errors`` are as for :meth:`fix`. A solution with events is
        interpolated anew, as by :meth:`output`.

        Raises
        ------
        EvaluationError
            If the time is not a number, or outside the horizon, or an event has happened by then
            for some parameters alone.
        """
        self._evaluator  # noqa: B018 - raises if nothing was solved
        time = self._times(t)
        if time.ndim:
            raise EvaluationError(
                f"t={t!r} is not a number", term=t, remedy="evaluate the solution at several times"
            )
        if self.outcome.pieces:
            return self._in_pieces(lambda piece: piece.at(float(time)))
        if self.outcome.timeline is not None:
            return Solution(*at_instant(self, float(time)))
        return Solution(*at_time(self.outcome, self.metadata, float(time)))

    def in_clock_time(self, rtol: float | None = None) -> Solution:
        """A solution with events as one of time and parameters, without its timeline.

        It is interpolated anew over clock time, as by :meth:`output`; then everything takes it.
        Events that reset states at times which move with the parameters are not resolved so.

        Parameters
        ----------
        rtol : float, optional
            Tolerance, by default as in :meth:`output`.

        Raises
        ------
        ConvergenceError
            If the tolerance is not reached.
        EvaluationError
            If a terminal event ends the solution.
        """
        self._evaluator  # noqa: B018 - raises if nothing was solved
        if self.outcome.pieces:
            return self._in_pieces(lambda piece: piece.in_clock_time(rtol))
        if self.outcome.timeline is None:
            return self
        return Solution(*over_clock_time(self, rtol))

    def restrict(self, intervals: Mapping[Any, Any] | None = None, /, **named: object) -> Solution:
        """The solution on smaller intervals of some parameters: ``restrict(k=(1, 2))``.

        Nothing is sampled. ``errors`` are as for :meth:`fix`.

        Raises
        ------
        OptionError
            If there is no such parameter, or an interval is not a part of its range.
        """
        self._evaluator  # noqa: B018 - raises if nothing was solved
        return Solution(*with_restricted(self.outcome, self.metadata, merged(intervals, named)))

    # --- other forms -----------------------------------------------------------------------------

    def to_canonical(self, rtol: float = RTOL, *, max_rank: int = 500) -> CanonicalForms:
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

    # --- display -------------------------------------------------------------------------------

    def __repr__(self) -> str:
        return summary_text(self)

    def _repr_html_(self) -> str:
        return summary_html(self)


def load(path: str | PathLike[str]) -> Solution:
    """Read a solution that was saved by :meth:`Solution.save`.

    Nothing in the file is executed.

    Returns
    -------
    Solution
        Evaluates to exactly the same values as the one saved.

    Raises
    ------
    StorageError
        As for :func:`rankone.solution.storage.read`.
    """
    outcome, metadata = read(path, RECORDS)
    return loaded(path, outcome, metadata)


def loaded(path: str | PathLike[str], outcome: Outcome, metadata: SolutionMetadata) -> Solution:
    """A solution that was read from a file; a StorageError if its distributions are none."""
    try:
        for _, text in metadata.distributions:
            from_text(text)
        copula_of(metadata.parameters, {(a, b): rho for a, b, rho in metadata.correlations})
    except OptionError as error:
        raise StorageError(f"`{path}` is damaged: {error}", term=path) from error
    return Solution(outcome, metadata)
