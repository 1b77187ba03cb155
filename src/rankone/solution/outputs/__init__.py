"""Outputs: quantities of interest of a solution, as solutions of their own.

- ``branch_outputs``: quantities of a solution in branches: those of each branch, continued over
  the whole box
- ``interpolation``: from values of quantities at parameter points to a solution, and how good it
  is
- ``output_check``: where quantities are compared with their interpolation, and what is narrow
  between samples
- ``quantity_solutions``: quantities of interest, and states over clock time, as solutions of
  their own
- ``sampling``: values of quantities of a solution at parameter points
- ``stretch_sampling``: values of quantities of a solution with events, over the stretches between
  them
"""
