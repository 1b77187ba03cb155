"""Trajectories that take their steps together, as one stacked system.

- ``explicit``: explicit steps (DOP853) of stacked trajectories, and the step that suits all of
  them
- ``implicit``: implicit steps of stacked trajectories: Radau IIA, with a Jacobian for each
  trajectory
- ``kinks``: steps of DOP853 that are divided at kinks, for those trajectories of a stack that
  cross one
- ``newton``: Newton's matrices of stacked implicit steps, dense or sparse, and their factors
- ``stack``: trajectories at many parameter points, integrated together as one stacked system by
  SciPy
- ``taylor``: Taylor steps of stacked trajectories whose rates are polynomials in the states
"""
