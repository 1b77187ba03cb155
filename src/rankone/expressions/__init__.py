"""SymPy expressions, whatever the problem: numbers, parsing, stable forms, decimals."""
