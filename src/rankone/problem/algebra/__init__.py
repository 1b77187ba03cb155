"""Equations that are not rates: algebraic ones, mass matrices, and what they determine.

- ``algebraic``: algebraic equations among differential ones, and initial values that are
  consistent with them
- ``mass``: the mass matrix: equations are linear in the highest derivatives, and determine them;
  elimination of quantities from equations that are linear in them
- ``matrices``: equations between matrices, and problems from mass, damping and stiffness matrices
- ``tabulated``: equations and reactions that are read straight into a table of terms where they
  have one
- ``term_sums``: the arithmetic of tables of terms: sums of products, and operations on them
- ``term_table``: rates of many states as a table of terms, and rate laws of one form as factors
  of them
"""
