"""One trajectory of a problem, independent of all engines: a first check.

- ``crossings``: on which sides of its events' surfaces a trajectory is, and where it crosses them
- ``integration``: the integration of one trajectory, from event to event and from one known time
  to the next
- ``numeric``: the equations of a problem as functions of numbers, made from them as the user
  wrote them
- ``trajectory``: one ordinary trajectory of a problem, integrated by SciPy: a first check of any
  solution
"""
