"""Tuning constants of the greedy engine, measured over the reference problems."""

from __future__ import annotations

from rankone.support.costs import CALL

# Accuracy of slabs

TOLERANCE_SHARE = 0.03  # Tolerance of a slab relative to rtol, before errors grow
TAIL_SHARE = 0.1  # Part of rtol that the highest modes may make up
# Largest loss from rounding a state at the end of a slab, relative to the slab's tolerance
END_ROUNDING_SHARE = 0.2
# Largest loss from thinning the trains of a slab, relative to the slab's tolerance
THINNING_SHARE = 0.05
# Largest interpolation error of states after a jump, relative to the slab's tolerance
JUMP_SHARE = 0.01

# Lengths of slabs

# Length of the first slab times the largest norm of the scaled Jacobian
FIRST_SLAB_CONTRACTION = 3.0
SHORTEST_SLAB = 1e-6  # Shortest slab, relative to the horizon
FEW_ITERATIONS = 10  # Lagged iterations up to which the next slab is longer
MANY_ITERATIONS = 16  # Lagged iterations above which the next slab is shorter
FAST_FACTOR = 1.5  # Factor on the length after few iterations
SLOW_FACTOR = 0.7  # Factor on the length after many iterations
REJECTED_FACTOR = 0.5  # Factor on the length after a rejection

# Convergence of the lagged iteration

INNER_TOLERANCE_SHARE = 0.1  # Tolerance of an equation relative to the last change of the unknowns
# Change, in units of the states' sizes, above which the iteration has diverged
DIVERGED_CHANGE = 1e3
MAX_SOURCE_RANK = 4000  # Rank above which a source is compressed before it is solved for

# Enrichment

# Modes in a row without a better residual after which enrichment ends, by what is updated
STALLED_MODES = {"all": 4, "time": 8, "amplitudes": 12}
BETTER_RESIDUAL = 0.98  # Ratio of residuals below which a mode counts as an improvement
# Weight, relative to the largest diagonal entry, that ties an update to the modes it replaces
PROXIMAL_WEIGHT = 1e-12
# Largest system of coupled modes that is solved densely whatever its bandwidth
MAX_DENSE_SIZE = 1200

# Parameter nodes

FINE_DEGREE = 64  # Degree of the basis on which the factors of a parameter are resolved
FINITE_ELEMENT_NODES = 41  # Nodes in every dimension for finite elements, if none are given
# Up to this many parameters, known functions are resolved nearly to rounding level
FEW_PARAMETERS = 2

# Counted work

# Operations of a pass over a dimension, besides those with large arrays
PASS_OPERATIONS = 100.0 * CALL
SPARSE_OPERATIONS = 5e3  # Operations for each unknown of a sparse system
