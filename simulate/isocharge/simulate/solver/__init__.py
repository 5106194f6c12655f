"""Solver of presses: choice of the mesh, assembly, Newton's method, and estimates of the error."""
