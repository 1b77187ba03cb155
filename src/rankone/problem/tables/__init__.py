"""Rates of many states as tables of terms, from which no expression has to be written.

- ``tabulated``: equations, in SymPy or as text, and networks of reactions, read straight into a
  table of terms where they have one
- ``term_sums``: the arithmetic of tables of terms: sums of products, and operations on them
- ``term_table``: rates of many states as a table of terms, from which no expression has to be
  written, and rate laws of one form as factors of them
"""
