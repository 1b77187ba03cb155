"""Adaptive time slabs: march the sweeps over the horizon.

The length of a slab is limited by what the time nodes resolve (the decay of the Legendre
coefficients of the reference trajectories) and by the contraction of the sweeps. Parameter nodes
are added while the highest modes of a parameter core are above the tolerance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rankone.arrays import Array
from rankone.discretization import Basis1D, RadauCollocation
from rankone.progress import ProgressEvent, quiet
from rankone.solvers.engine import Report
from rankone.solvers.outcome import SlabRecord, Status
from rankone.solvers.reference import INSET, Reference
from rankone.solvers.train.convergence import Convergence
from rankone.solvers.train.groups import ParameterOperators, term_groups
from rankone.solvers.train.nodes import FEW_PARAMETERS
from rankone.solvers.train.options import TrainOptions
from rankone.solvers.train.slab import SlabOperator
from rankone.solvers.train.sweep import Sweeper
from rankone.system import System
from rankone.tensors.slab import SlabTrain
from rankone.tensors.train import apply_to_modes, right_orthonormal, thinned, widened

__all__ = ["Guess", "March", "MarchResult"]

_SHRINK, _SLOW, _GROW = 0.5, 0.7, 1.5
"""On the length after divergence, many sweeps, few."""
_REFERENCE_NOISE = 1e-7
"""Relative size below which the dense output of the reference is not smooth."""
_PATIENCE = 1.15
"""After a rejection the length may grow by so much a slab."""
_UNRESOLVED = 0.8
"""A slab that ought to be shorter than this part of its length is solved again."""
_COARSEST = 30.0
"""Tolerance of the first sweep on a slab, at most so many times the final one."""
_MOST_PROBES = 8
"""One random sum for each state widens the frame, at most so many."""
_PROBE_MODES = 3
"""Number of modes of its terms: higher ones would look like a need for more nodes."""
_LEAST_FOR_MEMORY = 1e-3
"""Part of the horizon below which memory is no reason to halve."""
_THINNED = 0.5
"""Norm of the entries left out of an accepted slab, relative to the resolution."""
_SHORTEST = 1e-10
"""Shortest slab, relative to the horizon."""


@dataclass(frozen=True)
class Guess:
    """A slab of an earlier attempt: its place and its cores, a first guess for the next."""

    start: float
    length: float
    cores: tuple[Array, ...]
    bases: tuple[Basis1D, ...]


@dataclass
class MarchResult:
    """Slabs solved so far, and why the march ended early (None if it reached the end)."""

    slabs: list[SlabTrain] = field(default_factory=list)
    guesses: list[Guess] = field(default_factory=list)
    records: list[SlabRecord] = field(default_factory=list)
    limits: set[Status] = field(default_factory=set)
    stopped: Status | None = None


@dataclass
class March:
    """One pass over the horizon with a given inner tolerance.

    Parameters
    ----------
    system : System
    reference : Reference
        Trajectories at the check points, the centre first.
    scale : ndarray (n,)
        Size of each state, products included.
    bases : tuple of Basis1D
        Parameter bases to begin with.
    floors : tuple of int
        Degrees below which they are not coarsened.
    tolerance : callable
        Inner tolerance at the time t, in units of the sizes: what is dropped there is amplified
        until the end of the horizon.
    resolution : float
        Largest time mode left out. It is not amplified, since the Radau end points are
        superconvergent.
    options : TrainOptions
    collocation : RadauCollocation
    cuts : sequence of float
        Times, ascending, that no slab crosses.
    attempt : int
        Number of the attempt, for the records.
    guesses : sequence of Guess
        Slabs of the attempt before.
    report : callable
        Called with a ProgressEvent after each accepted slab.
    """

    system: System
    reference: Reference
    scale: Array
    bases: tuple[Basis1D, ...]
    floors: tuple[int, ...]
    tolerance: Callable[[float], float]
    resolution: float
    options: TrainOptions
    collocation: RadauCollocation
    cuts: Sequence[float] = ()
    attempt: int = 0
    guesses: Sequence[Guess] = ()
    report: Report = quiet

    def __post_init__(self) -> None:
        self._groups = term_groups(self.system)
        self._points = np.concatenate([[0.0], self.collocation.nodes])
        self._parameters = ParameterOperators(self.system, self.bases)
        self._second_residual = 1e-2
        self.result = MarchResult()

    def run(self, end: float) -> MarchResult:
        """March from the start of the reference to ``end``."""
        result = self.result
        start = self.reference.start
        horizon = end - start
        time, length = start, horizon
        ceiling = horizon
        source = self._initial()
        while end - time > 1e-12 * horizon:
            if len(result.records) >= self.options.max_slabs:
                result.stopped = Status.SLAB_LIMIT
                break
            if length < min(_SHORTEST * horizon, end - time):
                result.stopped = Status.NO_CONVERGENCE
                break
            proposed = length
            border = min([end, *(cut for cut in self.cuts if cut > time + 1e-12 * horizon)])
            remaining = border - time
            guess = self._guess(time, length)
            length = guess.length if guess else self._resolved(time, min(length, remaining))
            if length < remaining < 1.6 * length:
                length = 0.5 * remaining if guess is None else length
            if abs(remaining - length) < 1e-9 * remaining:
                length = remaining
            sweeper, record, source = self._solve(time, length, source, guess)
            result.records.append(record)
            stretch = self._stretch(sweeper, time) if sweeper else _SHRINK
            if sweeper is None or stretch < _UNRESOLVED:
                if sweeper is not None:
                    result.records[-1] = replace(record, accepted=False)
                ceiling = length = length * max(stretch, 0.2)
                if Status.MEMORY_LIMIT in result.limits and length < _LEAST_FOR_MEMORY * horizon:
                    result.stopped = Status.MEMORY_LIMIT
                    break
                continue
            self._accept(sweeper, time, length)
            source = self._end_of(sweeper)
            time = border if length == remaining else time + length
            place = time, (time - start) / horizon, self.attempt, len(result.slabs)
            self.report(ProgressEvent(*place, max(sweeper.ranks, default=1)))
            sweeps = len(record.residuals)
            length *= min(_GROW if sweeps <= 3 else _SLOW if sweeps >= 6 else 1.0, stretch)
            ceiling *= _PATIENCE
            if time == border:
                length = max(length, proposed)
            length = min(length, ceiling)
        return result

    # -- one slab -------------------------------------------------------------------------------

    def _solve(
        self, time: float, length: float, source: list[Array], guess: Guess | None
    ) -> tuple[Sweeper | None, SlabRecord, list[Array]]:
        """Sweep on one slab; the sweeper is None when it was rejected.

        The source is returned since it moves along when parameter nodes are added.
        """
        tolerance = self.tolerance(time)
        sweeper = self._start(time, length, source, guess)
        coarse = min(0.1 * self._second_residual, _COARSEST * tolerance)
        convergence = Convergence(tolerance, coarse if sweeper.dimensions else tolerance)
        accepted = False
        spectra: list[Array] = []
        if sweeper.dimensions == 0:
            convergence.add(sweeper.settle(tolerance, 40))
            accepted = convergence.solved(limited=False)
        else:
            sweeper.settle(max(tolerance, 1e-3), 8)
        most = self.options.max_sweeps if sweeper.dimensions else 0
        while not accepted and len(convergence.residuals) < most:
            current = convergence.next_tolerance
            residual, spectra = sweeper.iterate(current / np.sqrt(sweeper.dimensions))
            convergence.add(residual)
            limited = max(sweeper.ranks) >= self.options.max_rank
            if limited:
                self.result.limits.add(Status.RANK_LIMIT)
            if convergence.hopeless(limited):
                break
            if self._too_large(sweeper):
                self.result.limits.add(Status.MEMORY_LIMIT)
                break
            sweeper.settle(0.2 * tolerance, 12)
            wanted = self._refined(spectra, max(current, residual if limited else 0.0))
            if wanted == self.bases:
                accepted = convergence.solved(limited)
            else:
                sweeper, source = self._rebase(sweeper, source, wanted)
                convergence.restart()
        residuals, sizes = tuple(convergence.residuals), tuple(basis.size for basis in self.bases)
        span = self.attempt, time, time + length
        record = SlabRecord(*span, accepted, tolerance, residuals, sweeper.ranks, sizes)
        if accepted:
            self._spectra = spectra
            self._second_residual = residuals[min(1, len(residuals) - 1)]
        return (sweeper if accepted else None), record, source

    def _start(
        self, time: float, length: float, source: list[Array], guess: Guess | None
    ) -> Sweeper:
        operator = self._operator(time, length)
        if guess is None:
            cores = [operator.initial(source[0]), *source[1:]]
        else:
            maps = [old.transfer(new) for old, new in zip(guess.bases, self.bases, strict=True)]
            cores = right_orthonormal(apply_to_modes(guess.cores, maps))
        if self.bases:
            cores = widened(cores, self._probe())
        return Sweeper(
            operator, self._groups, self._parameters, cores, source, self.options.max_rank
        )

    def _probe(self) -> list[Array]:
        """Random sums of low-degree functions of one parameter each, as cores 1, ..., d.

        A pair of cores only sees what its frame does not hide. With a frame widened by the
        constant and by these functions the sweeps find dependences that the initial values do
        not have.
        """
        generator = np.random.default_rng(len(self.result.records))
        count = min(self.scale.size, _MOST_PROBES)
        sums = np.arange(1, count + 1)
        cores = []
        for basis in self.bases:
            constant = np.sqrt(basis.weights)
            low = np.arange(basis.size) % basis.degree < _PROBE_MODES
            modes = generator.standard_normal((count, basis.size)) * low
            modes *= np.sqrt(0.5) / np.linalg.norm(modes, axis=1, keepdims=True)
            core = np.zeros((count + 1, basis.size, count + 1))
            core[0, :, 0] = constant
            core[sums, :, sums] = np.sqrt(0.5) * constant
            core[sums, :, 0] = modes @ basis.to_modal
            cores.append(core)
        cores[-1] = 0.3 * cores[-1][:, :, :1]
        return cores

    def _operator(self, time: float, length: float) -> SlabOperator:
        times = time + length * (INSET + (1.0 - 2.0 * INSET) * self.collocation.nodes)
        centre = self.reference.points[0]
        states = self.system.with_products(self.reference(times)[:, 0])
        jacobian = self.system.quadratic_jacobian(times, states, centre[:, None])
        n = self.scale.size
        jacobian = np.broadcast_to(jacobian, (n, n, times.size))
        return SlabOperator(self.system, self.collocation, time, length, self.scale, jacobian)

    def _resolved(self, time: float, length: float) -> float:
        """The longest slab, up to ``length``, on which the time nodes resolve the reference."""
        tolerance = max(self.resolution, _REFERENCE_NOISE)
        scale = self.scale[: self.system.N_DIFFERENTIAL, None, None]
        count = self.collocation.count
        for _ in range(60):
            values = self.reference(time + length * self._points) / scale
            highest = (values @ self.collocation.to_modal.T)[..., -2:]
            tail = float(np.abs(highest).max())
            if tail <= tolerance:
                break
            length *= min(max(0.9 * (tolerance / tail) ** (1.0 / count), 0.3), 0.9)
        return length

    def _stretch(self, sweeper: Sweeper, time: float) -> float:
        """Factor on the length at which the highest time modes would be at the tolerance."""
        highest = self._time_modes(sweeper)[:, -2:]
        tail = float(np.sqrt(np.sum(highest**2, axis=(1, 2)).max()))
        allowed = max(20.0 * self.tolerance(time), self.resolution)
        return float((allowed / max(tail, 1e-300)) ** (1.0 / self.collocation.count))

    def _time_modes(self, sweeper: Sweeper) -> Array:
        """Legendre coefficients in time of the scaled states, (n_differential, modes, r_1)."""
        start = sweeper.source_in_frame()[:, None]
        nodes = sweeper.cores[0][: self.system.N_DIFFERENTIAL] * np.sqrt(self.collocation.count)
        return np.asarray(self.collocation.to_modal @ np.concatenate([start, nodes], axis=1))

    # -- parameter nodes ------------------------------------------------------------------------

    def _refined(self, spectra: Sequence[Array], tolerance: float) -> tuple[Basis1D, ...]:
        """Bases with more nodes where the highest modes are above the tolerance."""
        wanted = []
        for basis, spectrum in zip(self.bases, spectra, strict=True):
            finer = basis.refined(self.options.max_degree)
            if basis.tail(spectrum) <= tolerance:
                wanted.append(basis)
            elif finer.size > self.options.max_nodes:
                self.result.limits.add(Status.NODE_LIMIT)
                wanted.append(basis)
            else:
                wanted.append(finer)
        return tuple(wanted)

    def _set_bases(self, bases: tuple[Basis1D, ...]) -> list[Array]:
        """Take new bases; returns the maps of scaled values from the old to the new."""
        maps = [old.transfer(new) for old, new in zip(self.bases, bases, strict=True)]
        self.bases = bases
        self._parameters = ParameterOperators(self.system, bases)
        return maps

    def _rebase(
        self, sweeper: Sweeper, source: list[Array], bases: tuple[Basis1D, ...]
    ) -> tuple[Sweeper, list[Array]]:
        maps = self._set_bases(bases)
        source = right_orthonormal(apply_to_modes(source, maps))
        cores = right_orthonormal(apply_to_modes(sweeper.cores, maps))
        operator = sweeper.operator
        moved = Sweeper(
            operator, self._groups, self._parameters, cores, source, self.options.max_rank
        )
        return moved, source

    def _too_large(self, sweeper: Sweeper) -> bool:
        """Whether the contractions are estimated to need more than the memory allowed."""
        total = 0.0
        ranks = (*sweeper.ranks, 1)
        for left, basis, right in zip(ranks[:-1], self.bases, ranks[1:], strict=True):
            total += basis.size * (left * left * right + left * right * right) + left**3
        n, count = sweeper.operator.shape
        first = self.bases[0].size * count * n * ranks[1] ** 2 if self.bases else 0.0
        return 8.0 * (2.0 * total + 2.0 * first) > self.options.max_memory

    # -- start and end of slabs -----------------------------------------------------------------

    def _initial(self) -> list[Array]:
        """The initial values as a train: core 0 (n_differential, r), right-orthonormal."""
        terms = self.system.INITIAL
        rank = max(len(terms), 1)
        first = np.zeros((self.system.N_DIFFERENTIAL, rank))
        cores = [np.zeros((rank, basis.size, rank)) for basis in self.bases]
        rows = [
            self.system.parameter_factors(j, basis.nodes) * np.sqrt(basis.weights)
            for j, basis in enumerate(self.bases)
        ]
        for k, (coefficient, state, factors) in enumerate(terms):
            first[state, k] = coefficient / self.scale[state]
            for core, row, factor in zip(cores, rows, factors, strict=True):
                core[k, :, k] = row[factor]
        if not cores:
            return [first.sum(axis=1, keepdims=True)]
        cores[-1] = cores[-1].sum(axis=2, keepdims=True)
        return right_orthonormal([first, *cores])

    def _end_of(self, sweeper: Sweeper) -> list[Array]:
        """The train at the end of a slab, on parameter bases coarsened to what it needs."""
        first = sweeper.cores[0][: self.system.N_DIFFERENTIAL, -1] * np.sqrt(self.collocation.count)
        source = [first, *sweeper.cores[1:]]
        if not self.bases:
            return source
        tolerance = 0.02 * self.tolerance(sweeper.operator.start)
        bases = tuple(
            basis.coarsened(spectrum, tolerance, least)
            for basis, spectrum, least in zip(self.bases, self._spectra, self.floors, strict=True)
        )
        if all(new.size > 0.75 * old.size for new, old in zip(bases, self.bases, strict=True)):
            return source
        return right_orthonormal(apply_to_modes(source, self._set_bases(bases)))

    def _accept(self, sweeper: Sweeper, time: float, length: float) -> None:
        cores = [self._time_modes(sweeper), *sweeper.cores[1:]]
        cores = apply_to_modes(cores, [basis.to_modal for basis in self.bases])
        if len(self.bases) > FEW_PARAMETERS:
            cores = thinned(cores, _THINNED * self.resolution)
        cores[0] = cores[0] * self.scale[: len(cores[0]), None, None]
        self.result.slabs.append(SlabTrain(time, time + length, tuple(cores), self.bases))
        self.result.guesses.append(Guess(time, length, tuple(sweeper.cores), self.bases))

    def _guess(self, time: float, length: float) -> Guess | None:
        """The slab of the attempt before that starts here, if it is not too long."""
        for guess in self.guesses:
            if abs(guess.start - time) < 1e-12 * (1.0 + abs(time)):
                short_enough = guess.length <= 1.01 * self._resolved(time, guess.length)
                return guess if short_enough and guess.length <= 1.01 * max(length, 0.0) else None
        return None
