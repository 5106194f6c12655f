"""Training data for films that cannot be calibrated, from a simulation that is corrected by measured presses."""
