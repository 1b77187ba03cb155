"""Single SymPy expressions, whatever problem they belong to.

- ``admissible``: where is an expression defined?
- ``boundaries``: where functions kink or jump, and where smooth ones have peaks and steps
- ``conditions``: one form of conditions, whatever their spelling: comparisons of smooth
  functions, and, or, not
- ``derivatives``: unknowns as functions of time, and derivatives of expressions
- ``notation``: exact numbers inside, decimals for people, and numbers with a name
- ``parsing``: text to SymPy: arithmetic, the usual functions and the user's own names, and
  nothing else
- ``stable``: expressions written so that floating-point numbers neither overflow nor cancel
- ``values``: expressions and formulas as numbers: their trees evaluated with arrays
"""
