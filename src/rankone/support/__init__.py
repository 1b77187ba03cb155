"""What every room uses: the version, errors, wording, files, progress, the budget of work.

================  ==================================================================================
``arrays``        the array type, points of a cube, corners, bisection
``errors``        errors and warnings: message and remedy
``wording``       quotes, lists, names, tables and equations in text
``labelled``      results as tables of pandas, data sets of xarray, and in notebooks
``budget``        counted work, and a deadline where a user asked for one
``memory``        amounts of memory as users write and read them
``costs``         what numerical work costs, in operations
``sparse``        factors of one sparse matrix, counted
``options``       options of engines: declared with their ranges, checked in one place
``executors``     processes that end with this one, executors of others, clusters of dask
``parcels``       what all tasks share, loaded once by each worker
``tasks``         independent calls on them, also when workers die
``counted``       work of tasks that are done elsewhere, charged here
``threads``       BLAS on one thread while a solve runs
``progress``      progress events, a bar, timings of stages
``memory_files``  large answers of workers on this machine, which are not copied here
``files``         several files written together, all of them or none
``deferred``      tuples that are made when they are first read
``plain_data``    frozen dataclasses as plain data and back
================  ==================================================================================
"""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("rankone")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"
