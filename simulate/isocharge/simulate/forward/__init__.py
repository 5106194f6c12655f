"""Fast computation of charges from presses: readout, forward map from few solves, and splines of a forward map."""
