"""A solution: evaluation, smaller solutions, tables with labels, summaries."""
