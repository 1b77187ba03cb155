"""Frozen data that pass between the front end, code generation, engines and solutions."""
