"""Numerics without physics: interpolation, points of a disk, convex polygons, Gauss rules.

May import: nothing else of isocharge.simulate.
"""
