"""The disk and the forces that forward maps, datasets and scripts cover unless they are given others."""

DEFAULT_RADIUS = 8e-3
"""Largest distance of a press from the film's centre, m: the electrodes of the built-in sensors, 10 mm from the centre,
begin about there."""

DEFAULT_FORCE_RANGE = (0.05, 2.0)
"""Smallest and largest force, N. The released models cover it."""
