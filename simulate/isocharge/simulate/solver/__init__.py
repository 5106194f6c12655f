"""Computation of the equilibrium of a film under a probe, and estimates of the errors of the computed charges."""
