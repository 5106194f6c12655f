"""A virtual sensor made of the simulator's forward map and amplifier."""

from collections.abc import Callable
from functools import partial
from typing import Any

from isocharge.common.arrays import Array
from isocharge.serve import Script, VirtualSensor, wander
from isocharge.serve.virtual_sensor.sensor import Charges
from isocharge.simulate import Amplifier, ForwardMap, load_amplifier

SCRIPT_S = 60.0
"""Length of the random script that a virtual sensor repeats, s."""


def virtual_sensor(forward_map: ForwardMap, noise: str, seed: int, rate_Hz: float = 200.0) -> VirtualSensor:
    """A sensor that plays wandering presses over the whole domain of a forward map.

    Args:
        forward_map: Charges of the presses.
        noise: Level of the noise model.
        seed: Seed of presses, noise and offsets.
        rate_Hz: Frames per second.
    """
    charges, script = played(forward_map, seed, rate_Hz)
    return VirtualSensor(charges, script, noise=measuring(load_amplifier(noise), rate_Hz), seed=seed)


def played(forward_map: ForwardMap, seed: int, rate_Hz: float, script: Script | None = None) -> tuple[Charges, Script]:
    """What a virtual sensor plays: a map with its script, by default presses that wander over its whole domain."""
    domain = forward_map.domain
    presses = script or wander(
        seed=seed,
        seconds=SCRIPT_S,
        rate_Hz=rate_Hz,
        radius_mm=domain.radius,
        force_range_N=domain.force_range,
    )
    return partial(_charges, forward_map), presses


def _charges(forward_map: ForwardMap, contact: Array) -> Array:
    """Charges of contacts; below the map's smallest force they fall with force to the 2/3, as those of a membrane."""
    low, force = forward_map.domain.force_range[0], contact[:, 2]
    share = (force.clip(max=low) / low) ** (2.0 / 3.0)
    within = contact.copy()
    within[:, 2] = force.clip(min=low)
    return forward_map.charges(within) * share[:, None]


def measuring(amplifier: Amplifier, rate_Hz: float) -> Callable[..., Any]:
    """The amplifier as the virtual sensor calls it, in pC; it is switched on with the first block."""
    states: list[Any] = []

    def measure(charge_pC: Any, rng: Any) -> Any:
        if not states:
            states.append(amplifier.start(charge_pC.shape[1], rate_Hz, rng))
        return states[0](charge_pC)

    return measure
