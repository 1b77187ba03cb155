"""Solutions made of known separable functions: the exact oracle of the tests."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rankone.solution.solution import Solution
from rankone.solvers.outcome import Measured, Outcome, SlabRecord, SolutionMetadata
from rankone.tensors import Basis1D, ChebyshevBasis, LegendreBasis
from rankone.tensors.slab import SlabTrain
from rankone.tensors.train import Train
from rankone.trajectories.system.verdict import Status

Array = NDArray[np.float64]
Function = Callable[[Array], Array]
Products = Sequence[Sequence[Function]]
"""A sum of products: for each term a function of time and of each parameter."""

TIME_MODES = 14


def coefficients(basis: Basis1D, function: Function) -> Array:
    return np.asarray(basis.to_modal @ (np.sqrt(basis.weights) * function(basis.nodes)))


def slab_train(
    states: Sequence[Products], start: float, end: float, bases: Sequence[Basis1D]
) -> SlabTrain:
    """Interpolate the states, each a sum of products, on one slab."""
    terms = [(row, term) for row, products in enumerate(states) for term in products]
    time = LegendreBasis(start, end, TIME_MODES)
    first = np.zeros((len(states), TIME_MODES, len(terms)))
    cores = [first]
    for k, (row, term) in enumerate(terms):
        first[row, :, k] = coefficients(time, term[0])
    for j, basis in enumerate(bases, 1):
        core = np.zeros((len(terms), basis.size, len(terms)))
        for k, (_, term) in enumerate(terms):
            core[k, :, k] = coefficients(basis, term[j])
        cores.append(core)
    cores[-1] = cores[-1].sum(axis=2, keepdims=True)
    return SlabTrain(start, end, Train(tuple(cores)), tuple(bases))


@dataclass(frozen=True)
class Known:
    """A solution and the functions it was made of."""

    solution: Solution
    states: Sequence[Products]

    def __call__(self, *coordinates: Array | float) -> Array:
        arrays = np.broadcast_arrays(*(np.asarray(c, dtype=float) for c in coordinates))
        return np.array(
            [
                sum(
                    np.prod([f(a) for f, a in zip(term, arrays, strict=True)], axis=0) for term in s
                )
                for s in self.states
            ]
        )


def one(values: Array) -> Array:
    return np.ones_like(values)


def known(
    states: Sequence[Products],
    names: Sequence[str],
    parameters: dict[str, tuple[float, float]],
    *,
    breaks: Sequence[float] = (0.0, 1.0, 1.5, 3.0),
    time: str = "t",
    elements: int = 1,
    unknowns: int | None = None,
) -> Known:
    """Build a solution whose slabs differ in their bases."""
    slabs = []
    for i, (start, end) in enumerate(itertools.pairwise(breaks)):
        bases = [
            (ChebyshevBasis, LegendreBasis)[(i + j) % 2](lower, upper, 12 + i + j, elements)
            for j, (lower, upper) in enumerate(parameters.values())
        ]
        slabs.append(slab_train(states, start, end, bases))
    count = len(names) if unknowns is None else unknowns
    record = SlabRecord(
        0, breaks[0], breaks[1], False, 1e-7, (0.5, float("inf"), float("nan")), (2,), (12,)
    )
    outcome = Outcome(
        slabs=tuple(slabs),
        status=Status.CONVERGED,
        measured=Measured(
            tuple(1e-7 * (k + 1) for k in range(len(names))),
            tuple(2e-7 * (k + 1) for k in range(len(names))),
            256,
            "DOP853",
        ),
        history=(record, replace(record, attempt=1, accepted=True, residuals=(0.5, 1e-9))),
        timings={"reference": 0.01, "march": 0.25, "check": 0.125},
    )
    metadata = SolutionMetadata(
        states=tuple(names),
        roles=("unknown",) * count + ("derivative",) * (len(names) - count),
        parameters=tuple(parameters),
        box=tuple(parameters.values()),
        time=time,
        horizon=(breaks[0], breaks[-1]),
        rtol=1e-6,
        equations=("dx/dt = ...",),
        version="0.1.0",
        source="# source\n",
    )
    return Known(Solution(outcome, metadata), states)


def two_unknowns(elements: int = 1) -> Known:
    """Two unknowns of two parameters, rank 3."""
    states: list[Products] = [
        [(np.sin, np.exp, np.cos), (np.cos, lambda p: p**2, one)],
        [(lambda t: 1.0 + t**3, one, np.sin)],
    ]
    return known(states, ["x", "y"], {"x0": (-1.0, 1.0), "y0": (2.0, 3.0)}, elements=elements)


def decay() -> Known:
    """One unknown and no parameter."""
    return known([[(lambda t: np.exp(-t),)]], ["u"], {})


def oscillator() -> Known:
    """A second-order unknown: its derivative is a state; time is called s."""
    states: list[Products] = [[(np.sin, one)], [(np.cos, one)]]
    return known(states, ["x", "x_t"], {"k": (1.0, 2.0)}, time="s", unknowns=1)
