"""Rates of many states as tables of terms, from which no expression has to be written.

- ``rate_forms``: rate laws of one form: trees that differ in their unknowns and numbers alone
- ``reactions``: networks of reactions: a stoichiometric matrix, and the rate of each reaction
- ``tabulated``: equations, in SymPy or as text, read straight into a table of terms where they
  have one
- ``term_sums``: the arithmetic of tables of terms: sums of products, and operations on them
- ``term_table``: rates of many states as a table of terms, from which no expression has to be
  written
"""
