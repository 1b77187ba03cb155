"""Code generation: from a :class:`~rankone.ir.forms.QuadraticSystem` to a plain NumPy module.

==================  ================================================================================
``header``          what the module is, for a person who opens it
``factors``         all known functions of a coordinate
``kernels``         the separated right-hand side of a group, on many columns at once
``pointwise``       the right-hand side and its Jacobians at points
``general``         the module of a system that does not separate: pointwise functions alone
``derivatives``     derivatives of expressions in real symbols
``events``          where rates switch or are narrow: over states, and over several coordinates
``switching``       where functions of one coordinate switch
``switching_term``  a term that switches over the unknowns, named where a solve fails
``narrow``          peaks, steps and valleys of smooth functions
``initial``         initial values that couple parameters
``jumps``           states that are reset at known times
``meanings``        what lifted states stand for
``variables``       the variables of pointwise functions as names of Python
``definitions``     imports and tables of data
``combination``     linear maps of a kernel, written out or as a matrix
``sums``            sums of products with few operations
``text``, ``names`` layout of Python text; identifiers
``printer``         SymPy expressions as text: the only user of ``sympy.printing``
``module``          the parts in order, and how the module is imported
==================  ================================================================================
"""

from rankone.codegen.general import general_equation_texts, general_source
from rankone.codegen.header import equation_texts
from rankone.codegen.module import generate_source, load_module
from rankone.codegen.switching_term import switching_term

__all__ = [
    "equation_texts",
    "general_equation_texts",
    "general_source",
    "generate_source",
    "load_module",
    "switching_term",
]
