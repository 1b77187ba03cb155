"""Trajectories at points of the box: integrators, and what watches them.

Read in this order:

======================  ============================================================================
``integrator``          what an integrator takes and gives: the protocol, tolerances, trajectories
``choice``              the choice of one, by counted work and again where a stack stalls
``stacks``              Taylor series, DOP853 and Radau, with all trajectories as one stacked system
``steppers``            its steps, made again where they missed something
``taylor``              those of Taylor series, where rates are polynomials in the states
``explicit``            those of DOP853
``implicit``            those of Radau, after SciPy's
``newton``              Newton's matrices of its steps: dense inverses, or sparse factors
``elimination``         sparse factors: in bands, or by SuperLU
``spectra``             how fast small changes grow and decay
``single``              SciPy's LSODA, one trajectory after the other
``sensitive_paths``     one trajectory with its derivatives with respect to parameters
``paths``               trajectories that each have steps of their own, as piecewise polynomials
``dense_paths``         dense trajectories made of them, and the control of their steps
``shares``              a stack whose trajectories each begin and end at a time of their own
``lsoda``               the rates and Jacobians that it calls
``scalar``              generated functions rewritten for floats
``compiled``            heyoka's, by Taylor series, a batch of trajectories with steps of their own
``series``              the rates of a generated module as what heyoka compiles
``defects``             defect control: whether a step missed something
``event_trajectory``    a trajectory with events: what it has met, and what it has ahead
``instants``            what events do at one instant, and what they trigger
``crossings``           where paths cross the roots of functions, all of a stack at once
``events``              roots of functions along trajectories, which end them or reset their states
``event_order``         the order in which all trajectories of a box meet their events
``sides``               whether they stay on the sides of switches that they should be on
``stretches``           the system over stretches: from event to event, in pseudo-time
``over_stretches``      what trajectories over pseudo-time share
``stretch_integrator``  those that meet events in one order
``forced``              those that follow an order wherever it holds or not
``orders``              orders that hold in parts of a box, each continued to all of it
``markers``             crossings that all pass in step, where they get out of phase
``sensitivities``       derivatives of trajectories with respect to parameters
``rest``                steady states that trajectories reach
``conservation``        sums of states that no rate changes, which steady states keep
``resting_start``       starts at the steady states of other conditions
``branches``            whether the steady states over a box are on one branch
``diagnosis``           why trajectories end, and which states are numerically zero
``workers``             chunks of trajectories on several processes
======================  ============================================================================
"""
