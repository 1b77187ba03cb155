"""Commands of the command line: one module each, which adds its parser and runs.

============  ====================================================================================
``cli``       parsing and dispatch
``common``    parsers, problem files, saved solutions, summaries, exit status
``spelling``  messages in options and TOML, in place of Python
``solve``     ``rankone solve`` and ``rankone show``
``pieces``    pieces of a box for ``rankone solve``, side by side, which go on
``evaluate``  ``rankone eval``
``fit``       ``rankone fit``
``report``    ``rankone report``
``export``    ``rankone export`` and ``rankone explore``
============  ====================================================================================
"""
