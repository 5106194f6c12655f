"""Fast computation of the charges of many presses, by interpolation between a few solved presses."""
