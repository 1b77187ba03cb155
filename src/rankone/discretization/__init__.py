"""One-dimensional discretisations of parameters and of time.

===================  ==================================================================
module               subject, in the order to read
===================  ==================================================================
``basis``            nodal bases of a parameter, in one element or several
``finite_elements``  continuous shape functions of the classic method
``radau``            collocation on one slab, for the train engine
``time_grid``        nodes and piecewise polynomials on consecutive slabs
``coordinates``      arguments of a solution as checked coordinates
===================  ==================================================================
"""

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
