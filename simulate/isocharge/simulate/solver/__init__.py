"""From a press to its equilibrium: choice of mesh, assembly, Newton's method, estimates of the error."""
