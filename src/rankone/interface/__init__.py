"""What users hold: compiled problems and solutions.

==============  ====================================================================================
``compiled``    the pipeline from a problem to a generated module, and ``solve``
``stages``      what was derived from a problem, and the forms that methods take
``resting``     checks of starts at steady states
``renumbered``  a compiled problem with other numbers of its run-time constants
``lifted``      the lifted form of a problem, for methods that need separated terms
``stretched``   the form over stretches, for the same methods
``held``        the form with each switch of the rates held on a side
``steady``      steady states as solutions of the parameters alone
``many``        solves on many boxes, side by side
``observed``    outputs of a solve: quantities that are evaluated along its trajectories
``checkpoint``  finished solves in a folder
``digests``     functions of the user told apart by their code and state
``forms``       a solution as canonical sums, tables, figures, pages and exported models
``solution``    the solution with its statistics, outputs, fits, pieces and files
==============  ====================================================================================
"""
