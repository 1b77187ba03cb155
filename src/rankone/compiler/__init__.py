"""From a problem to the system that solvers read.

In comes a problem; passes bring it to separated form, code generation prints a NumPy module, and
the module is compared with the expressions that the user wrote. Out go its text and the system.

- ``agreement``: generated code compared with the expressions that the user wrote
- ``codegen``: code generation: from equations to a plain NumPy module, and from its text to a
  System
- ``comparison``: values of expressions at a hundred digits, and residuals that are more than
  rounding
- ``field_agreement``: a system of fields compared with the rates that the user wrote
- ``field_lowering``: from a problem with fields to the system that solvers read
- ``field_outputs``: outputs of fields as expressions of functionals, which are linear in the
  coefficients
- ``passes``: passes over a problem, from its equations to the separated form and the features
- ``reformulated``: problems in other unknowns, and quantities that a solve holds in place of the
  states
- ``stages``: the stages of compilation, what each makes, and the call of one after the other
"""
