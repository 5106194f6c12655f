"""Sensor of the demo, and the area of the film in which the presses of the demo lie."""

import numpy as np

from isocharge.common.defaults import DEFAULT_RADIUS
from isocharge.common.errors import ModelError
from isocharge.serve import find_model, load_model

DEFAULT_SENSOR = "three-25um-biaxial"
"""Name of the sensor of the demo, and of its released model."""


def played_radius_mm(sensor: str) -> float:
    """Return the largest distance of a press of the demo from the centre of the film, mm.

    If there is a released model with the name of the sensor, the distance is the radius of the working area of this
    model. Otherwise, the distance is `DEFAULT_RADIUS`.

    Args:
        sensor: Name of the sensor.
    """
    try:
        model = load_model(find_model(sensor))
    except ModelError:
        return DEFAULT_RADIUS

    corners_mm = np.array(model.metadata.working_area_mm)  # shape (n, 2), around the centre of the film
    return round(float(np.hypot(*corners_mm.T).min()), 2)
