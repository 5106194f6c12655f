"""Share of the film outside the working area where presses cannot be noticed, with one additional electrode.

    python tests/benchmarks/bench_guard.py [--train] [--presses 1000]

Without `--train`, the charges alone decide which presses can be noticed. With `--train`, a network is trained with the
default settings for four electrodes and for the same electrodes with a guard electrode in the centre. The table then
states which presses anywhere on the film these two models flag and which they answer wrongly without a flag, as
`bench_whole_film.py` does for the released models.
"""

import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from bench_whole_film import RING_EDGES_mm, table
from shared import arguments

from isocharge.cli.shared.forward_maps import simulated_presses
from isocharge.simulate import ChargeSpline, Circle, Electrode, limits_at, load_sensor, noise_model
from isocharge.simulate.forward.whole_film import whole_film_map
from isocharge.simulate.identifiability import mirror_region
from isocharge.simulate.identifiability.mirror_region import MirrorRegion
from isocharge.simulate.numerics.disk import Rings
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.train import fit, release

sys.path.insert(0, str(Path(__file__).parents[1]))

from press_faults import RingShares, WholeFilmStudy

WORKING_RADII = {"three-25um-biaxial": 7.5, "four-25um-biaxial": 8.0}
"""Radius of the working area of each sensor, mm."""

DIRECTIONS = {"three-25um-biaxial": np.pi / 2.0, "four-25um-biaxial": np.pi / 4.0}
"""Direction of the additional electrode from the centre, midway between two electrodes, rad."""

DISTANCES = (0.0, 25.0, 30.0, 35.0)
"""Distances of the additional electrode from the centre, mm."""

FORCE_RANGE = (0.05, 2.0)
"""Smallest and largest force, N."""

NOISE = noise_model("reference")

TRAINED_SENSOR = "four-25um-biaxial"
"""Sensor for which networks are trained without and with a guard electrode."""


def main() -> None:
    requested = arguments(__doc__, train=False, presses=1000)
    if requested.train:
        _print_trained(requested.presses)
    else:
        _print_charges()


def _print_trained(presses: int) -> None:
    """Train a network without and one with a guard electrode, and print the shares of the presses that they notice.

    Args:
        presses: Number of presses in each ring about the centre of the film.
    """
    sensor = load_sensor(TRAINED_SENSOR)
    guard = replace(Electrode.of_square("G", (0.0, 0.0), 3.0), role="guard")
    layouts = {
        "without-guard": sensor,
        "with-guard": replace(sensor, electrodes=(*sensor.electrodes, guard)),
    }
    results = {layout: _trained_shares(changed, layout, presses) for layout, changed in layouts.items()}
    print("\n".join(table(results)))


def _trained_shares(sensor: Sensor, name: str, presses: int) -> dict[str, RingShares]:
    """Train a network with the default settings, and press it anywhere on the film.

    Args:
        sensor: The sensor.
        name: Name of the model, which is written into a temporary folder.
        presses: Number of presses in each ring.
    """
    dataset = simulated_presses(sensor, [Circle(1.0)], WORKING_RADII[TRAINED_SENSOR], FORCE_RANGE)
    with TemporaryDirectory() as folder:
        model = release(fit(dataset), Path(folder) / name)
        return WholeFilmStudy(str(model.folder), presses, seed=1).rings(RING_EDGES_mm)


def _print_charges() -> None:
    """Print the share of presses that no method can notice, and the position limits, for each layout."""
    # 1,296 presses are enough for a comparison of layouts.
    mirror_region.N_RINGS = 18
    mirror_region.N_SECTORS = 24
    mirror_region.N_FORCES = 3
    film_map = whole_film_map(load_sensor("four-25um-biaxial"), Circle(1.0), FORCE_RANGE)
    print(f"{'sensor':20} {'additional':>12} {'not noticed':>11} {'rms at 1 N, mm':>14} {'worst':>6}")
    for name, radius in WORKING_RADII.items():
        sensor = load_sensor(name)
        direction = np.array([np.cos(DIRECTIONS[name]), np.sin(DIRECTIONS[name])])
        layouts = {"none": sensor}
        for distance in DISTANCES:
            x, y = (distance * direction).tolist()
            guard = Electrode.of_square("G", (x, y), 3.0)
            layouts[f"at {distance:g} mm"] = replace(sensor, electrodes=(*sensor.electrodes, guard))
        for layout, changed in layouts.items():
            charges = ChargeSpline.of(replace(film_map, sensor=changed))
            region = MirrorRegion.of(charges, radius, charges, NOISE)
            limits = limits_at(charges, Rings.spread(radius, 20, 36).contacts(1.0), NOISE).position
            rms = np.sqrt(np.mean(limits**2))
            share = f"{100.0 * region.total_share:.1f} %"
            print(f"{name:20} {layout:>12} {share:>11} {rms:14.3f} {limits.max():6.3f}", flush=True)


if __name__ == "__main__":
    main()
