"""What trajectories are integrated of: a system as frozen data, and how a solve of it ended.

- ``features``: what a system has beside its rates: events, features that are not smooth, jumps,
  constraints
- ``system``: a system as solvers see it: what a generated module defines, complete and typed
- ``timeline``: the timeline of a solution with events: what ends each stretch, and where clock
  time is
- ``verdict``: how a solve ended: status, cause and notes as data, and the message made of them
"""
