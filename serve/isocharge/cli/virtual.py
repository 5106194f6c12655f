"""A virtual sensor made of the simulator's forward map and noise: serve's pC, mm and N on one side, SI on the other."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from isocharge.serve import VirtualSensor
    from isocharge.simulate import ForwardMap

SCRIPT_S = 60.0
"""Length of what a virtual sensor plays before it begins again, s."""


def virtual_sensor(film: "ForwardMap", noise: str, seed: int, rate_Hz: float = 200.0) -> "VirtualSensor":
    """A sensor that plays wandering presses over the whole domain of a forward map.

    Args:
        film: The forward map.
        noise: Level of the noise model.
        seed: Of presses, noise and offsets.
        rate_Hz: Frames per second.
    """
    from isocharge.serve import VirtualSensor, wander
    from isocharge.simulate import noise_model

    amplifier = noise_model(noise)
    return VirtualSensor(
        lambda x_mm, y_mm, force_N: film.forward(x_mm * 1e-3, y_mm * 1e-3, force_N) * 1e12,
        wander(
            seed=seed,
            seconds=SCRIPT_S,
            rate_Hz=rate_Hz,
            radius_mm=film.radius * 1e3,
            force_range_N=film.force_range,
        ),
        noise=lambda charge_pC, rng: amplifier.add(charge_pC * 1e-12, rng) * 1e12,
        seed=seed,
    )
