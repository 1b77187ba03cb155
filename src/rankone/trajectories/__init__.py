"""Systems, and their trajectories at points of the box.

In come a :class:`~rankone.trajectories.system.system.System`, which a generated module defines,
parameters and tolerances; out go trajectories with their events, steady states and derivatives.

- ``events``: events along trajectories, and the system over stretches from event to event
- ``fields``: systems of fields, their trajectories one by one, and what is kept of these
- ``integrators``: integrators of trajectories, the choice of one, and what watches their steps
- ``stacks``: trajectories that take their steps together, as one stacked system
- ``steady``: steady states that trajectories reach, and starts at them
- ``system``: what trajectories are integrated of: a system as frozen data, and how a solve of it
  ended
"""
