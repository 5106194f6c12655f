"""Meshes of presses: their elements, the positions of the elements on the film, and the refinement along coats."""
