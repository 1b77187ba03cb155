"""Systems, and their trajectories at points of the box.

In come a :class:`~rankone.trajectories.system.system.System`, which a generated module defines,
parameters and tolerances; out go trajectories with their events, steady states and derivatives.

- ``bifurcations``: branches of steady states and where they change, and starts that are steady
  states
- ``events``: events along trajectories, and the system over stretches from event to event
- ``fields``: systems of fields, their trajectories one by one, and what is kept of these
- ``integrators``: integrators of trajectories, the choice of one, and what watches their steps
- ``rest``: steady states made exact by Newton's method, and the sums that no rate changes
- ``stacks``: trajectories that take their steps together, as one stacked system
- ``system``: what trajectories are integrated of: a system as frozen data, and how a solve of it
  ended
"""
