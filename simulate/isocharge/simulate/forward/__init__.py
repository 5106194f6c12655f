"""Fast computation of the charges of presses: readout, forward maps from a few solves, and splines of these maps."""
