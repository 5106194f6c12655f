"""Meshes of presses, and positions of the elements on the film."""
