"""A virtual sensor made of the simulator's forward map and amplifier."""

from collections.abc import Callable
from functools import partial
from typing import Any

from isocharge.common.arrays import Array
from isocharge.serve import Script, VirtualSensor, wander
from isocharge.simulate import Amplifier, ForwardMap, load_amplifier

SCRIPT_S = 60.0
"""Length of the random script that a virtual sensor repeats, s."""


def virtual_sensor(
    forward_map: ForwardMap,
    noise: str | Amplifier,
    seed: int,
    rate_Hz: float = 200.0,
    *,
    script: Script | None = None,
    **options: Any,
) -> VirtualSensor:
    """A sensor that plays wandering presses over the whole domain of a forward map.

    Args:
        forward_map: Charges of the presses.
        noise: Level of the noise model, or an amplifier.
        seed: Seed of presses, noise and offsets.
        rate_Hz: Frames per second.
        script: Presses to play instead of random ones.
        options: Options of `VirtualSensor`: encode, faults, link.
    """
    amplifier = load_amplifier(noise) if isinstance(noise, str) else noise
    presses = script or wander(
        seed=seed,
        seconds=SCRIPT_S,
        rate_Hz=rate_Hz,
        radius_mm=forward_map.domain.radius,
        force_range_N=forward_map.domain.force_range,
    )
    return VirtualSensor(
        partial(_charges, forward_map),
        presses,
        noise=_measuring(amplifier, rate_Hz),
        seed=seed,
        **options,
    )


def _charges(forward_map: ForwardMap, contact: Array) -> Array:
    """Charges of contacts; below the map's smallest force they fall with force to the 2/3, as those of a membrane."""
    low, force = forward_map.domain.force_range[0], contact[:, 2]
    share = (force.clip(max=low) / low) ** (2.0 / 3.0)
    within = contact.copy()
    within[:, 2] = force.clip(min=low)
    return forward_map.charges(within) * share[:, None]


def _measuring(amplifier: "Amplifier", rate_Hz: float) -> Callable[..., Any]:
    """The amplifier as the virtual sensor calls it, in pC; it is switched on with the first block."""
    states: list[Any] = []

    def measure(charge_pC: Any, rng: Any) -> Any:
        if not states:
            states.append(amplifier.start(charge_pC.shape[1], rate_Hz, rng))
        return states[0](charge_pC)

    return measure
