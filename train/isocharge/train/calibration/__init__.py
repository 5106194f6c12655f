"""Calibration of a film: its parameters from a few presses, which of them the presses identify, and its model."""
