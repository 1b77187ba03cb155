"""What trajectories are integrated of: a system as frozen data, and how a solve of it ended.

- ``events``: roots along trajectories that reset or end them, and the order in which they come
- ``features``: all that is not smooth, jumps, constraints that hold on all trajectories, and the
  user's functions in workers
- ``system``: a system as solvers see it: what a generated module defines, complete and typed
- ``timeline``: the timeline of a solution with events: what ends each stretch, and where clock
  time is
- ``verdict``: how a solve ended: status, cause and notes as data, and the message made of them
"""
