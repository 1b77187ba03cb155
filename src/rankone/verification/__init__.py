"""Where is a solution worst? Reference trajectories, candidate points, and the measured error.

Read in this order:

=================  ================================================================================
``reference_set``  the reference set of a solve: trajectories, and the sizes of what is solved for
``measure``        errors measured against it
``sharing``        one reference set for all engines that a solve tries
``growth``         how much errors grow that are made on the way
``clock``          errors at clock times, where slabs are over stretches between events
``branches``       errors where several orders of events hold, and the share left undecided
``finer``          whether finer trajectories confirm those of the reference
``hidden``         what is narrow in the rates between the steps of reference trajectories
``short_steps``    whether short steps over a place that surprised change the trajectory
``hidden_events``  events that take place between those steps
``steps``          steps of trajectories, and the pieces into which the two divide them
``enclosures``     what samples of a function may hide, by its range
``narrow``         times at which narrow outputs are checked
``worst_points``   where the error is expected to be above the tolerance
``reference``      reference trajectories, and the intervals on which they reach the end
``resolution``     how far down their states are resolved
``coverage``       coordinates in which the points of a box are spread, decades included
``points``         where they begin: the points of the box at which a solution is checked
``cuts``           where known functions of one coordinate are not smooth or narrow
``search``         climbing, by which the others find points
=================  ================================================================================
"""
