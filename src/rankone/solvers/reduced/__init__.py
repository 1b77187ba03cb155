"""Fields reduced to a few coefficients by POD and DEIM, and measured against full trajectories.

In comes a :class:`~rankone.trajectories.fields.field_system.FieldSystem`; out go a system of the
coefficients, which the cross engine solves, the modes that make fields of them, and the error that
trajectories of the fields themselves showed.

- ``field_bases``: modes of fields and of functions, made of trajectories, and points to
  interpolate at
- ``field_causes``: why solves end
- ``field_comparison``: differences from full trajectories that events reset or end
- ``field_modes``: from coefficients to fields
- ``field_request``: what is asked of a solve, what it came to, and the numbers it goes by
- ``field_residual``: how far a reduced solution is from satisfying the equations of the fields
- ``field_solve``: solve for coefficients, and measure
- ``field_training``: modes of full trajectories where the reduced system is worst
- ``functionals``: numbers that are linear in all coefficients of fields, and what errors of the
  fields do to them
- ``reduced_events``: events of fields as events of their coefficients
- ``reduced_system``: the system of the coefficients, dense and small
"""
