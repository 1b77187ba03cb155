"""Models from files of other tools, as problems.

======================  ============================================================================
:mod:`~.document`       opens a file, puts submodels into one model, raises earlier levels
:mod:`~.mathml`         formulas as SymPy expressions
:mod:`~.quantities`     compartments, species, parameters, stoichiometries
:mod:`~.reactions`      rates of reactions and what they change
:mod:`~.rules`          rules and initial assignments
:mod:`~.happenings`     events as the file has them
:mod:`~.algebraic`      algebraic rules: solved, or left as equations
:mod:`~.definitions`    symbols that stand for expressions: their order, expansion, rates
:mod:`~.elements`       all of these
:mod:`~.assembly`       states and their rates, definitions, initial values, numbers
:mod:`~.units`          units as texts
:mod:`~.model`          :class:`Model`, which makes problems
:mod:`~.triggers`       conditions as what crosses zero
:mod:`~.model_events`   the events of a model as those of a problem
:mod:`~.sbml`           :func:`rankone.read_sbml`
======================  ============================================================================
"""
