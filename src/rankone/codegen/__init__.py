"""Code generation: from equations to a plain NumPy module, and from its text to a System.

======================  ============================================================================
``lowering``            the quadratic system: products of two, terms grouped by their factors
``module``              the generated module, section by section
``header``              what the module is, for a person who opens it
``factors``             all known functions of a coordinate
``kernels``             the separated right-hand side of a group, on many columns at once
``rates``               right-hand sides and Jacobians, of systems that separate or do not
``arrays``              those of many states, as sparse array code
``forms``               those of many states with laws of a few forms, as array code
``constraints``         what vanishes on all trajectories
``rest``                rates before a start at a steady state
``pointwise``           the one writer of pointwise functions, and the printer that it takes
``printer``             SymPy expressions as NumPy text: the only user of ``sympy.printing``
``sums``                sums of products with few operations
``text``                layout of Python text; identifiers
``loading``             how the text becomes a System, in this process and in others
``output_translation``  outputs in terms of states, their derivatives and reductions
``long_sums``           sums of many states in outputs, as states of their own
``output_expressions``  outputs given as SymPy expressions, as functions of arrays
======================  ============================================================================
"""
