"""A virtual sensor that uses the forward map and the amplifier of the simulation."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.defaults import DEFAULT_PLAYED_FORCE_RANGE
from isocharge.serve import Script, VirtualSensor, wander
from isocharge.serve.virtual_sensor.sensor import Charges
from isocharge.simulate import Amplifier, FilmSlopes, ForwardMap, load_amplifier

SCRIPT_S = 60.0
"""Length of the random script that a virtual sensor repeats, s."""


def virtual_sensor(forward_map: ForwardMap, noise: str, seed: int, rate_Hz: float = 200.0) -> VirtualSensor:
    """Return a virtual sensor that plays random presses over the whole area of a forward map.

    Args:
        forward_map: Charges of the presses.
        noise: Name of the amplifier, such as `reference`.
        seed: Seed of presses, noise and offsets.
        rate_Hz: Frames per second, Hz.
    """
    _min_force_N, max_force_N = DEFAULT_PLAYED_FORCE_RANGE
    script = random_script(forward_map, seed, rate_Hz, max_force_N)
    measure = measure_function(load_amplifier(noise), len(forward_map.electrodes), rate_Hz, seed)
    return VirtualSensor(film_charges(forward_map), script, noise=measure, seed=seed)


def random_script(forward_map: ForwardMap, seed: int, rate_Hz: float, max_force_N: float) -> Script:
    """Return a script of presses that wander over the whole area of a forward map.

    Args:
        forward_map: Forward map. The presses stay within its area and its range of forces.
        seed: Seed of the presses.
        rate_Hz: Frames per second, Hz.
        max_force_N: Largest force, N. It is reduced to the largest force of the forward map if necessary.
    """
    domain = forward_map.domain
    min_map_force_N, max_map_force_N = domain.force_range
    max_played_force_N = min(max_map_force_N, max_force_N)
    min_played_force_N = min(min_map_force_N, max_played_force_N)
    return wander(
        seed=seed,
        seconds=SCRIPT_S,
        rate_Hz=rate_Hz,
        radius_mm=domain.radius,
        force_range_N=(min_played_force_N, max_played_force_N),
    )


def film_charges(forward_map: ForwardMap) -> Charges:
    """Return the function that computes charges, shape (n, electrodes), pC, from contacts, shape (n, 3), mm and N.

    Below the smallest force of the forward map, the charges of a contact are proportional to F^(2/3), as on a membrane.
    """
    return partial(_charges, forward_map.charges, forward_map.domain.force_range[0])


def film_charges_per_K(forward_map: ForwardMap) -> Charges | None:
    """Return the function that computes the change of the touch charges per kelvin of warming, pC/K.

    The result is None if the temperature of the film does not change its pretension. If the temperature changes the
    pretension, further presses are simulated in order to determine the effect.

    Args:
        forward_map: Charges of the presses.

    Raises:
        SceneError: If the probe of the forward map is not circular.
    """
    if forward_map.sensor.film.expansion is None:
        return None
    film_slopes = FilmSlopes.build(forward_map)
    return partial(_charges, film_slopes.temperature_jacobian, forward_map.domain.force_range[0])


def _charges(map_charges: Callable[[Array], Array], min_force_N: float, contact: Array) -> Array:
    """Compute the charges of contacts, including contacts below the smallest force of the forward map.

    Below this smallest force F_min, the charges at F_min are multiplied by (F / F_min)^(2/3), as on a membrane.

    Args:
        map_charges: Function from contacts in the domain of the forward map to charges.
        min_force_N: Smallest force of the forward map, N.
        contact: Contacts (x, y, force), shape (n, 3), mm and N.

    Returns:
        Charges, shape (n, electrodes), pC.
    """
    force_N = contact[:, 2]
    relative_force = force_N.clip(max=min_force_N) / min_force_N  # 1 for forces in the domain, otherwise below 1
    charge_factor = relative_force ** (2.0 / 3.0)
    contact_in_domain = contact.copy()
    contact_in_domain[:, 2] = force_N.clip(min=min_force_N)
    return map_charges(contact_in_domain) * charge_factor[:, None]


def measure_function(amplifier: Amplifier, electrode_count: int, rate_Hz: float, seed: int) -> Callable[..., Any]:
    """Return the amplifier as the function that the virtual sensor calls to measure charges.

    Args:
        amplifier: The amplifier.
        electrode_count: Number of electrodes.
        rate_Hz: Frames per second, Hz.
        seed: Seed of the drift and the noise, which continue from call to call.

    Returns:
        Function that converts the charges of the next n frames, shape (n, electrodes), pC, to measured charges of the
        same shape. Its second argument is not used. The optional third argument is the change of the charges per kelvin
        of the film.
    """
    measurement = amplifier.start(electrode_count, rate_Hz, np.random.default_rng(seed))
    return lambda charge_pC, _rng, charge_pC_per_K=None: measurement(charge_pC, charge_pC_per_K)
