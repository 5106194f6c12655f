"""Pictures of a film, to scale, in mm and pC. The only package, besides paper, that imports matplotlib.

May import: layout, contours, identifiability, forward, solver, sensor.
"""
