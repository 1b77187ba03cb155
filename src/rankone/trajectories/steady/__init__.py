"""Steady states that trajectories reach, and starts at them.

- ``bifurcations``: branches of steady states, where they end or turn unstable, and starts that
  are steady states
- ``rest``: steady states made exact by Newton's method, and the sums that no rate changes
"""
