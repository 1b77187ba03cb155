"""Single SymPy expressions, whatever problem they belong to.

- ``admissible``: where is an expression defined?
- ``boundaries``: where functions kink, jump, or are narrow, and expressions as numbers
- ``conditions``: unknowns as functions of time, derivatives, and one form of conditions
- ``notation``: exact numbers inside, decimals for people, and numbers with a name
- ``parsing``: text to SymPy: arithmetic, the usual functions and the user's own names, and
  nothing else
- ``stable``: expressions written so that floating-point numbers neither overflow nor cancel
"""
