"""Parameter nodes: enough for the known functions first, then as many as the solution needs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rankone.discretization import BASES, Basis1D
from rankone.ir.request import Domain
from rankone.ir.system import System
from rankone.solvers.interpolation import interpolated, interpolated_initial
from rankone.solvers.train.options import (
    FEW_PARAMETERS,
    MAX_REFINEMENTS,
    PROBE_MODES,
    ROUNDING_LEVEL,
    UNRESOLVED_TAIL,
    TrainOptions,
)
from rankone.solvers.train.slab import ParameterOperators
from rankone.support.arrays import Array
from rankone.tensors.train import Integers, Train


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
            low = np.arange(basis.size) % basis.degree < PROBE_MODES
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
    tolerance = ROUNDING_LEVEL if len(domain.box) <= FEW_PARAMETERS else 0.01 * rtol
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
    if noise > UNRESOLVED_TAIL:
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
    for refinement in range(MAX_REFINEMENTS + 1):
        if bases != nodes.bases:
            source = source.apply_to_modes(nodes.take(bases)).right_orthonormal()
        jumped = interpolated(_Jumped(kind, nodes, source, units), nodes.bases, tolerance)
        modal = jumped.apply_to_modes([basis.to_modal for basis in nodes.bases])
        bases, _ = nodes.refined(modal.mode_norms(), tolerance)
        if bases == nodes.bases or refinement == MAX_REFINEMENTS:
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
