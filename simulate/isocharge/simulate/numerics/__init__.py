"""Numerics without physics: interpolation, points of a disk, convex polygons, Gauss rules."""
