"""Parameters from data: fits, posteriors, designs, best values, populations and calibrations.

In come solutions and tables of measurements; out go estimates that say how sure they are. Nothing
below this room imports it.

- ``calibration``: calibration problems: parameters from data over bounds that are too wide for
  one solution
- ``estimation``: parameters from data, posterior distributions, designs and best values: methods
  of a solution
- ``populations``: parameters that differ between subjects, from data of all of them
"""
