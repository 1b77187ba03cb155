"""Solutions handed on: exported files, figures, and the command line.

In come solutions, or files of problems; out go solvers and models that need no rankone, plots and
reports. Nothing below this room imports it.

- ``commands``: commands of the command line: one module each, which adds its parser and runs
- ``export``: solvers and solved models as files that need neither rankone nor SymPy
- ``plotting``: plots of a solution: its values, statistics and base functions, and how it was
  found
"""
