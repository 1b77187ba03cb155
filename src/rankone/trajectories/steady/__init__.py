"""Steady states that trajectories reach, and starts at them.

- ``bifurcations``: branches of steady states, and where they end or turn unstable
- ``rest``: steady states made exact by Newton's method, and the sums that no rate changes
- ``resting_start``: starts at the steady state of other conditions: the initial values of a
  system that has one
"""
