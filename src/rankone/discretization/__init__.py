"""One-dimensional discretisations: nodal bases, finite elements, Radau collocation for time."""

from rankone.discretization.basis import (
    BASES,
    Basis1D,
    ChebyshevBasis,
    LegendreBasis,
    legendre_derivative,
    legendre_values,
)
from rankone.discretization.finite_elements import LagrangeElements
from rankone.discretization.radau import RadauCollocation

__all__ = [
    "BASES",
    "Basis1D",
    "ChebyshevBasis",
    "LagrangeElements",
    "LegendreBasis",
    "RadauCollocation",
    "legendre_derivative",
    "legendre_values",
]
