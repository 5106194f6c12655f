"""Mechanics of the film in dimensionless form, and the choice of the theory that describes a film."""
