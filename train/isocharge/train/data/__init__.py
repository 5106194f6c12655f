"""What a network learns from: presses, the series fitted to their charges, examples of misfit."""
