"""What users write, validated here: problems in SymPy or text, and problem files.

======================  ============================================================================
:mod:`~.problem`        :class:`rankone.Problem`, what users build, change, save and integrate
:mod:`~.checked`        its arguments validated, by all the checks below
:mod:`~.box`            the time interval, the intervals or distributions of parameters, units
:mod:`~.box_pieces`     a box cut into pieces that tile it
:mod:`~.content`        what a checked problem holds, shows, and is compared by
:mod:`~.shorthand`      constants and definitions
:mod:`~.run_time`       which constants are run-time values of compiled problems
:mod:`~.changes`        other problems from one: constants set, parameters fixed or set free
:mod:`~.matrices`       equations between matrices, problems from mass, damping and stiffness
:mod:`~.reactions`      problems from stoichiometric matrices and rate laws
:mod:`~.addends`        matrices and vectors as sums of coefficients times arrays
:mod:`~.term_table`     the rates of many states as a table of terms, and no expressions
:mod:`~.term_sums`      the arithmetic of such tables
:mod:`~.rate_forms`     rate laws that differ in their unknowns and numbers alone
:mod:`~.tabulated_texts`  right-hand sides as text, read straight into such a table
:mod:`~.tabulated_equations`  equations of SymPy, read into such a table
:mod:`~.mistakes`       what is often written in place of an unknown at the time t
:mod:`~.equations`      equations, unknowns and their initial values
:mod:`~.mass`           the mass matrix in front of the highest derivatives
:mod:`~.algebraic`      algebraic equations reduced to rates and constraints
:mod:`~.elimination`    linear equations solved symbolically, and what they leave over
:mod:`~.consistency`    initial values and resets that satisfy algebraic equations
:mod:`~.steady_start`   starts at the steady state of other conditions
:mod:`~.jumps`          resets at known times, also those written as ``DiracDelta``
:mod:`~.events`         what happens where an expression crosses zero
:mod:`~.markers`        expressions that users give to end stretches of time
:mod:`~.text`           formulas by name as the expressions that the checks take
:mod:`~.numeric`        the equations as functions of numbers
:mod:`~.integration`    the integration of one trajectory, by SciPy
:mod:`~.crossings`      where a trajectory crosses the surfaces of events
:mod:`~.trajectory`     one trajectory at the times asked for
:mod:`~.toml_tables`    tables of a TOML file as arguments in text
:mod:`~.saving`         problems as TOML text
:mod:`~.problem_files`  problems from Python and TOML files
======================  ============================================================================
"""
