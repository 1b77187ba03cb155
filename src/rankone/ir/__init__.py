"""Frozen data that pass between the front end, code generation, engines and solutions.

===============  ===================================================================================
``forms``        the separated form and the quadratic system, with their terms and factors
``functions``    functions that SymPy does not know: tables, functions of the user, maxima over time
``guarded``      functions of the user and names of tables, without SymPy
``features``     what is not smooth or narrow; gaps of piecewise functions; jumps
``jacobian``     Jacobians of many states, as the entries of a pattern
``constraints``  expressions of the states that vanish on all trajectories
``events``       roots along trajectories that reset or end them, and their order
``rest``         the system before a start at its steady state
``system``       the system as engines see it, made from a generated module
``measures``     intervals with a scale: uniform in the logarithm or the reciprocal
``observation``  what a solve keeps of trajectories in place of their states
``request``      what a solve is asked: domain, tolerance, check, limits, options
``outcome``      what an engine returns
``verdict``      how a solve ended: status, cause, notes, and the message made of them
``metadata``     the problem and the request behind a solution, as plain data
``timeline``     what ends each stretch of a solution with events, and its branches
===============  ===================================================================================
"""
