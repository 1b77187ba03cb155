"""Parameters from data, posterior distributions, designs and best values: methods of a solution.

- ``cube_distributions``: distributions in a unit cube: on cells that are halved, or as points of
  a Markov chain
- ``design``: where to measure next: sampling times that tell the most about the parameters
- ``estimates``: results with tables and a verdict; best values of a fit, and its residuals
- ``experiments``: what was measured under which conditions, checked against a solution
- ``fit``: best values, intervals, what the data identify, and reasons not to trust it
- ``fitted_models``: models at the times of data, solved or integrated, with derivatives
- ``formulas``: arithmetic of named quantities with derivatives, from text or symbols
- ``free_parameters``: the free parameters, their bounds and scales, and the start of a search
- ``identification``: which parameters, and which combinations of them, the data identify, by
  profile likelihoods; where predictions jump inside intervals
- ``intervals``: how sure the estimates of a fit are: covariance, intervals, profiles, fitted
  curves
- ``least_squares``: minima of -2 log L in a unit cube, from many starts at once or one by one
- ``likelihood``: the likelihood of all measurements as a function of the free parameters, and the
  ranges of those that belong to no solution
- ``minimize``: the best parameters of a box: least or largest values of unknowns, with
  constraints
- ``noise``: noise of measurements: its distribution, its standard deviation, and what a datum
  adds to a fit
- ``observations``: measured data at times, checked and put in a row, and what was measured
- ``posterior``: posterior distributions of parameters: by quadrature, or by a Markov chain beyond
  three
- ``search``: parameters of solutions from data, by least squares or maximum likelihood
- ``tables``: tables of measurements and doses: columns by name, cut into their experiments
"""
