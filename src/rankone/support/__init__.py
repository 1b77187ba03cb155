"""What every room uses: the version, errors, wording, files, progress, the budget of work.

- ``arrays``: arrays, the numbers that all rooms share, and results as tables and data sets
- ``budget``: the budget of a computation: work counted here and by workers, a deadline, and
  progress
- ``costs``: what numerical work costs, in operations of a budget, and sparse factors that are
  counted
- ``errors``: errors and warnings, and their wording: what was given, where, what was expected,
  what to do
- ``files``: free targets, files written together, and frozen dataclasses as plain data
- ``options``: options, declared with their ranges at the field and checked in one place; amounts
  of memory
- ``tasks``: executors of tasks, independent calls on them, what tasks share, and how answers come
  back
"""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("rankone")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"
