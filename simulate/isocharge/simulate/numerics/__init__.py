"""Numerical methods that do not depend on the physics of the film, such as interpolation and least squares."""
