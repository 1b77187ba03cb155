"""Tensors: trains and sums of products, their arithmetic, cross interpolation and evaluation.

=================  =================================================================================
module             subject, in the order to read
=================  =================================================================================
``train``          a tensor train: orthonormal cores, truncation; truncated SVD
``slab``           states on a time slab as a train; derivatives and smaller boxes
``skeleton``       columns of a matrix that give all others with small coefficients
``cross``          cross interpolation of sampled columns in one sweep
``scale_choice``   the coordinate of each parameter that needs the fewest nodes
``adaptive``       its nodes, left points and tolerances, from attempt to attempt
``evaluator``      trains at many points, at one point, along curves and on grids
``over_clock``     what evaluators over clock time share
``timeline``       evaluation over clock time, of slabs over stretches
``forks``          what tells several orders of events apart, as those who decide see it
``decisions``      which of several orders of events holds
``branches``       the same where several orders of events hold, each in a part of the box
``tiling``         boxes that tile a box, and which of them holds a point
``pieces``         evaluation where trains of its own belong to each box of a tiling
``canonical``      sums of products of functions, from the trains of a horizon
``rank_one_sums``  arithmetic of sums of products of nodal values; conversion to trains
=================  =================================================================================
"""
