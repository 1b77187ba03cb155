"""Enclosures: what samples on a piece of a trajectory show of a function, and what they may hide.

A generated function is evaluated on an enclosure in place of arrays, by the same text. Sums and
products of what samples show hide nothing, however large they are. A function of one argument may
hide something where that varies by more than the function's own scale, or across its singularity;
then the range of the function bounds it. The same holds for powers of powers, whose degree is
carried along. So a peak of width 1e-9 shows by its height, wherever it is, and stiff differences of
large numbers do not.



- ``bounds``: ranges of values, bounds of functions over them, and zeros that quotients share
- ``enclosure``: enclosures and their arithmetic; conditions over them
- ``generated``: generated functions, functions of NumPy and sampled functions, run on enclosures
"""
