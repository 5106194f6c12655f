"""A virtual sensor that uses the forward map and the amplifier of the simulation."""

import numpy as np
import scipy.signal  # noqa: F401 - if the first reading imported it, the first frames would come seconds late

from isocharge.common.arrays import Array
from isocharge.common.defaults import DEFAULT_PLAYED_FORCE_RANGE
from isocharge.serve import Script, VirtualSensor, wander
from isocharge.serve.virtual_sensor.sensor import Charges, Noise
from isocharge.simulate import Amplifier, ForwardMap, load_amplifier

PRESSES_S = 60.0
"""Duration of the random presses that a virtual sensor repeats, s."""


def virtual_sensor(forward_map: ForwardMap) -> VirtualSensor:
    """Return the virtual sensor of the demos, which plays random presses over the whole area of a forward map."""
    rate_Hz = 200.0
    _min_force_N, max_force_N = DEFAULT_PLAYED_FORCE_RANGE  # the smallest force is that of the forward map
    script = random_script(forward_map, rate_Hz, max_force_N)
    # The amplifier adds its drift and its noise to the charges, so the virtual sensor uses it as its noise.
    measure = measure_function(load_amplifier("reference"), len(forward_map.electrodes), rate_Hz)
    return VirtualSensor(film_charges(forward_map), script, noise=measure)


def random_script(forward_map: ForwardMap, rate_Hz: float, max_force_N: float, rest_s: float = 1.0) -> Script:
    """Return a script of presses that wander over the whole area of a forward map.

    Args:
        forward_map: Forward map. The presses stay within its area and its range of forces.
        rate_Hz: Frames per second, Hz.
        max_force_N: Largest force, N. If necessary, this force is reduced to the largest force of the forward map.
        rest_s: Time before the first press, s.
    """
    min_force_N, max_map_force_N = forward_map.domain.force_range
    return wander(
        seed=0,
        seconds=rest_s + PRESSES_S,
        rest_s=rest_s,
        rate_Hz=rate_Hz,
        radius_mm=forward_map.domain.radius,
        force_range_N=(min_force_N, min(max_map_force_N, max_force_N)),
    )


def film_charges(forward_map: ForwardMap) -> Charges:
    """Return the function that computes charges, shape (n, electrodes), pC, from contacts, shape (n, 3), mm and N.

    Below the smallest force F_min of the forward map, the charges at F_min are multiplied by (F / F_min)^(2/3), as on a
    membrane.
    """
    min_force_N = forward_map.domain.force_range[0]

    def charges(contact: Array) -> Array:
        """Compute the charges of contacts with the forward map. Forces below the smallest force of the map are allowed.

        For such a force F, the charges at the smallest force F_min are multiplied by (F / F_min)^(2/3), because the
        charge of a membrane without pretension is proportional to F^(2/3).

        Args:
            contact: Positions and forces (x, y, F), shape (n, 3), mm and N.

        Returns:
            Charges, shape (n, electrodes), pC.
        """
        x_mm, y_mm, force_N = contact.T
        map_force_N = force_N.clip(min=min_force_N)
        map_charge_pC = forward_map.charges(np.column_stack([x_mm, y_mm, map_force_N]))
        force_ratio = (force_N / map_force_N)[:, None]  # F / F_min below the smallest force, otherwise 1
        return np.asarray(map_charge_pC * force_ratio ** (2.0 / 3.0))

    return charges


def measure_function(amplifier: Amplifier, electrode_count: int, rate_Hz: float) -> Noise:
    """Return the amplifier as the function that the virtual sensor calls to measure charges.

    The drift and the noise continue from call to call.

    Args:
        amplifier: The amplifier.
        electrode_count: Number of electrodes.
        rate_Hz: Frames per second, Hz.
    """
    measurement = amplifier.start(electrode_count, rate_Hz, np.random.default_rng(0))
    return lambda charge_pC, _rng: measurement(charge_pC)
