"""Functions of many coordinates in separated form.

In come values of functions at points of a box; out go tensor trains and sums of products, which
are evaluated anywhere in it. Numbers alone: this room knows neither problems nor SymPy.

- ``bases``: one-dimensional discretisations of parameters and of time
- ``trains``: tensors: trains and sums of products, their arithmetic, cross interpolation and
  evaluation
"""
