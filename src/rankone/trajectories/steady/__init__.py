"""Steady states that trajectories reach, and starts at them.

==================  ===================================================================
``rest``            steady states by trajectories and Newton's method
``conservation``    sums of states that no rate changes, which steady states keep
``branches``        whether the steady states over a box are on one branch
``bifurcations``    where a branch ends or turns unstable, and which kind of bifurcation it is
``resting_start``   starts at the steady states of other conditions
==================  ===================================================================
"""
