"""Where is a solution worst? Reference trajectories, candidate points, and the measured error."""
