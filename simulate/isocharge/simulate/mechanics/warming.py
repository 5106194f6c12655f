"""Change of the pretension that the temperatures of a film and its ring cause.

A film that is clamped in a ring cannot expand freely. If the film becomes warmer by dT and the ring by dR, the elastic
strain along axis i of the film changes by

    strain_i = ring_expansion * dR - expansion_i * dT.

The change of the pretension is the stress that the change of the strain causes. The stress follows from the
plane-stress stiffness of the film. A drawn film expands more across the drawn direction than along the drawn direction.
The tension of a drawn film therefore becomes uneven. The temperature of a thin film follows the temperature of the air
within seconds. The ring needs many minutes to reach the temperature of the air.
"""

from dataclasses import replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.mechanics.theory import elasticity, rotate_stress
from isocharge.simulate.sensor.film import FILM_NUMBERS, Film
from isocharge.simulate.sensor.sensor import Sensor


def tension_change(film: Film, film_warming_K: float, ring_warming_K: float) -> Array:
    """Compute by how much the pretension changes if the temperatures of the film and of its ring change.

    The elastic strain of the clamped film is the expansion of the ring minus the free expansion of the film. The change
    of the pretension is the stress that corresponds to the elastic strain.

    Args:
        film: The film. If the film has no expansion coefficients, the result is zero.
        film_warming_K: Increase of the temperature of the film, K.
        ring_warming_K: Increase of the temperature of the ring, K.

    Returns:
        Change of the pretension (T11, T22, T12) in the axes x and y, shape (3,), MPa.
    """
    if film.expansion is None:
        return np.zeros(3)
    free_strain = np.array(film.expansion) * film_warming_K  # along the axes 1 and 2 of the film
    ring_strain = film.ring_expansion * ring_warming_K
    elastic_strain = np.append(ring_strain - free_strain, 0.0)  # (E11, E22, 2 E12) in the axes of the film
    # `elasticity` returns the stiffness matrix, divided by Young's modulus, in the axes at a given angle from the x
    # axis. These are the axes of the film here. The sum of products is the matrix times the strain. A matrix product
    # may round the stresses along both axes differently, and an isotropic film would then not remain axisymmetric.
    change_in_film_axes = film.young * (elastic_strain * elasticity(film, film.axis)).sum(axis=1)
    return rotate_stress(change_in_film_axes, film.axis)  # from the axes of the film into the axes x and y


MAX_WARMING_K = 150.0
"""Largest accepted change of the temperature, K. PVDF is used from about -40 to 110 degrees Celsius."""


def warming_limits(film: Film) -> tuple[float, float]:
    """Return the smallest and the largest accepted change of the temperature of a film, K.

    If the film has expansion coefficients, its mean pretension must remain in the accepted range.
    """
    # The mean pretension is the mean of T11 and T22.
    change_per_K = tension_change(film, film_warming_K=1.0, ring_warming_K=0.0)[:2].mean()  # MPa/K
    if change_per_K == 0.0:
        return -MAX_WARMING_K, MAX_WARMING_K
    pretension_range = FILM_NUMBERS["pretension"]
    changes = np.array([pretension_range.smallest, pretension_range.largest]) - film.pretension
    # If a warmer film has less pretension, the smallest pretension belongs to the largest warming.
    low, high = np.clip(np.sort(changes / change_per_K), -MAX_WARMING_K, MAX_WARMING_K).tolist()
    return low, high


def warmed(sensor: Sensor, film_warming_K: float, ring_warming_K: float = 0.0) -> Sensor:
    """Return a copy of a sensor with the pretension that results from other temperatures of the film and the ring.

    Args:
        sensor: The sensor at the temperatures for which it is described.
        film_warming_K: Temperature of the film minus the temperature for which the film is described, K.
        ring_warming_K: Temperature of the ring minus the temperature for which the ring is described, K.

    Returns:
        The copy, which equals the sensor if the film has no expansion coefficients.

    Raises:
        SensorError: If the film becomes too slack for the simulator.
    """
    film = sensor.film
    change_11, change_22, change_12 = tension_change(film, film_warming_K, ring_warming_K).tolist()
    pretension = film.pretension + 0.5 * (change_11 + change_22)  # the mean of T11 and T22
    half_difference, shear = film.deviator  # (T11 - T22) / 2 and T12
    deviator = (half_difference + 0.5 * (change_11 - change_22), shear + change_12)
    return replace(sensor, film=replace(film, pretension=pretension, deviator=deviator))
