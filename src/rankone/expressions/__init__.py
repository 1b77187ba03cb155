"""Single SymPy expressions, whatever problem they belong to.

========================  ==========================================================================
:mod:`~.parsing`          text to expressions
:mod:`~.text_values`      text to numbers
:mod:`~.array_values`     expressions to numbers
:mod:`~.notation`         exact numbers in place of floating-point ones; text and LaTeX for people
:mod:`~.unknowns`         unknowns as functions of time, and their derivatives
:mod:`~.named_constants`  numbers that keep their name up to generated code
:mod:`~.admissible`       where an expression is defined: poles, roots, gaps between branches
:mod:`~.conditions`       comparisons of smooth functions in place of others
:mod:`~.boundaries`       where an expression kinks or jumps
:mod:`~.peaks`            where a smooth expression may change faster than samples see
:mod:`~.derivatives`      the derivatives that a Jacobian needs
:mod:`~.stable`           the same value without overflow and cancellation
========================  ==========================================================================
"""
