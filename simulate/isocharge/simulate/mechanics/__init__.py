"""Mechanics of the film in dimensionless form: energy, stress, scaling, temperature and the choice of the theory."""
