"""A solution: evaluation, smaller solutions, tables with labels, summaries.

- ``core``: the core of a solution: evaluation, errors, files
- ``event_times``: what a solution with events says of their times
- ``joining``: one solution over a box, joined of solutions on pieces that tile it
- ``presentation``: a solution as people and other libraries see it: its summary, and xarray
- ``smaller``: solutions made from solutions: fewer parameters, a smaller box, derivatives
- ``streaming``: evaluation in blocks, so that values of any number of points take bounded memory
"""
