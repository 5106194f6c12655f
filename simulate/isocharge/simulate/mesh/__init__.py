"""Meshes of presses, positions of the elements on the film, and refinement along the edges of a coat."""
