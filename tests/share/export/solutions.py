"""Solutions of the reference problems, each solved once, and one solution of every kind."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np

import rankone as ro
from rankone.solvers.outcome import Outcome, SolutionMetadata
from rankone.tensors import Basis1D, ChebyshevBasis, LegendreBasis, Logarithm, Reciprocal
from rankone.tensors.slab import SlabTrain
from rankone.tensors.train import Train
from rankone.trajectories.system.verdict import Status
from tests.problems import EXAMPLES

__all__ = [
    "border_points",
    "compiled",
    "points",
    "solved",
    "synthetic",
    "synthetic_with_breaks",
    "synthetic_with_scales",
]


@cache
def compiled(name: str) -> ro.CompiledProblem:
    return ro.compile(EXAMPLES[name].problem)


@cache
def solved(name: str) -> ro.Solution:
    return compiled(name).solve(rtol=EXAMPLES[name].RTOL)


def points(solution: ro.Solution, count: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Random points by name, among them the ends of all intervals and of all slabs."""
    rng = np.random.default_rng(seed)
    intervals = {solution.metadata.time: solution.time, **solution.parameters}
    found = {}
    for name, (lower, upper) in intervals.items():
        found[name] = np.clip(lower + (upper - lower) * rng.random(count), lower, upper)
        found[name][:2] = lower, upper
    ends = [slab.end for slab in solution.outcome.slabs][: count // 4]
    found[solution.metadata.time][2 : 2 + len(ends)] = np.clip(ends, *solution.time)
    return found


def border_points(solution: ro.Solution) -> dict[str, np.ndarray]:
    """Points on the breaks of every parameter of every slab, by name."""
    slabs = solution.outcome.slabs
    rows = []
    for slab in slabs:
        middle = [0.5 * (slab.start + slab.end), *(0.5 * (b.lower + b.upper) for b in slab.bases)]
        for j, basis in enumerate(slab.bases, 1):
            rows += [[*middle[:j], edge, *middle[j + 1 :]] for edge in basis.breaks]
    names = [solution.metadata.time, *solution.parameters]
    return dict(zip(names, np.transpose(rows), strict=True))


@cache
def synthetic(status: Status = Status.CONVERGED) -> ro.Solution:
    """Random trains: two slabs, both bases, several elements, awkward names, a state not asked."""
    bases = (
        ChebyshevBasis(-2.0, 3.0, 4, 3),
        LegendreBasis(0.1, 0.7, 5, 2),
        LegendreBasis(1.0, 2.0, 1, 1),
    )
    return _random([bases, bases], status)


@cache
def synthetic_with_breaks() -> ro.Solution:
    """As before with elements of unequal size, others in each slab, beside equal ones."""
    first = (
        ChebyshevBasis(-2.0, 3.0, 4, breaks=(-1.9, 0.3, 0.8, 2.5)),
        LegendreBasis(0.1, 0.7, 5, 2),
        LegendreBasis(1.0, 2.0, 1, breaks=(1.7,)),
    )
    second = (
        ChebyshevBasis(-2.0, 3.0, 5, 3),
        LegendreBasis(0.1, 0.7, 5, breaks=(0.2, 0.25)),
        LegendreBasis(1.0, 2.0, 1, 1),
    )
    return _random([first, second], Status.CONVERGED)


@cache
def synthetic_with_scales() -> ro.Solution:
    """As before in scales of two parameters, with equal and with unequal elements."""
    bases = (
        ChebyshevBasis(-2.0, 3.0, 4),
        LegendreBasis(0.1, 0.7, 5, breaks=(0.15, 0.4), scale=Logarithm()),
        ChebyshevBasis(1.0, 2.0, 3, 2, scale=Reciprocal()),
    )
    return _random([bases, bases], Status.CONVERGED)


def _random(bases_of_slabs: Sequence[tuple[Basis1D, ...]], status: Status) -> ro.Solution:
    rng = np.random.default_rng(7)
    slabs = []
    for (start, end), bases in zip(((-1.0, 0.25), (0.25, 2.0)), bases_of_slabs, strict=True):
        ranks = (3, 5, 9, 2, 1)
        sizes = (6, *(basis.size for basis in bases))
        cores = tuple(
            rng.standard_normal((ranks[j], sizes[j], ranks[j + 1])) for j in range(len(sizes))
        )
        slabs.append(SlabTrain(start, end, Train(cores), bases))
    metadata = SolutionMetadata(
        states=("x", "int", "x_t"),
        roles=("unknown", "unknown", "derivative"),
        parameters=("lambda", "x_{0}", "α"),
        box=((-2.0, 3.0), (0.1, 0.7), (1.0, 2.0)),
        time="t",
        horizon=(-1.0, 2.0),
        rtol=1e-3,
        equations=("x' = */ nothing /* at all",),
    )
    return ro.Solution(Outcome(tuple(slabs), status, None, ()), metadata)
