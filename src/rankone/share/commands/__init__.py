"""Commands of the command line: one module each, which adds its parser and runs.

- ``cli``: the command line: parsing, dispatch, and messages in its own words
- ``common``: shared by all commands: parsers, problem files and saved solutions, summaries, exit
  status
- ``fit_data``: ``rankone fit FILE data.csv``: parameters from measured data
- ``report``: ``rankone report FILE``: summary, statistics and plots of a solution
- ``solve_files``: ``rankone solve`` and ``rankone show``, also for pieces of a box side by side
- ``solved_files``: ``rankone eval``, ``export`` and ``explore``: what is done with a solution
"""
