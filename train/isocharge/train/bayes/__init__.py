"""Computation of the Bayes limit, the smallest mean squared error that any estimator of contacts can reach."""
