"""Probe shapes: one module for each shape, with the base classes that every shape implements."""
