"""Calibration of a film: estimation of its parameters from a few presses, and a model of the calibrated film."""
