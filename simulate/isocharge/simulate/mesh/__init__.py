"""Mesh of a press: its elements, the conformal map that places them on the film, and its refinement along coats."""
