"""Triangulation over the working area: how many positions are found, how well, and what one costs.

python tests/benchmarks/bench_triangulation.py [--presses 2000]
"""

import time
from dataclasses import replace

import numpy as np
from shared import arguments

from isocharge.simulate import ChargeSpline, ForwardMap, Polygon, Sweep, Triangulation, load_sensor, noise_model

RADIUS, FORCES = 8.0, (0.05, 2.0)


def main() -> None:
    """Three and four electrodes, clean and noisy, unknown force."""
    contact = Sweep(RADIUS, FORCES, arguments(__doc__, presses=2000).presses).contacts()
    solved = ForwardMap.build(load_sensor("three-25um-biaxial"), Polygon.triangle(4.0), 10.0, FORCES)
    for layout in ("three", "four"):
        film = replace(solved, sensor=load_sensor(f"{layout}-25um-biaxial"))
        contours, clean = Triangulation(ChargeSpline.of(film)), film.charges(contact)
        contours.locate(clean[:1])  # the splines are fitted once
        for noise in ("clean", "reference"):
            charge, began = noise_model(noise).add(clean, np.random.default_rng(0)), time.process_time()
            fix = contours.locate(charge)
            each = 1e3 * (time.process_time() - began) / len(contact)
            median, most = np.percentile(np.hypot(*(fix.contact - contact)[fix.found, :2].T), (50, 95))
            print(
                f"{layout}, {noise}: {fix.found.sum()} found, "
                f"median {median:.2g} mm, 95 % {most:.2g} mm, {each:.2f} ms of CPU"
            )


if __name__ == "__main__":
    main()
