"""Trajectories at points of the box: integrators, and what watches them.

Read in this order:

===================  ============================================================================
``integrator``       what an integrator takes and gives: the protocol, tolerances, trajectories
``choice``           the choice of one, by counted work and again where a stack stalls
``stacks``           all trajectories as one stacked system, by Taylor series, DOP853 or Radau
``single``           SciPy's LSODA, one trajectory after the other
``lsoda``            the rates and Jacobians that it calls
``scalar``           generated functions rewritten for floats
``known_states``     the same for states of which some are known numbers
``compiled``         heyoka's, by Taylor series, a batch of trajectories with steps of their own
``series``           the rates of a generated module as what heyoka compiles, for stacks too
``paths``            trajectories that each have steps of their own, as piecewise polynomials
``dense_paths``      dense trajectories made of them, and the control of their steps
``shares``           a stack whose trajectories each begin and end at a time of their own
``defects``          defect control: whether a step missed something
``roots``            roots of functions that change sign, many at once
``spectra``          how fast small changes grow and decay
``coarse``           what trajectories reach, by few even steps
``events``           events on the way, and systems over stretches from event to event
``steady``           steady states that trajectories reach, and starts at them
``sensitive_paths``  one trajectory with its derivatives with respect to parameters
``sensitivities``    derivatives of trajectories with respect to parameters
``diagnosis``        why trajectories end, and which states are numerically zero
``workers``          chunks of trajectories on several processes
``groups``           reference trajectories in groups, which workers may take
===================  ============================================================================
"""
