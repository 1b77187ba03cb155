"""Functions of many coordinates in separated form.

In come values of functions at points of a box; out go tensor trains and sums of products, which
are evaluated anywhere in it. Numbers alone: this room knows neither problems nor SymPy.

- ``adaptive``: adaptive cross interpolation: nodes, left points and tolerances chosen until it
  suffices
- ``basis``: bases of one coordinate: nodal polynomials, elements of them, and Lagrange finite
  elements
- ``branch_evaluator``: evaluation of what a box is divided into: branches, and pieces that tile
  it
- ``canonical``: the canonical form: sums of products of functions of one coordinate
- ``coordinates``: coordinates of a solution: their scales, and arguments turned into checked
  values
- ``cross``: cross interpolation: a tensor train over [column] | p_1 | ... | p_d from sampled
  columns
- ``decisions``: which of several branches holds: by the forks at which they part, and by events
  they graze
- ``distributions``: distributions of one parameter: of scipy.stats, as text, and cut at the ends
  of an interval
- ``evaluator``: evaluation of tensor trains at many points, at one point, along curves and on
  grids
- ``joint_distribution``: joint distributions of the coordinates, and points drawn from them in
  sets
- ``polynomials``: polynomials in all parameters together, fitted to columns by least squares
- ``slab``: solved time slabs as tensor trains, and the coordinate of a parameter that needs
  fewest nodes
- ``time_grid``: functions of time on consecutive slabs, and Radau collocation on one of them
- ``timeline_evaluator``: evaluation over clock time of slabs over stretches
- ``train``: tensor trains, their truncated decompositions, and skeletons of matrices
"""

from rankone.tensors.basis import (
    BASES,
    Basis1D,
    ChebyshevBasis,
    LagrangeElements,
    LegendreBasis,
    legendre_derivative,
    legendre_values,
)
from rankone.tensors.coordinates import (
    IDENTITY,
    SCALES,
    Identity,
    Logarithm,
    Reciprocal,
    Scale,
    first_scale,
)
from rankone.tensors.time_grid import RadauCollocation

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
