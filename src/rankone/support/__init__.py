"""What every room uses: the version, errors, wording, files, progress, the budget of work.

- ``arrays``: their types, points of a cube, bisection, and tuples that are made when first read
- ``budget``: the budget of a computation: work counted here and by workers, and a deadline where
  a user asked for one
- ``costs``: what numerical work costs, in operations of a budget, and sparse factors that are
  counted
- ``errors``: errors and warnings: what was given, where, what was expected, what to do
- ``files``: free targets, files written together, and frozen dataclasses as plain data
- ``labelled``: what results look like as tables of pandas, as data sets of xarray, and in
  notebooks
- ``options``: options, declared with their ranges at the field and checked in one place; amounts
  of memory
- ``precision``: what counts as rounding, as the same place, and as nothing
- ``progress``: progress of a solve: events for a callback, or a bar on standard error
- ``tasks``: executors of tasks, independent calls on them, what tasks share, and how answers come
  back
- ``wording``: text for people: quotes and lists in messages, names, tables and equations
"""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("rankone")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"
