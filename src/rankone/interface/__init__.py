"""What users hold: compiled problems and solutions.

==============  ==================================================================================
``compiled``    the pipeline from a problem to a generated module, and ``solve``
``renumbered``  a compiled problem with other numbers of its run-time constants
``lifted``      the lifted form of a problem, for methods that need separated terms
``solution``    the solution with its statistics, outputs, fits, exports and files
==============  ==================================================================================
"""
