"""What users write, validated: problems in SymPy, text, or files, also those of other tools.

In come equations, parameters with their intervals, initial values and events; out goes a
:class:`~rankone.problem.problem.Problem`, checked and immutable.

- ``algebra``: equations that are not rates: algebraic ones, mass matrices, and what they
  determine
- ``expressions``: single SymPy expressions, whatever problem they belong to
- ``models``: models from files of other tools, as problems
- ``tables``: rates of many states as tables of terms, from which no expression has to be written
- ``box``: the coordinates of a problem: the time interval, the box of the parameters, and its
  pieces
- ``changes``: constants that are run-time values, and other problems from one by other numbers
- ``checked``: the checks of a problem's arguments, and all that follows from them
- ``content``: what a checked problem holds: its box, how it is shown, and when two problems are
  equal
- ``crossings``: on which sides of its events' surfaces a trajectory is, and where it crosses them
- ``equations``: the equations of a problem and the initial values of its states
- ``forms``: separated forms: frozen data between the symbolic front end and code generation
- ``functions``: functions that SymPy does not know: of data, of the user, and of a whole function
  of time
- ``integration``: the integration of one trajectory, from event to event and from one known time
  to the next
- ``jumps``: jumps at known times: doses, kicks and restarts, also those written as ``DiracDelta``
  of time
- ``numeric``: the equations of a problem as functions of numbers, made from them as the user
  wrote them
- ``problem``: what the user wrote, validated once and immutable
- ``problem_files``: problems from files: Python files with a variable ``problem``, and TOML files
- ``shorthand``: constants and definitions that a problem names, and what is often mistaken for an
  unknown
- ``steady_start``: starts at the steady state of other conditions: a system that has come to rest
  is disturbed
- ``text``: problems as text: formulas by name, turned into the expressions that the checks take
- ``toml_layout``: the tables of a TOML file: problems read from them and written to them
- ``trajectory``: one ordinary trajectory of a problem, integrated by SciPy: a first check of any
  solution
- ``user_events``: what happens where an expression of the states crosses zero
- ``user_markers``: markers that users give: expressions that end stretches of time where they
  cross zero
"""
