"""Datasets of simulated presses: sampling of the presses, simulation of their charges, and the file format."""
