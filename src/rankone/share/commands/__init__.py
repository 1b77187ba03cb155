"""Commands of the command line: one module each, which adds its parser and runs.

- ``cli``: the command line: parsing, dispatch, and messages in its own words
- ``common``: shared by all commands: parsers, problem files and saved solutions, summaries, exit
  status
- ``solve_files``: ``rankone solve``, ``show`` and ``fit``: what is done with a problem
- ``solved_files``: ``rankone eval``, ``export``, ``explore`` and ``report``: what is done with a
  solution
"""
