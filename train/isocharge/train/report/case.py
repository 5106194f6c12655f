"""The presses that every method is measured on.

Test charges come from solves that training never saw: the forward map of the test reaches a little further than the
dataset's, so that its distances and forces, hence all its solves, are others.
"""

from concurrent.futures import Executor
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
from isocharge.train.data.presses import LabelledPresses, domain_of

FURTHER = 1.03
"""How much further than the dataset the test's solves reach, in distance and force."""


@dataclass(frozen=True)
class EvaluationCase:
    """What a dataset is about.

    Attributes:
        sensor: Its sensor.
        probes: Its probes.
        domain: Its contacts.
        rotated: Whether its probes are rotated at random.
        noise: What is on the charges.
        seed: Of test presses and noise.
        presses: How many test presses.
    """

    sensor: Sensor
    probes: tuple[Probe, ...]
    domain: Domain
    rotated: bool
    noise: NoiseModel
    seed: int
    presses: int

    @classmethod
    def of(cls, dataset: Dataset, presses: int, seed: int) -> "EvaluationCase":
        """From a dataset's columns and manifest, with the reference noise.

        Raises:
            DatasetError: If a probe of the dataset is no probe's notation.
        """
        probes, rotated = _probes_of(dataset.samples)
        count = presses - presses % len(probes)
        return cls(dataset.sensor, probes, domain_of(dataset), rotated, noise_model("reference"), seed, count)

    def sweep(self, further: float = 1.0) -> Sweep:
        """Presses spread like the dataset's, of another seed."""
        low, high = self.domain.force_range
        return Sweep(
            radius=self.domain.radius * further,
            force_range=(low / further, high * further),
            samples=self.presses,
            seed=self.seed + 7919,
            orientation="random" if self.rotated else "fixed",
        )

    def forward_maps(
        self,
        *,
        sensor: Sensor | None = None,
        probes: tuple[Probe, ...] | None = None,
        further: float = FURTHER,
        accuracy: float | None = None,
        executor: Executor | None = None,
    ) -> tuple[ForwardMap, ...]:
        """Forward maps of the sensor under its probes, or of another sensor, other probes, another reach."""
        settings = SolveSettings() if accuracy is None else SolveSettings(accuracy=accuracy)
        return solve_maps(
            sensor or self.sensor, probes or self.probes, self.sweep(further), settings, executor=executor
        )


def _probes_of(samples: Samples) -> tuple[tuple[Probe, ...], bool]:
    """The probes, and whether they are rotated at random; one that is rotated by one angle carries it."""
    probes, rotated = [], False
    for name in np.unique(samples.probe):
        angles = samples.orientation_deg[samples.probe == name]
        try:
            probe = parse_probe(str(name))
        except ValueError as error:
            raise DatasetError(f"the dataset's probe {str(name)!r}: {error}") from error
        rotated = rotated or (np.ptp(angles) > 0.0 and probe.period > 0.0)
        probes.append(probe if np.ptp(angles) > 0.0 else probe.rotated(float(np.deg2rad(angles[0]))))
    return tuple(probes), bool(rotated)


def press_on(forward_maps: tuple[ForwardMap, ...], sweep: Sweep) -> LabelledPresses:
    """Clean charges of a sweep's presses from these forward maps, one for each probe."""
    presses = sweep.over([forward_map.probe for forward_map in forward_maps])
    charge = np.empty((len(presses), len(forward_maps[0].electrodes)))
    for number, forward_map in enumerate(forward_maps):
        rows = np.flatnonzero(presses.probe == number)
        charge[rows] = forward_map.charges(presses.contact[rows], presses.rotation[rows])
    return LabelledPresses(presses.contact, charge)
