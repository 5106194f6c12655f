"""From a press to its equilibrium: choice of mesh, assembly, Newton's method, estimates of the error.

May import: mechanics, mesh, sensor, execution, numerics.
"""
