"""Train a network for sensors drawn at random, and compare its errors with the Bayes limit of each sensor.

    python tests/benchmarks/bench_random_sensors.py [--sensors 20]

A sensor has three to eight electrodes on one or two rings, a film of 5 to 200 um with a pretension of up to 2 MPa, and
a round probe with a radius of 1 to 12 mm. Each network is trained with the default configuration on simulated presses
of 0.05 to 2 N within 8 mm, or within the fold of the map. Errors are measured on fresh presses with `reference` noise,
for which the limit is computed, too. A sensor that is refused is listed with the reason.
One sensor needs about a minute of CPU time.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from shared import LimitedPresses, arguments, print_results

from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import IsochargeError
from isocharge.simulate import (
    Circle,
    Electrode,
    ForwardMap,
    Piezo,
    Sensor,
    Sweep,
    load_sensor,
    noise_model,
)
from isocharge.train import LabelledPresses, TrainingData, fit

NOISE = noise_model("reference")


def random_sensor(number: int) -> tuple[Sensor, Circle]:
    """Draw a sensor and a probe.

    Args:
        number: Seed of the random numbers.
    """
    rng = np.random.default_rng([50, number])
    film = load_sensor("four-25um-biaxial").film
    thickness_mm = 1e-3 * np.exp(rng.uniform(np.log(5.0), np.log(200.0)))
    pretension_MPa = rng.choice([0.0, rng.uniform(0.0, 2.0)], p=[0.25, 0.75])
    probe_radius = np.exp(rng.uniform(0.0, np.log(12.0)))
    n_electrode = int(rng.integers(3, 9))
    side = rng.uniform(2.0, 4.0)
    ring_radius = rng.uniform(6.0, 16.0)
    angle = 2.0 * np.pi * (np.arange(n_electrode) + rng.uniform(-0.15, 0.15, n_electrode)) / n_electrode
    distance = ring_radius * np.where(np.arange(n_electrode) % 2 == 0, 1.0, rng.uniform(0.6, 1.4))
    electrodes = tuple(
        Electrode.of_square(name, (float(x), float(y)), float(side))
        for name, x, y in zip("ABCDEFGH", distance * np.cos(angle), distance * np.sin(angle), strict=False)
    )
    is_biaxial = rng.random() < 0.5
    piezo = Piezo(8.0, 8.0) if is_biaxial else Piezo(20.0, 2.0)
    film = replace(film, thickness=float(thickness_mm), pretension=float(pretension_MPa))
    return Sensor(f"random-{number}", film, piezo, electrodes), Circle(round(float(probe_radius), 2))


def measure(sensor: Sensor, probe: Circle) -> dict[str, Any]:
    """Train a network for a sensor, and return its errors over the limit.

    Args:
        sensor: The sensor.
        probe: The probe.

    Raises:
        IsochargeError: If the sensor is refused.
    """
    charge_map = ForwardMap.build(sensor, probe, DEFAULT_RADIUS, DEFAULT_FORCE_RANGE)
    domain = charge_map.domain
    contact = Sweep(domain.radius, domain.force_range, 24_000, 0).contacts()
    presses = LabelledPresses(contact, charge_map.charges(contact))
    fitted = fit(TrainingData(sensor=sensor, probes=(probe.notation,), domain=domain, presses=presses, sha256="-"))
    radius = fitted.domain.radius
    limited = LimitedPresses.draw(charge_map, radius, 600, NOISE)
    estimate, _, _ = fitted.predict(limited.charge)
    return {"radius_mm": radius, **limited.errors(estimate)}


def main() -> None:
    """Train for all sensors and print a row for each."""
    options = arguments(__doc__, sensors=20)
    rows: dict[str, dict[str, Any]] = {}
    for number in range(options.sensors):
        sensor, probe = random_sensor(number)
        row = {
            "electrodes": len(sensor.electrodes),
            "thickness_mm": sensor.film.thickness,
            "pretension_MPa": sensor.film.pretension,
            "probe": probe.notation,
        }
        try:
            row |= measure(sensor, probe)
        except IsochargeError as error:
            row["refused"] = str(error)
        rows[sensor.name] = row
    print_results("random_sensors", options, rows)


if __name__ == "__main__":
    main()
