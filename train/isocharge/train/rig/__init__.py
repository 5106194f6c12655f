"""Training data from the simulation of a sensor that measured presses correct, for films that cannot be calibrated."""
