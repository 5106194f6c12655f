"""Solver of presses, which computes the equilibrium of the film under a probe and estimates its error."""
