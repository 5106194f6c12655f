"""Training data from presses on a sensor whose film cannot be calibrated: the sensor as described, corrected."""
