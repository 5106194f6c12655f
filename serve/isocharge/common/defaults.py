"""Default values that several packages share, such as the range of the presses in a sweep and the largest batch.

This module imports no other module. The help texts of the commands can therefore show the defaults without delay.
"""

DEFAULT_RADIUS = 8.0
"""Largest distance of a press from the film's centre, mm.

The electrodes of most built-in sensors begin farther out, at about 10 mm.
"""

DEFAULT_FORCE_RANGE = (0.05, 2.0)
"""Smallest and largest force, N. The released models cover this range."""

DEFAULT_PLAYED_FORCE_RANGE = (0.05, 0.8)
"""Smallest and largest force of the random presses of a virtual sensor, N. A probe of 1 mm radius stresses the film of
the built-in sensors to the yield point of PVDF at 0.87 N."""

DEFAULT_STRESS_LIMIT = 45.0
"""Largest stress of a film under a probe, MPa. Drawn PVDF yields at 45 to 55 MPa."""

MAX_BATCH = 4096
"""Largest number of presses in one request or in a batch of Triton. The graph of a model has no such limit."""

FEW_ELECTRODES = 4
"""Largest number of electrodes for which a small training set and a small network are sufficient. With more electrodes,
working areas are mostly larger, and the charges have more dimensions.
"""
