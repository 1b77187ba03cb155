"""Integrators of trajectories, the choice of one, and what watches their steps.

- ``coarse``: coarse trajectories: what they reach, before the rates are known to be smooth
- ``defects``: defects of steps: what is narrow, and lies between the stages of a step
- ``dense_paths``: trajectories that were integrated one by one, and the control of their steps
- ``diagnosis``: what trajectories show: how fast changes grow, why they end, which states are
  zero
- ``integrator``: what an integrator takes and gives, and paths of piecewise polynomials
- ``integrator_choice``: the choice of an integrator: by counted work, and again in mid-solve
  where a stack stalls
- ``known_states``: generated functions of states of which the last ones are known numbers
- ``lsoda``: generated functions at one point, for Python's floats, as LSODA calls them
- ``roots``: roots of functions that change sign: many at once, however steep the functions are
- ``sensitivities``: derivatives of trajectories with respect to parameters: stacked, or one by
  one
- ``shares``: trajectories with spans of their own, as a stack over the share of the way
- ``single``: trajectories integrated one by one with SciPy's LSODA, each with steps of its own
- ``workers``: trajectories on the workers of an executor: chunks of samples, and groups of
  references
"""
