"""Trajectories at points of the box: integrators, and what watches them.

Read in this order:

=================  ================================================================================
``integrator``     what an integrator takes and gives: the protocol, tolerances, trajectories
``stacks``         the choice of one: SciPy's, with all trajectories as one stacked system
``steppers``       their steps, made again where they missed something: defect control
``diagnosis``      why trajectories end, and which states are numerically zero
``workers``        chunks of trajectories on several processes
=================  ================================================================================
"""
