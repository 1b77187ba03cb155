"""Generated code compared with the expressions that the user wrote.

Integrators, samples, residuals and references all call the same generated functions, so that none
of them sees an error there. When a problem is compiled, or an output made, these functions are
therefore compared with an evaluation of the user's own expressions at a hundred digits, which
shares nothing with the printer of generated code.

- ``agreement``: the generated module, and its table of terms, compared with what the user wrote
- ``comparison``: values of expressions at a hundred digits, and residuals that are more than
  rounding
"""
