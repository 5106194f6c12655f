"""Training data of a network: presses, series that are fitted to their charges, and examples for the misfit network."""
