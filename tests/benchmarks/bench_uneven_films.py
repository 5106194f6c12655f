"""Time and error of forward maps of a film that is not axisymmetric.

For each probe, the benchmark builds a forward map with two workers, computes the charges of 100,000 presses,
and compares some of them with direct solves. The error of a charge is relative to the directly solved charge, or to a
tenth of the largest charge of the press if this is larger. A probe that is not round either keeps its orientation or
has random orientations.

    python tests/benchmarks/bench_uneven_films.py [--presses 20]
"""

import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import get_args

import numpy as np
from shared import arguments, print_results, report_progress

from isocharge.simulate import ForwardMap, Sensor, Sweep, load_sensor, parse_probe
from isocharge.simulate.forward.family import Orientation
from isocharge.train.data.contact_errors import rms

sys.path.insert(0, str(Path(__file__).parents[1]))

from solved_charges import solved_charges

TENSION = {"pretension": 0.75, "deviator": (0.25, 0.1)}
"""Pretensions of 1.0, 0.5 and 0.1 MPa (T11, T22, T12)."""

MODULI = {"young": np.sqrt(3400.0 * 2400.0), "young_ratio": 3.4 / 2.4, "axis": np.deg2rad(20.0)}
"""Moduli of 3.4 and 2.4 GPa at 20 degrees."""

PROBES = ("circle:1.0", "finger:6.0", "rectangle:4.0x2.0", "triangle:4.0")
RADIUS_mm = 8.0
FORCES_N = (0.05, 2.0)
SAMPLES = 100_000


def direct_errors(forward_map: ForwardMap, sensor: Sensor, orientation: Orientation, count: int) -> np.ndarray:
    """Compare the charges of random presses with direct solves, and return the largest error of each press."""
    sweep = Sweep(RADIUS_mm, FORCES_N, samples=count, seed=7, orientation=orientation)
    presses = sweep.presses([forward_map.probe])
    interpolated = forward_map.charges(presses.contact, presses.rotation)
    expected = solved_charges(sensor, forward_map.probe, presses.contact, rotation=presses.rotation)
    divisor = np.maximum(np.abs(expected), 0.1 * np.abs(expected).max(axis=1, keepdims=True))
    return (np.abs(interpolated - expected) / divisor).max(axis=1)


def main() -> None:
    options = arguments(__doc__, presses=20)
    built_in = load_sensor("four-25um-biaxial")
    sensor = replace(built_in, film=replace(built_in.film, oval=0.01, **TENSION, **MODULI))
    rows = {}
    with ProcessPoolExecutor(2) as executor:
        for notation, orientation in product(PROBES, get_args(Orientation)):
            probe = parse_probe(notation)
            if probe.is_axisymmetric and orientation == "random":
                continue
            start = time.perf_counter()
            forward_map = ForwardMap.build(
                sensor, probe, RADIUS_mm, FORCES_N, orientation=orientation, executor=executor
            )
            map_s = time.perf_counter() - start
            presses = Sweep(RADIUS_mm, FORCES_N, samples=SAMPLES, orientation=orientation).presses([probe])
            start = time.perf_counter()
            forward_map.charges(presses.contact, presses.rotation)
            charges_s = time.perf_counter() - start
            errors = direct_errors(forward_map, sensor, orientation, options.presses)
            row_name = f"{notation}, {orientation}"
            rows[row_name] = {
                "solves": forward_map.solves,
                "map_s": round(map_s),
                "charges_s": round(charges_s),
                "worst_percent": round(100.0 * errors.max(), 3),
                "rms_percent": round(100.0 * rms(errors), 3),
            }
            report_progress(row_name, rows[row_name])
    print_results("uneven_films", options, rows)


if __name__ == "__main__":
    main()
