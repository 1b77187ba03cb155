"""Statistics of a solution over its box: every integral is a product of one-dimensional ones.

=======================  ===========================================================================
``distributions``        distributions of one parameter: scipy.stats, text, quadrature
``joint_distribution``   all parameters together, joined by a Gaussian copula
``moments``              means, variances and sensitivities of one train
``higher_moments``       third and fourth moments of one train
``replicates``           points in sets whose spread is the error of what they say
``densities``            densities and probabilities, from such points
``solution_statistics``  statistics of states at given times, and how certain they are
``over_box``             the methods of a solution
``timeline_statistics``  those of solutions with events, which jump over the parameters
``piece_statistics``     those of solutions that were joined of pieces
``line_averages``        averages along lines through the box, more and more until they settle
``closed_lines``         quadrature for functions that jump across surfaces
=======================  ===========================================================================
"""
