"""Trajectories that take their steps together, as one stacked system.

===============  ============================================================================
``integrator``   Taylor series, DOP853 and Radau behind the protocol of integrators
``steppers``     its steps, made again where they missed something
``taylor``       those of Taylor series, where rates are polynomials in the states
``explicit``     those of DOP853
``kinks``        those that some trajectories divide where the rates kink
``implicit``     those of Radau, after SciPy's
``newton``       Newton's matrices of its steps: dense inverses, or sparse factors
``elimination``  sparse factors: in bands, or by SuperLU
===============  ============================================================================
"""
