"""Numerical methods without physics: interpolation, points on a disk, polygons, least squares, Gauss rules."""
