"""Equations that are not rates: algebraic ones, mass matrices, and what they determine.

- ``algebraic``: algebraic equations among differential ones, reduced to rates and constraints
- ``consistency``: initial values and resets of problems with algebraic equations: what they
  determine, and must
- ``mass``: the mass matrix: equations are linear in the highest derivatives, and determine them;
  elimination of quantities from equations that are linear in them
- ``matrices``: equations between matrices, and problems from mass, damping and stiffness matrices
"""
