"""Settings of a report, and test presses of a dataset.

The test charges are computed from solutions of the film that are not part of the training data. The forward map of the
test covers a slightly larger range of distances and forces than the forward map of the dataset. The nodes of the two
maps therefore lie at different distances and forces.
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.errors import DatasetError
from isocharge.simulate import (
    Dataset,
    Domain,
    ForwardMap,
    NoiseModel,
    Probe,
    Samples,
    Sensor,
    SolveSettings,
    Sweep,
    noise_model,
    parse_probe,
)
from isocharge.simulate.dataset.sweep import solve_maps
from isocharge.simulate.mechanics.theory import ACCURACY
from isocharge.train.data.presses import LabelledPresses, domain_of


@dataclass(frozen=True)
class Settings:
    """Settings of a report. The names of the attributes are keys of `report.json`.

    Attributes:
        presses: Number of simulated test presses.
        seconds: Duration for which single predictions of a method are timed, s. Its predictions of batches are timed
            for the same duration.
        batch: Number of presses in a batch.
        accuracy: Relative accuracy of the charges in the solves of the film.
        seed: Seed of all random numbers.
        quick: Whether the methods are tested on the charge map that they use, which saves a solve of the film.
    """

    presses: int = 4096
    seconds: float = 0.1
    batch: int = 4096
    accuracy: float = ACCURACY
    seed: int = 0
    quick: bool = False


QUICK = Settings(presses=512, seconds=0.01, batch=512, accuracy=1e-2, quick=True)
"""Settings for a trial run, which takes less than a minute. Its results are not meaningful."""

TEST_RANGE_FACTOR = 1.03
"""Factor by which the ranges of the forward map of the test exceed those of the dataset, for distance and force."""

TEST_PRESSES_SEED = 7919
"""Seed of the positions and forces of the test presses, relative to the seed of the case."""


@dataclass(frozen=True)
class EvaluationCase:
    """Conditions under which all methods are evaluated on a dataset.

    Attributes:
        sensor: The sensor of the dataset.
        probes: The probes of the dataset.
        domain: The working area and the range of forces of the dataset.
        is_rotated: Whether the probes are rotated by random angles.
        noise: The noise of the charges.
        seed: Seed of the test presses and of the noise.
        press_count: Number of test presses.
    """

    sensor: Sensor
    probes: tuple[Probe, ...]
    domain: Domain
    is_rotated: bool
    noise: NoiseModel
    seed: int
    press_count: int

    @classmethod
    def for_dataset(cls, dataset: Dataset, max_presses: int, seed: int) -> "EvaluationCase":
        """Create the case of a dataset, with the reference noise.

        Args:
            dataset: The dataset with its sensor, its presses and its manifest.
            max_presses: Largest number of test presses. It is rounded down to a multiple of the number of probes.
            seed: Seed of the test presses and of the noise.

        Raises:
            DatasetError: If the dataset names a probe that is not in the notation of `parse_probe`.
        """
        probes, is_rotated = _read_probes(dataset.samples)
        press_count = max_presses - max_presses % len(probes)  # the same number of presses for each probe
        noise = noise_model("reference")
        return cls(dataset.sensor, probes, domain_of(dataset), is_rotated, noise, seed, press_count)

    def test_sweep(self, range_factor: float = 1.0) -> Sweep:
        """Return the sweep of the test presses, which have the distribution of the dataset but another seed.

        Args:
            range_factor: Factor by which the largest distance and the largest force are multiplied, and by which the
                smallest force is divided.
        """
        min_force, max_force = self.domain.force_range
        return Sweep(
            radius=self.domain.radius * range_factor,
            force_range=(min_force / range_factor, max_force * range_factor),
            samples=self.press_count,
            seed=self.seed + TEST_PRESSES_SEED,
            orientation="random" if self.is_rotated else "fixed",
        )

    def forward_maps(self, range_factor: float, accuracy: float) -> tuple[ForwardMap, ...]:
        """Solve the film, and return the forward map of the sensor for each probe.

        Args:
            range_factor: Factor by which the ranges of distances and forces of the maps exceed those of the dataset.
            accuracy: Relative accuracy of the charges.
        """
        sweep = self.test_sweep(range_factor)
        return solve_maps(self.sensor, self.probes, sweep, SolveSettings(accuracy=accuracy))


def _read_probes(samples: Samples) -> tuple[tuple[Probe, ...], bool]:
    """Return the probes of a dataset, and whether the presses of any probe have several orientations.

    If all presses of a probe have the same angle, the probe is returned with this rotation. Different angles of an
    axisymmetric probe do not count as several orientations, because they have no effect.

    Args:
        samples: The presses of the dataset, each with the notation of its probe and its orientation.

    Returns:
        The probes in the order of their notations, and whether at least one of them has several orientations.

    Raises:
        DatasetError: If the notation of a probe is not valid.
    """
    probes = []
    is_rotated = False
    for notation in np.unique(samples.probe):
        try:
            probe = parse_probe(str(notation))
        except ValueError as error:
            raise DatasetError(f"the probe {str(notation)!r} of the dataset: {error}") from error

        angles_deg = samples.orientation_deg[samples.probe == notation]
        smallest_angle_deg = angles_deg.min()
        is_single_angle = bool(angles_deg.max() == smallest_angle_deg)
        is_axisymmetric = probe.period == 0.0  # `period` is the smallest angle of rotation that changes nothing
        if is_single_angle:
            probe = probe.rotated(float(np.deg2rad(smallest_angle_deg)))
        elif not is_axisymmetric:
            is_rotated = True
        probes.append(probe)
    return tuple(probes), is_rotated


def simulate_presses(forward_maps: tuple[ForwardMap, ...], sweep: Sweep) -> LabelledPresses:
    """Simulate the presses of a sweep without noise.

    Args:
        forward_maps: The forward map of each probe.
        sweep: The positions, forces and orientations of the presses.

    Returns:
        The contacts and charges of all presses.
    """
    presses = sweep.over([forward_map.probe for forward_map in forward_maps])
    n_electrode = len(forward_maps[0].electrodes)
    charge = np.empty((len(presses), n_electrode))
    for probe_index, forward_map in enumerate(forward_maps):
        rows = np.flatnonzero(presses.probe == probe_index)
        charge[rows] = forward_map.charges(presses.contact[rows], presses.rotation[rows])
    return LabelledPresses(presses.contact, charge)
