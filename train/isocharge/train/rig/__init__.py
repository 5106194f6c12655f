"""Training data from a described sensor that is corrected by measured presses, for films that cannot be calibrated."""
