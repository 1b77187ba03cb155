"""One-dimensional discretisations of parameters and of time.

- ``basis``: nodal bases on an interval, one element (spectral) or several: the parameter
  discretisation
- ``coordinates``: arguments of a solution: names and values turned into checked coordinates
- ``distributions``: distributions of one parameter: of scipy.stats, as text, and cut at the ends
  of an interval
- ``finite_elements``: continuous shape functions on an interval: linear, quadratic and spectral
  elements
- ``joint_distribution``: the joint distribution of all parameters: one for each, joined by a
  Gaussian copula
- ``radau``: right Radau collocation on one time slab
- ``replicates``: points drawn for statistics, in sets whose spread is the error of what they say
- ``scales``: scales of a parameter, and the intervals that have one
- ``time_grid``: functions of time on consecutive slabs: nodes, slabs that resolve, piecewise
  polynomials
"""

from rankone.tensors.bases.basis import (
    BASES,
    Basis1D,
    ChebyshevBasis,
    LegendreBasis,
    legendre_derivative,
    legendre_values,
)
from rankone.tensors.bases.finite_elements import LagrangeElements
from rankone.tensors.bases.radau import RadauCollocation
from rankone.tensors.bases.scales import (
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
