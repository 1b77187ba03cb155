"""What users write: problems in SymPy or text, and problem files; validated here."""
