"""Where is a solution worst? Reference trajectories, candidate points, and the measured error.

- ``cuts``: cuts of one coordinate: where known functions of it jump, kink or are narrow
- ``measure``: errors measured against the reference set of a solve, over clock time and in
  branches
- ``points``: where points of a box lie, at which a solution is checked, and the search for worse
  ones
- ``reference``: reference trajectories at single parameter points, and the times at which they
  are compared
- ``reference_set``: the reference set of a solve: trajectories, and the sizes of what is solved
  for
- ``resolution``: how far down the states of reference trajectories are resolved
- ``worst_points``: a second look at what passed: finer trajectories, and where slabs are worst
"""
