"""Calibration of a film: estimates of its parameters from a few presses, and a model of this film."""
