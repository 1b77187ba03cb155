"""One-dimensional discretisations of parameters and of time.

- ``basis``: bases of one coordinate: nodal polynomials, elements of them, and Lagrange finite
  elements
- ``coordinates``: coordinates of a solution: their scales, and arguments turned into checked
  values
- ``distributions``: distributions of one parameter: of scipy.stats, as text, and cut at the ends
  of an interval
- ``joint_distribution``: joint distributions of the coordinates, and points drawn from them in
  sets
- ``time_grid``: slabs of time, and Radau nodes and integration on one of them
"""

from rankone.tensors.bases.basis import (
    BASES,
    Basis1D,
    ChebyshevBasis,
    LagrangeElements,
    LegendreBasis,
    legendre_derivative,
    legendre_values,
)
from rankone.tensors.bases.coordinates import (
    IDENTITY,
    SCALES,
    Identity,
    Logarithm,
    Reciprocal,
    Scale,
    first_scale,
)
from rankone.tensors.bases.time_grid import RadauCollocation

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
