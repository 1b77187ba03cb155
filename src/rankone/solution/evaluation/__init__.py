"""A solution: evaluation, smaller solutions, tables with labels, summaries.

- ``core``: evaluation of a solution at times and parameters, in blocks that take bounded memory
- ``domains``: solutions on smaller domains, and those joined of pieces: nothing is sampled
- ``event_times``: what a solution with events says of their times
- ``presentation``: a solution as people and other libraries see it: its summary, and xarray
"""
