"""Trajectories at points of the box: integrators, and what watches them."""
