"""Triangulation over the working area: how many positions are found, how well, and what one costs.

python tests/benchmarks/bench_triangulation.py [--presses 2000] [--json]
"""

import time
from dataclasses import replace

import numpy as np
from shared import arguments, percentiles, print_results

from isocharge.simulate import ChargeSpline, ForwardMap, Polygon, Sweep, Triangulation, load_sensor, noise_model
from isocharge.train.data.contact_errors import position_error

RADIUS, FORCES = 8.0, (0.05, 2.0)


def main() -> None:
    """Three and four electrodes, clean and noisy, unknown force."""
    options = arguments(__doc__, presses=2000)
    contact = Sweep(RADIUS, FORCES, options.presses).contacts()
    solved = ForwardMap.build(load_sensor("three-25um-biaxial"), Polygon.triangle(4.0), 10.0, FORCES)
    results = {}
    for layout in ("three", "four"):
        film = replace(solved, sensor=load_sensor(f"{layout}-25um-biaxial"))
        contours, clean = Triangulation(ChargeSpline.of(film)), film.charges(contact)
        contours.locate(clean[:1])  # the splines are fitted once
        for noise in ("clean", "reference"):
            charge, began = noise_model(noise).add(clean, np.random.default_rng(0)), time.process_time()
            fix = contours.locate(charge)
            cpu_ms = 1e3 * (time.process_time() - began) / len(contact)
            error_mm = position_error(fix.contact, contact)[fix.found]
            errors = {"found": len(error_mm), **percentiles(error_mm, (50, 95), 6), "cpu_ms": round(cpu_ms, 2)}
            results[f"{layout}, {noise}: position error, mm"] = errors
    print_results("triangulation", options, results)


if __name__ == "__main__":
    main()
