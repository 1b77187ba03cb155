"""Outputs: quantities of interest of a solution, as solutions of their own.

=================  ====================================================================
module             subject
=================  ====================================================================
``quantities``     what is asked for, as functions of arrays
``over_time``      integrals, extremes and crossings of functions of time
``sampling``       values of quantities at parameter points
``check``          where quantities are compared with their interpolation
``interpolation``  from values at points to a train, and how good it is
``solved``         that as a solution
=================  ====================================================================
"""
