"""Integrators of trajectories, the choice of one, and what watches their steps.

- ``defects``: defects of steps: what is narrow, and lies between the stages of a step; roots of
  many functions
- ``diagnosis``: what trajectories show: how fast changes grow, why they end, which states are
  zero, and, coarsely, what they reach
- ``integrator``: what an integrator takes and gives, paths of piecewise polynomials, and spans as
  a stack over the share of the way
- ``integrator_choice``: the choice of an integrator: by counted work, and again in mid-solve
  where a stack stalls
- ``lsoda``: generated functions at one point, for Python's floats, as LSODA calls them
- ``single``: trajectories integrated one by one with SciPy's LSODA, each with steps of its own
- ``workers``: trajectories on the workers of an executor: chunks of samples, and groups of
  references
"""
