"""Models from files of other tools, as problems.

- ``elements``: all elements of an SBML model, read into SymPy: quantities, reactions, rules and
  events
- ``model``: a model that was read from a file: symbols, nominal values, and the problems made of
  it
- ``model_events``: the events of a model as the events of a problem, and the conditions that
  trigger them
- ``sbml``: SBML and Antimony files as models: their elements assembled to a system
- ``sbml_formulas``: SBML and Antimony documents, and their formulas as SymPy expressions
"""
