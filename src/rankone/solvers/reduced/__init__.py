"""Fields reduced to a few coefficients by POD and DEIM, and measured against full trajectories.

In comes a :class:`~rankone.trajectories.fields.field_system.FieldSystem`; out go a system of the
coefficients, which the cross engine solves, the modes that make fields of them, and the error that
trajectories of the fields themselves showed.

- ``field_modes``: from coefficients to fields
- ``functionals``: numbers that are linear in all coefficients of fields, and what errors of the
  fields do to them
"""
