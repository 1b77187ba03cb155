"""One-dimensional discretisations of parameters and of time.

===================  ==================================================================
module               subject, in the order to read
===================  ==================================================================
``scales``           coordinates of a parameter: itself, logarithm, reciprocal
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
from rankone.discretization.scales import (
    IDENTITY,
    SCALES,
    Identity,
    Logarithm,
    Reciprocal,
    Scale,
    first_scale,
)

__all__ = [
    "BASES",
    "IDENTITY",
    "SCALES",
    "Basis1D",
    "ChebyshevBasis",
    "Identity",
    "LagrangeElements",
    "LegendreBasis",
    "Logarithm",
    "RadauCollocation",
    "Reciprocal",
    "Scale",
    "first_scale",
    "legendre_derivative",
    "legendre_values",
]
