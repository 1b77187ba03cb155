"""Code generation: from equations to a plain NumPy module, and from its text to a System.

- ``field_source``: the text of a system of fields
- ``kernels``: the header of a module for a person, and the kernels of its separated right-hand
  side
- ``law_code``: rates of many states with laws of a few forms, as array code, constraints, and
  starts at rest
- ``layout``: layout of generated text, as ``ruff format`` would write it, and how it becomes a
  system
- ``module``: the generated module: its sections in the order a person reads them
- ``output_expressions``: SymPy expressions of a solution's unknowns, as functions of arrays
- ``output_translation``: outputs in terms of a solution's states: derivatives, integrals,
  extremes and events listed
- ``pointwise``: pointwise functions: rates, Jacobians, initial values, features, at given states
  and parameters
- ``printer``: SymPy expressions as NumPy text
- ``rates``: code of the rates: for some states line by line, for many as sparse matrices
- ``sums``: from the separated form to sums of products, and their text
"""
