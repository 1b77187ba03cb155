"""Commands of the command line: one module each, which adds its parser and runs.

============  ====================================================================================
``cli``       parsing and dispatch
``common``    parsers, problem files, saved solutions, summaries, exit status
``solve``     ``rankone solve`` and ``rankone show``
``evaluate``  ``rankone eval``
``fit``       ``rankone fit``
``report``    ``rankone report``
``export``    ``rankone export`` and ``rankone explore``
============  ====================================================================================
"""
