"""Parameters from data, posterior distributions and best values, on a solved problem."""
