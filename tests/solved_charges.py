"""Charges of presses that are solved one by one, films that differ from those of sensors, and relative errors."""

from dataclasses import replace

import numpy as np

from isocharge.simulate import press, touch_charge


def with_film(sensor, **changes):
    """Return a sensor whose film has other values in some attributes."""
    return replace(sensor, film=replace(sensor.film, **changes))


def with_piezo(sensor, **changes):
    """Return a sensor with other values of some piezoelectric coefficients, pC/N."""
    return replace(sensor, piezo=replace(sensor.piezo, **changes))


def solved_charge(sensor, probe, at, force, *settings, **options):
    """Solve a press, and return the touch charges, shape (n_electrode,), pC. See `press` for settings and options."""
    return touch_charge(sensor, press(sensor.film, probe, at, force, *settings, **options))


def relative_error(values, exact):
    """Return the largest difference of values from exact values, relative to the largest exact value."""
    return float(np.abs(values - exact).max() / np.abs(exact).max())
