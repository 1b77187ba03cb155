"""Engines: what separates the solution over the box, and how one is chosen and run.

=================  =================================================================================
``registry``       the engines by name, and which ones a method tries
``engine``         the interface of engines, and the ways in which one solves
``selection``      a solve that tries one engine after another
``attempts``       reference, march, check, tighten, until the measured error fits
``narrowing``      which parameters to narrow where that does not happen, and to what
``remedies``       what to do about a refused solve, tried before it is offered
``march``          one pass over the horizon, slab after slab
``interpolation``  initial values and states after jumps, interpolated in a tensor train
``stretches``      solves over stretches between events
``branches``       solves of several orders of events, each a branch
``branching``      the branches of a search for orders, and where each two of them part
``branch_check``   their check against trajectories that follow their own order
``one_order``      a part of the box in which events come in one order, for messages
``markers``        the reference over stretches between markers, where they pay
``cross``          the engine that interpolates trajectories
``train``          the engine that sweeps over a tensor train
``greedy``         the classic engine, which enriches by rank-one terms
=================  =================================================================================
"""
