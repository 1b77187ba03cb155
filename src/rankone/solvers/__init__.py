"""Engines: what separates the solution over the box, and how one is chosen and run."""
