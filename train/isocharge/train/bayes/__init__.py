"""Computation of the Bayes limit by integration of the posterior of a contact."""
