"""Whether the charges reveal what touches: presses under other probes, explained by presses of a circle of 1 mm.

    python simulate/examples/probe_discrimination.py four-25um-uniaxial --probe circle:2.0 --probe triangle:4.0

The nearest contact under the circle leaves a difference of the charges, in standard deviations of the noise: all that
distinguishes the two probes. The distance between the true and the explaining position is the error of taking one probe
for the other.
"""

import argparse

import numpy as np

from isocharge.simulate import (
    ChargeSpline,
    Circle,
    Domain,
    ForwardMap,
    Sweep,
    load_sensor,
    noise_model,
    parse_probe,
)
from isocharge.simulate.identifiability.nearest_contact import nearest_contact

DISTINGUISHABLE = 3.0
"""Smallest difference of the charges at which one press distinguishes two probes, standard deviations."""

INNER = 1.3
"""Ratio between the ends of the forces that explain and the force of the presses: another probe needs another force."""


def main() -> None:
    """One row for each probe."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sensor")
    parser.add_argument("--probe", action="append", required=True, type=parse_probe)
    parser.add_argument("--radius", type=float, default=8.0, help="mm")
    parser.add_argument("--force", type=float, default=1.0, help="N")
    parser.add_argument("--presses", type=int, default=1000)
    options = parser.parse_args()
    sensor, noise = load_sensor(options.sensor), noise_model("reference")
    domain = Domain(options.radius, (options.force / INNER, options.force * INNER))
    circle = ChargeSpline.of(ForwardMap.build(sensor, Circle(1.0), domain.radius, domain.force_range))
    contact = Sweep(domain.radius, (options.force, options.force), options.presses).contacts()
    for probe in options.probe:
        charge = ForwardMap.build(sensor, probe, domain.radius, domain.force_range).charges(contact)
        explaining, sigmas = nearest_contact(circle, noise, charge, contact)
        error = np.hypot(*(explaining - contact)[:, :2].T)
        print(
            f"{probe.notation}@{np.rad2deg(probe.angle):g}: distinguished at {np.mean(sigmas >= DISTINGUISHABLE):.0%} "
            f"of the positions (median {np.median(sigmas):.1f}, most {sigmas.max():.1f} standard deviations); position "
            f"error {np.median(error):.2f} mm at the median, {np.percentile(error, 95):.2f} mm at 95 %"
        )


if __name__ == "__main__":
    main()
