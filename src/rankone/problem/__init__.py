"""What users write, validated: problems in SymPy, text, or files, also those of other tools.

In come equations, parameters with their intervals, initial values and events; out goes a
:class:`~rankone.problem.problem.Problem`, checked and immutable.

- ``algebra``: equations that are not rates: algebraic ones, mass matrices, and what they
  determine
- ``array_operators``: arithmetic with arrays of expressions that stand for many numbers
- ``box``: the coordinates of a problem: the time interval, the box of the parameters, and its
  pieces
- ``checked``: the checks of a problem's arguments, what follows from them, and how it is shown
- ``constant_arrays``: what users write for constant matrices and vectors, as checked numbers
- ``equations``: the equations of a problem and the initial values of its states
- ``expressions``: single SymPy expressions, whatever problem they belong to
- ``field_conversions``: matrices as problems with one field, and problems with fields entry by
  entry
- ``field_events``: events and jumps of problems with fields
- ``field_problem``: the checks of a problem with fields, and all that follows from them
- ``field_rates``: the rates of fields from their equations, and what rates may have
- ``field_values``: initial values of fields, and their mass matrices
- ``fields``: vectors of unknowns as SymPy expressions: fields, and constant matrices that act on
  them
- ``forms``: separated forms: frozen data between the symbolic front end and code generation
- ``functions``: functions that SymPy does not know: of data, of the user, and of a whole function
  of time
- ``integration``: one trajectory of a problem, from event to event: a first check of any solution
- ``jumps``: jumps at known times: doses, kicks and restarts, also those written as ``DiracDelta``
  of time
- ``models``: models from files of other tools, as problems
- ``numeric``: the equations of a problem as functions of numbers, and the sides of its events'
  surfaces
- ``problem``: what the user wrote, validated once and immutable
- ``shorthand``: constants and definitions that a problem names, and what is often mistaken for an
  unknown
- ``steady_start``: constants that are run-time values, and starts at the steady state of other
  conditions
- ``text``: problems as text: formulas by name, turned into the expressions that the checks take
- ``toml_layout``: the tables of a TOML file: problems read from them and written to them
- ``user_events``: what happens where an expression of the states crosses zero
"""
