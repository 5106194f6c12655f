"""Presses measured on a rig, to a model of the film under it: calibrated physics and a smooth correction.

May import: calibration, films, release, training, data.
"""
