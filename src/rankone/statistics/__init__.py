"""Statistics of a solution over its box: every integral is a product of one-dimensional ones."""
