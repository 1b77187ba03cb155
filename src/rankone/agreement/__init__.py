"""Generated code compared with the expressions that the user wrote.

Integrators, samples, residuals and references all call the same generated functions, so that none
of them sees an error there. When a problem is compiled, or an output made, these functions are
therefore compared with an evaluation of the user's own expressions at a hundred digits, which
shares nothing with the printer of generated code.

=====================================  ============================================================
:class:`~.comparison.Program`          values of expressions at a hundred digits
:class:`~.comparison.Comparison`       residuals, and whether they are more than rounding
:func:`~.problems.check_problem`       rates, their Jacobian, initial values and jumps of a problem
:func:`~.problems.check_outputs`       quantities of interest
:func:`~.tables.check_table`           the same of problems that came as tables of terms
=====================================  ============================================================
"""
