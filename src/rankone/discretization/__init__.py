"""One-dimensional discretisations: nodal bases for parameters, Radau collocation for time."""

from rankone.discretization.basis import (
    BASES,
    Basis1D,
    ChebyshevBasis,
    LegendreBasis,
    legendre_values,
)
from rankone.discretization.radau import RadauCollocation

__all__ = [
    "BASES",
    "Basis1D",
    "ChebyshevBasis",
    "LegendreBasis",
    "RadauCollocation",
    "legendre_values",
]
