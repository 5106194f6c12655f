"""From presses to charges, fast: the readout, the forward map from few solves, and its spline table."""
