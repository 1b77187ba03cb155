"""Lengths of slabs, and the nodes of the parameters on them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rankone.solvers.engines.engine_options import TRAIN, TrainOptions
from rankone.solvers.engines.train_operators import ParameterOperators
from rankone.solvers.engines.train_sweep import Sweeper
from rankone.solvers.march import (
    FAST_FACTOR,
    FEW_PARAMETERS,
    REJECTED_FACTOR,
    SLOW_FACTOR,
    SlabTrial,
    Span,
    interpolated,
    interpolated_initial,
)
from rankone.solvers.request import Domain
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.support.arrays import COINCIDENT, MINOR, NEGLIGIBLE, ROUNDING, TINY, Array
from rankone.tensors import BASES, Basis1D, RadauCollocation
from rankone.tensors.time_grid import times_within
from rankone.tensors.train import Integers, Train
from rankone.trajectories.system.system import System
from rankone.trajectories.system.verdict import Status


@dataclass(frozen=True)
class Accuracy:
    """Tolerances of the slabs of one attempt, in units of the states' sizes.

    ``level`` is the inner tolerance where errors do not grow; ``growth`` gives the largest later
    growth of an error made at a time.
    """

    level: float
    growth: Callable[[float], float]

    def tolerance(self, time: float) -> float:
        """Inner tolerance at a time: errors made there are amplified until the end."""
        return max(self.level / self.growth(time), ROUNDING)

    @property
    def resolution(self) -> float:
        """Largest dropped time mode: not amplified, as the end points are superconvergent."""
        return MINOR * self.level


@dataclass(frozen=True)
class Guess:
    """A slab of an earlier attempt, with its train as a first guess."""

    start: float
    length: float
    train: Train
    bases: tuple[Basis1D, ...]


@dataclass(frozen=True)
class TrainSpan(Span):
    """The interval of a slab, and the same slab of an earlier attempt if there is one."""

    guess: Guess | None = None


@dataclass(frozen=True)
class TrainTrial(SlabTrial):
    """A swept slab; ``spectra`` holds the norms of the modes by parameter."""

    sweeper: Sweeper
    spectra: Sequence[Array]

    @cached_property
    def time_modes(self) -> Array:
        """Legendre coefficients in time of the scaled states, (n_differential, modes, r_1)."""
        start = self.sweeper.source_in_frame()[:, None]
        collocation = self.sweeper.operator.collocation
        nodes = self.sweeper.cores[0][: len(start)] * np.sqrt(collocation.count)
        return np.asarray(collocation.to_modal @ np.concatenate([start, nodes], axis=1))


@dataclass
class SlabLengths:
    """The controller of the lengths of slabs; ``guesses`` are the slabs of the attempt before.

    The time nodes resolve the reference; no slab crosses a cut or is longer than ``longest``.
    """

    reference_set: ReferenceSet
    collocation: RadauCollocation
    accuracy: Accuracy
    guesses: Sequence[Guess] = ()
    longest: float = math.inf

    def __post_init__(self) -> None:
        end = self.reference_set.end
        self.borders = (*self.reference_set.cuts, end)
        self.horizon = end - self.reference_set.reference.start
        self.length = self.ceiling = self._proposed = min(self.horizon, self.longest)
        self._memory = self._hopeless = False

    def propose(self, start: float) -> TrainSpan | Status:
        """The next slab: the same as earlier, or as long as its nodes resolve the reference."""
        if self._hopeless:
            return Status.MEMORY_LIMIT
        if self.length < min(NEGLIGIBLE * self.horizon, self.borders[-1] - start):
            return Status.NO_CONVERGENCE
        self._proposed = self.length
        border = min(b for b in self.borders if b > start + COINCIDENT * self.horizon)
        remaining = border - start
        guess = self._guess(start)
        length = guess.length if guess else self.resolved(start, min(self.length, remaining))
        if guess is None and length < remaining < 1.6 * length:
            length = 0.5 * remaining
        if abs(remaining - length) < NEGLIGIBLE * remaining:
            return TrainSpan(start, remaining, border, guess)
        return TrainSpan(start, length, start + length, guess)

    def adapt(self, span: TrainSpan, trial: TrainTrial) -> bool:
        """Shorten after a rejection, lengthen where few sweeps were needed."""
        solved = trial.record.accepted
        stretch = self._stretch(span, trial) if solved else REJECTED_FACTOR
        self._memory = self._memory or Status.MEMORY_LIMIT in trial.limits
        if not solved or stretch < TRAIN.retry_length_ratio:
            self.ceiling = self.length = span.length * max(stretch, 0.2)
            self._hopeless = (
                self._memory and self.length < TRAIN.memory_halving_limit * self.horizon
            )
            return False
        sweeps = len(trial.record.residuals)
        factor = FAST_FACTOR if sweeps <= 3 else SLOW_FACTOR if sweeps >= 6 else 1.0
        self.length = span.length * min(factor, stretch)
        self.ceiling = min(TRAIN.recovery_factor * self.ceiling, self.longest)
        if span.end in self.borders:
            self.length = max(self.length, self._proposed)
        self.length = min(self.length, self.ceiling)
        return True

    def resolved(self, start: float, length: float) -> float:
        """The longest slab, up to ``length``, on which the time nodes resolve the reference."""
        tolerance = max(self.accuracy.resolution, TRAIN.reference_noise)
        scale = self.reference_set.states[:, None, None]
        nodes = self.collocation
        for _ in range(60):
            times = times_within(start, start + length, nodes.points)
            states = self.reference_set.reference(times) / scale
            tail = float(np.abs((states @ nodes.to_modal.T)[..., -2:]).max())
            if tail <= tolerance:
                break
            length *= min(max(0.9 * (tolerance / tail) ** (1.0 / nodes.count), 0.3), 0.9)
        return length

    def _stretch(self, span: TrainSpan, trial: TrainTrial) -> float:
        """Factor on the length at which the highest time modes would be at the tolerance."""
        tail = float(np.sqrt(np.sum(trial.time_modes[:, -2:] ** 2, axis=(1, 2)).max()))
        allowed = max(20.0 * self.accuracy.tolerance(span.start), self.accuracy.resolution)
        return float((allowed / max(tail, TINY)) ** (1.0 / self.collocation.count))

    def _guess(self, start: float) -> Guess | None:
        """The slab of the attempt before that starts here, if it is not too long."""
        for guess in self.guesses:
            if abs(guess.start - start) < COINCIDENT * (1.0 + abs(start)):
                longest = min(self.length, self.resolved(start, guess.length))
                return guess if guess.length <= 1.01 * longest else None
        return None


# -----------------------------------------------------------------------------
# Parameter nodes: enough for the known functions first, then as many as the solution needs.


@dataclass
class ParameterNodes:
    """The bases of all parameters, refined and coarsened on the way, and the operators on them.

    They are not coarsened below the degrees ``floors``.
    """

    system: System
    bases: tuple[Basis1D, ...]
    floors: tuple[int, ...]
    options: TrainOptions

    def __post_init__(self) -> None:
        self.operators = ParameterOperators(self.system, self.bases)

    def take(self, bases: tuple[Basis1D, ...]) -> list[Array]:
        """Take other bases; returns the maps of scaled values from the old to the new."""
        maps = [b.transfer(basis) for b, basis in zip(self.bases, bases, strict=True)]
        self.bases = bases
        self.operators = ParameterOperators(self.system, bases)
        return maps

    def refined(
        self, spectra: Sequence[Array], tolerance: float
    ) -> tuple[tuple[Basis1D, ...], bool]:
        """Bases with more nodes where the highest modes are above the tolerance.

        Also whether some would need more nodes than are allowed.
        """
        bases, limited = [], False
        for basis, spectrum in zip(self.bases, spectra, strict=True):
            finer = basis.refined(self.options.max_degree)
            needed = basis.tail(spectrum) > tolerance
            possible = finer.size <= self.options.max_nodes
            limited = limited or (needed and not possible)
            bases.append(finer if needed and possible else basis)
        return tuple(bases), limited

    def coarsened(self, spectra: Sequence[Array], tolerance: float) -> tuple[Basis1D, ...]:
        """Bases with no more nodes than are needed, if that makes any of them much smaller."""
        bases = tuple(
            basis.coarsened(spectrum, tolerance, least)
            for basis, spectrum, least in zip(self.bases, spectra, self.floors, strict=True)
        )
        pairs = zip(bases, self.bases, strict=True)
        smaller = any(fewer.size <= 0.75 * basis.size for fewer, basis in pairs)
        return bases if smaller else self.bases

    def initial(self, scale: Array) -> Train:
        """Initial values in units of ``scale``: core 0 (n_differential, r), right-orthonormal."""
        if not self.system.initial_separates:
            first, *cores = interpolated_initial(self.system, [b.nodes for b in self.bases]).cores
            roots = [np.sqrt(basis.weights)[:, None] for basis in self.bases]
            weighted = [core * root for core, root in zip(cores, roots, strict=True)]
            units = scale[: self.system.n_differential, None]
            return Train((first / units, *weighted)).right_orthonormal()
        terms = self.system.initial_terms
        rank = max(len(terms), 1)
        first = np.zeros((self.system.n_differential, rank))
        cores = [np.zeros((rank, basis.size, rank)) for basis in self.bases]
        rows = [
            self.system.parameter_factors(j, basis.nodes) * np.sqrt(basis.weights)
            for j, basis in enumerate(self.bases)
        ]
        for k, (coefficient, state, factors) in enumerate(terms):
            first[state, k] = coefficient / scale[state]
            for core, row, factor in zip(cores, rows, factors, strict=True):
                core[k, :, k] = row[factor]
        if not cores:
            return Train((first.sum(axis=1, keepdims=True),))
        cores[-1] = cores[-1].sum(axis=2, keepdims=True)
        return Train((first, *cores)).right_orthonormal()

    def probe(self, count: int, seed: int) -> list[Array]:
        """Random sums of low-degree functions of one parameter each, as cores 1, ..., d.

        Sweeps see a pair of cores only through its frame. A frame widened by the constant and
        these functions shows dependences on parameters that the initial values do not have.
        """
        generator = np.random.default_rng(seed)
        sums = np.arange(1, count + 1)
        cores = []
        for basis in self.bases:
            constant = np.sqrt(basis.weights)
            low = np.arange(basis.size) % basis.degree < TRAIN.probe_modes
            modes = generator.standard_normal((count, basis.size)) * low
            modes *= np.sqrt(0.5) / np.linalg.norm(modes, axis=1, keepdims=True)
            core = np.zeros((count + 1, basis.size, count + 1))
            core[0, :, 0] = constant
            core[sums, :, sums] = np.sqrt(0.5) * constant
            core[sums, :, 0] = modes @ basis.to_modal
            cores.append(core)
        cores[-1] = 0.3 * cores[-1][:, :, :1]
        return cores


def first_bases(
    system: System, domain: Domain, rtol: float, options: TrainOptions
) -> tuple[tuple[Basis1D, ...], tuple[int, ...]]:
    """Bases to start the march with, and the degrees below which they must not be coarsened.

    The factors of the terms and of the initial values are known functions of one parameter.
    With few parameters nodes are cheap and these functions are resolved to rounding level, so
    that a solution in their span is exact; otherwise to a part of the tolerance.
    """
    basis_class = BASES[options.basis]
    most = min(options.max_degree, options.max_nodes)
    common = min(max(round(2.0 + 1.2 * -math.log10(rtol)), 4), most)
    tolerance = ROUNDING if len(domain.box) <= FEW_PARAMETERS else 0.01 * rtol
    bases, floors = [], []
    for j, (lower, upper) in enumerate(domain.box):
        needed = _resolving_degree(system, j, basis_class(lower, upper, most), tolerance)
        floors.append(needed)
        bases.append(basis_class(lower, upper, max(common, needed)))
    return tuple(bases), tuple(floors)


def _resolving_degree(system: System, dimension: int, fine: Basis1D, tolerance: float) -> int:
    """Smallest degree that resolves the factors of one parameter; 3 if the fine basis does not."""
    relative = fine.relative_spectrum(system.parameter_factors(dimension, fine.nodes))
    noise = float(relative[-3:].max())
    if noise > TRAIN.unresolved_tail:
        return 3
    significant = np.flatnonzero(relative > max(tolerance, 8.0 * noise))
    return max(int(significant[-1]) + 2 if significant.size else 1, 3)


def after_jump(
    kind: int, nodes: ParameterNodes, source: Train, units: Array, tolerance: float
) -> Train:
    """The train (n, r_1), ... right after a jump from the one right before it.

    The jump, which may be any function of states and parameters, acts at each node on its own.
    Nodes are refined until they resolve the states after it to an interpolation error of
    ``tolerance``. Trains are in ``units`` (n,), scaled by the roots of the weights of the nodes.
    """
    bases = nodes.bases
    for refinement in range(TRAIN.max_refinements + 1):
        if bases != nodes.bases:
            source = source.apply_to_modes(nodes.take(bases)).right_orthonormal()
        jumped = interpolated(_Jumped(kind, nodes, source, units), nodes.bases, tolerance)
        modal = jumped.apply_to_modes([basis.to_modal for basis in nodes.bases])
        bases, _ = nodes.refined(modal.mode_norms(), tolerance)
        if bases == nodes.bases or refinement == TRAIN.max_refinements:
            break
    return jumped


class _Jumped:
    """The states after a jump at nodes, in their units."""

    def __init__(self, kind: int, nodes: ParameterNodes, source: Train, units: Array) -> None:
        self.kind, self.jumped, self.units = kind, nodes.system.jumps.jumped, units[:, None]
        self.nodes = [basis.nodes for basis in nodes.bases]
        self.source = source.unscaled([basis.weights for basis in nodes.bases])

    def __call__(self, indices: Integers) -> Array:
        """At indices (m, d) of nodes: (n, m)."""
        before = self.units * (self.source.first @ self.source.at_indices(indices))
        points = np.array([x[i] for x, i in zip(self.nodes, indices.T, strict=True)])
        after = self.jumped(self.kind, before, points.reshape(len(self.nodes), len(indices)))
        return np.asarray(after / self.units)
