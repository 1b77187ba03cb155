"""Commands of the command line: one module each, which adds its parser and runs."""
