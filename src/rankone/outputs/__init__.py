"""Outputs: quantities of interest of a solution, as solutions of their own.

======================  =================================================================
module                  subject
======================  =================================================================
``quantities``          the quantities, as functions of arrays
``sampling``            quantities at parameter points: functions of time, and reductions
``stretch_sampling``    the same of solutions with events, over the stretches between them
``check``               points where quantities are compared with their interpolation
``hidden``              what is narrow between the times at which quantities are sampled
``interpolation``       from quantities at points to trains, and their error
``branches``            the same of solutions in branches, branch by branch
``quantity_solutions``  from quantities to solutions
``states``              states of solutions with events: at one time, differentiated
======================  =================================================================
"""
