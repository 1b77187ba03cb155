"""What users hold: compiled problems, and solutions for every parameter value and time at once.

In comes a problem, or the outcome of a solve; out go numbers, statistics, outputs that are
solutions of their own, and files. Applications (``inference``, ``share``) are opened by methods of
a solution when these are called, and by nothing else here.

- ``checkpoint``: finished solves in a folder, found again by digests of what was solved
- ``compiled``: compiled problems, which are solved, also with markers that users give
- ``compiled_fields``: compiled problems with fields, and their solves
- ``evaluation``: a solution: evaluation, smaller solutions, tables with labels, summaries
- ``fields``: solutions of fields: a solution of coefficients, and the modes that make fields of
  them
- ``many``: many solves of one problem: on pieces of its box, under conditions, for designs
- ``outputs``: outputs: quantities of interest of a solution, as solutions of their own
- ``solution``: solution: what users hold after a solve, for every parameter value and time at
  once
- ``solving``: the two ways in: compile a problem, and solve one, with fields or without
- ``statistics``: statistics of a solution over its box: every integral is a product of one-
  dimensional ones
- ``steady``: steady states as solutions of the parameters alone
- ``storage``: saving and loading solutions in open formats, without pickle
"""
