"""Presses measured on a rig, to training data of the film under it: calibrated physics and a smooth correction."""
