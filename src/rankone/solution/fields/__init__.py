"""Solutions of fields: a solution of coefficients, and the modes that make fields of them.

- ``field_core``: fields at times and parameters, and how they were found
- ``field_presentation``: a solution of fields as people and other libraries see it: its summary,
  and xarray
- ``field_quantities``: functionals of fields as a solution of their own: nothing is sampled or
  interpolated
- ``field_solution``: what users hold after a reduced solve of fields
- ``field_statistics``: statistics of fields from those of their coefficients
- ``field_view``: one unknown, or some of its entries, as functions of time and the parameters
"""
