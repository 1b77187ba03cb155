"""Where is a solution worst? Reference trajectories, candidate points, and the measured error.

- ``branch_errors``: errors of branches against trajectories that follow their own order of events
- ``check_tuning``: the numbers of the check: where a solution is measured, and against what
- ``cuts``: cuts of one coordinate: where known functions of it jump, kink or are narrow
- ``finer``: whether finer trajectories confirm those of a reference
- ``growth``: how much errors grow that are made on the way
- ``measure``: errors measured against the reference set of a solve, also over clock time
- ``points``: where points of a box lie, at which a solution is checked, and the search for worse
  ones
- ``reference``: reference trajectories at single parameter points, and the times at which they
  are compared
- ``reference_set``: the reference set of a solve: trajectories, and the sizes of what is solved
  for
- ``resolution``: how far down the states of reference trajectories are resolved
- ``worst_points``: where slabs are worst: points that a few reference trajectories do not see
"""
