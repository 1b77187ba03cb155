"""Commands of the command line: one module each, which adds its parser and runs.

- ``cli``: the command line: parsing and dispatch; each command has a module beside this one
- ``common``: shared by all commands: parsers, problem files and saved solutions, summaries, exit
  status
- ``evaluate``: ``rankone eval FILE``: values at a point or on a grid
- ``export_files``: ``rankone export`` and ``rankone explore``: a standalone solver, a solved
  model, or a page
- ``fit_data``: ``rankone fit FILE data.csv``: parameters from measured data
- ``report``: ``rankone report FILE``: summary, statistics and plots of a solution
- ``solve_files``: ``rankone solve`` and ``rankone show``, also for pieces of a box side by side
- ``spelling``: messages as the command line and TOML files are written, not as Python is
"""
