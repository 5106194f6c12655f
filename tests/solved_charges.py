"""Charges of presses that are solved one by one, films that differ from those of sensors, and relative errors."""

from dataclasses import replace

import numpy as np

from isocharge.simulate import Electrode, SolveSettings, press, touch_charge


def with_film(sensor, **changes):
    """Return a sensor whose film has other values in some attributes."""
    return replace(sensor, film=replace(sensor.film, **changes))


def with_piezo(sensor, **changes):
    """Return a sensor with other values of some piezoelectric coefficients, pC/N."""
    return replace(sensor, piezo=replace(sensor.piezo, **changes))


def with_squares(sensor, *places):
    """Return a sensor with square electrodes of 3 mm at positions (x, y), mm."""
    squares = (Electrode.of_square(name, place, 3.0) for name, place in zip("ABCDEFGH", places, strict=False))
    return replace(sensor, electrodes=tuple(squares))


def solved_charge(sensor, probe, at, force, *settings, **options):
    """Solve a press, and return the touch charges, shape (n_electrode,), pC. See `press` for settings and options."""
    return touch_charge(sensor, press(sensor.film, probe, at, force, *settings, **options))


def solved_charges(sensor, probe, contact, settings=SolveSettings(), rotation=0.0):
    """Solve presses one by one, and return the touch charges, shape (n, n_electrode), pC.

    Args:
        sensor: The sensor.
        probe: The probe.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        settings: Settings of `press`.
        rotation: Rotations of the probe, shape () or (n,), rad.
    """
    rotations = np.broadcast_to(rotation, len(contact)).tolist()
    return np.array(
        [
            solved_charge(sensor, probe.rotated(angle), (x, y), force, settings)
            for (x, y, force), angle in zip(contact.tolist(), rotations, strict=True)
        ]
    )


def relative_error(values, exact):
    """Return the largest difference of values from exact values, relative to the largest exact value."""
    return float(np.abs(values - exact).max() / np.abs(exact).max())
