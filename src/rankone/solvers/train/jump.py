"""States after a jump, as a train on parameter nodes that resolve them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rankone.solvers.interpolation import interpolated
from rankone.solvers.train.nodes import ParameterNodes
from rankone.support.arrays import Array
from rankone.tensors.samples import Integers
from rankone.tensors.train import apply_to_modes, mode_norms, right_orthonormal

__all__ = ["after_jump"]

_MOST_REFINEMENTS = 24


def after_jump(
    kind: int, nodes: ParameterNodes, source: Sequence[Array], units: Array, tolerance: float
) -> list[Array]:
    """The train (n, r_1), ... right after a jump from the one right before it.

    The jump, which may be any function of states and parameters, acts at each node on its own.
    Nodes are refined until they resolve what it makes.

    Parameters
    ----------
    kind : int
        Which one.
    nodes : ParameterNodes
    source : sequence of ndarray
        In units of the states (n,), scaled by the roots of the weights of the nodes.
    units : ndarray (n,)
    tolerance : float
        What may be lost.
    """
    cores, bases = list(source), nodes.bases
    for number in range(_MOST_REFINEMENTS + 1):
        if bases != nodes.bases:
            cores = right_orthonormal(apply_to_modes(cores, nodes.take(bases)))
        found = interpolated(_Jumped(kind, nodes, cores, units), nodes.bases, tolerance)
        modal = apply_to_modes(found, [basis.to_modal for basis in nodes.bases])
        bases, _ = nodes.refined(mode_norms(modal), tolerance)
        if bases == nodes.bases or number == _MOST_REFINEMENTS:
            break
    return found


class _Jumped:
    """The states after a jump at nodes, in their units."""

    def __init__(
        self, kind: int, nodes: ParameterNodes, cores: Sequence[Array], units: Array
    ) -> None:
        self.kind, self.jumped, self.units = kind, nodes.system.jumped, units[:, None]
        self.nodes = [basis.nodes for basis in nodes.bases]
        roots = [np.sqrt(basis.weights)[:, None] for basis in nodes.bases]
        self.first = cores[0]
        self.cores = [core / root for core, root in zip(cores[1:], roots, strict=True)]

    def __call__(self, indices: Integers) -> Array:
        """At indices (m, d) of nodes: (n, m)."""
        carry = np.ones((1, len(indices)))
        for core, column in zip(reversed(self.cores), indices.T[::-1], strict=True):
            carry = np.einsum("rms,sm->rm", core[:, column], carry)
        before = self.units * (self.first @ carry)
        points = np.array([x[i] for x, i in zip(self.nodes, indices.T, strict=True)])
        after = self.jumped(self.kind, before, points.reshape(len(self.nodes), len(indices)))
        return np.asarray(after / self.units)
