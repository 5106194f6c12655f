"""Training data of a network: presses, the series fitted to their charges, and examples of misfit."""
