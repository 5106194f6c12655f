"""Datasets of presses and charges: sampling plans, sweeps, and the file format."""
