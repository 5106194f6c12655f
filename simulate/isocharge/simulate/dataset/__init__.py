"""Datasets of presses: sampling, simulation of a sweep, and the file format."""
