"""Outputs: quantities of interest of a solution, as solutions of their own.

=================  ====================================================================
module             subject
=================  ====================================================================
``quantities``     the quantities, as functions of arrays
``sampling``       quantities at parameter points: functions of time, and reductions
``check``          points where quantities are compared with their interpolation
``interpolation``  from quantities at points to trains, and their error
=================  ====================================================================
"""
