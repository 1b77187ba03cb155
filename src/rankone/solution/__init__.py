"""A solution: evaluation, smaller solutions, tables with labels, summaries.

================  ==================================================================================
``core``          evaluation, errors and files; all that an exported solver needs of a solution
``timeline``      times of events
``branches``      the evaluator where several orders of events hold
``smaller``       parameters fixed, the box restricted, derivatives
``joining``       one solution over a box, of solutions on pieces that tile it
``streaming``     evaluation in blocks of bounded memory
``presentation``  the printed summary; xarray and pandas
================  ==================================================================================
"""
