"""From a problem to the system that solvers read.

In comes a problem; passes bring it to separated form, code generation prints a NumPy module, and
the module is compared with the expressions that the user wrote. Out go its text and the system.

- ``agreement``: generated code compared with the expressions that the user wrote
- ``codegen``: code generation: from equations to a plain NumPy module, and from its text to a
  System
- ``passes``: passes over a problem, from its equations to the separated form and the features
- ``observed``: outputs of a solve: quantities that are evaluated along its trajectories
- ``pipeline``: from a problem to a generated module, compared with it
- ``reformulated``: other forms of a compiled problem: lifted, held, over stretches, with other
  numbers
- ``stages``: what is derived from a problem before numbers come in: its stages, and the forms of
  methods
"""
