"""Change of the pretension with the temperatures of the film and of its ring.

A film that is clamped in a ring cannot expand. If the film becomes warmer by dT and its ring by dR, the elastic strain
along each axis of the film changes by

    strain_i = ring_expansion * dR - expansion_i * dT,

and the pretension changes by the stress of this strain, with the plane-stress stiffness of the film. A drawn film
expands more across the drawn direction than along this direction, so its tension becomes uneven. The temperature of a
thin film follows that of the air within seconds. The temperature of a ring needs many minutes to follow.
"""

from dataclasses import replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.mechanics.scaling import orthotropic_moduli
from isocharge.simulate.mechanics.stress import rotate_stress, stress
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.sensor import Sensor


def tension_change(film: Film, film_K: float, ring_K: float) -> Array:
    """Compute the change of the pretension that changes of the temperatures of film and ring cause.

    The strain of the clamped film is the expansion of the ring minus the free expansion of the film. Its stress is the
    change of the pretension.

    Args:
        film: The film. If it has no expansion coefficients, the result is zero.
        film_K: Change of the temperature of the film, K.
        ring_K: Change of the temperature of the ring, K.

    Returns:
        (T11, T22, T12) along x and y, shape (3,), MPa.
    """
    if film.expansion is None:
        return np.zeros(3)
    expansion_1, expansion_2 = film.expansion
    ring_strain = film.ring_expansion * ring_K
    strain = np.array([ring_strain - expansion_1 * film_K, ring_strain - expansion_2 * film_K, 0.0])
    change_in_film_axes = film.young * stress(strain, film.poisson, orthotropic_moduli(film))
    return rotate_stress(change_in_film_axes, film.axis)


def warmed(sensor: Sensor, film_K: float, ring_K: float = 0.0) -> Sensor:
    """Return a copy of the sensor with the pretension at other temperatures of the film and of its ring.

    Args:
        sensor: The sensor at the temperatures for which it is described.
        film_K: Temperature of the film minus the temperature for which the film is described, K.
        ring_K: Temperature of the ring minus the temperature for which the ring is described, K.

    Raises:
        SensorError: If the film becomes so slack that it is outside the range of the simulator.
    """
    film = sensor.film
    if film.expansion is None:
        return sensor
    change_11, change_22, change_12 = tension_change(film, film_K, ring_K).tolist()
    pretension = film.pretension + 0.5 * (change_11 + change_22)  # mean along x and y
    if film.expands_evenly:  # only the mean of the tension changes
        return replace(sensor, film=replace(film, pretension=pretension))

    # The deviator of the tension consists of half of its difference along x and y, and of its shear.
    half_difference, shear = film.deviator
    warm_half_difference = half_difference + 0.5 * (change_11 - change_22)
    warm_shear = shear + change_12
    return replace(sensor, film=replace(film, pretension=pretension, deviator=(warm_half_difference, warm_shear)))
