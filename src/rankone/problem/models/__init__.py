"""Models from files of other tools, as problems.

- ``assembly``: the elements of an SBML model as a system: states and their rates, definitions,
  numbers
- ``document``: open an SBML or Antimony file: one flat model of Level 3, or an error that says
  why not
- ``elements``: all elements of an SBML model, read into SymPy: definitions, rules and events
- ``model``: a model that was read from a file: symbols, nominal values, and the problems made of
  it
- ``model_events``: the events of a model as the events of a problem, and the conditions that
  trigger them
- ``sbml``: SBML and Antimony files as models, and the units they declare
- ``sbml_formulas``: formulas of SBML as SymPy expressions
- ``species``: the quantities of an SBML model and the reactions that change them
"""
