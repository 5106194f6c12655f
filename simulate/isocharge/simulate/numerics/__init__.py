"""Numerical methods that do not depend on the physics of the film: interpolation, polygons, and points in a disk."""
