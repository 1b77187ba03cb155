"""Code generation: from a :class:`~rankone.ir.SeparatedForm` to a plain NumPy module.

``generate_source`` runs four stages, each with a file of its own:

lowering
    Products of more than two states become products of two, by auxiliary states.
grouping
    Terms are collected by signature; each group decides which states its products pair.
kernels, pointwise
    Python text of the separated kernels and of the pointwise right-hand side and Jacobians.
    Both share subexpressions and factor sums through ``sums``.
module
    Header, tables and functions in the order of the contract in :mod:`rankone.system`.

Only ``printer`` prints SymPy expressions; everything else works on integers and strings.
"""

from rankone.codegen.header import equation_texts
from rankone.codegen.module import generate_source, load_module

__all__ = ["equation_texts", "generate_source", "load_module"]
