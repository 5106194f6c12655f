"""Shapes of the footprint of a probe, with one module for each shape and one module for the base classes."""
