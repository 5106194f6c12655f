"""The presses that every method is measured on.

Test charges come from solves that training never saw: the forward map of the test reaches a little further than the
dataset's, so that its distances and forces, hence all its solves, are others.
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.errors import DatasetError
from isocharge.simulate import (
    Dataset,
    ForwardMap,
    Probe,
    Samples,
    Sensor,
    SolveSettings,
    Sweep,
    noise_model,
    parse_probe,
    solve_maps,
)
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.train.data.domain import ContactDomain
from isocharge.train.data.presses import LabelledPresses, domain_of

FURTHER = 1.03
"""How much further than the dataset the test's solves reach, in distance and force."""


@dataclass(frozen=True)
class EvaluationScene:
    """What a dataset is about.

    Attributes:
        sensor: Its sensor.
        probes: Its probes.
        domain: Its contacts.
        turned: Whether its probes are turned at random.
        noise: What is on the charges.
        seed: Of test presses and noise.
        presses: How many test presses.
    """

    sensor: Sensor
    probes: tuple[Probe, ...]
    domain: ContactDomain
    turned: bool
    noise: NoiseModel
    seed: int
    presses: int

    @classmethod
    def of(cls, dataset: Dataset, presses: int, seed: int, noise: str = "reference") -> "EvaluationScene":
        """From a dataset's columns and manifest.

        Raises:
            DatasetError: If a probe of the dataset is no probe's notation.
        """
        probes, turned = _probes_of(dataset.samples)
        count = presses - presses % len(probes)
        return cls(dataset.sensor, probes, domain_of(dataset), turned, noise_model(noise), seed, count)

    def sweep(self, further: float = 1.0) -> Sweep:
        """Presses spread like the dataset's, of another seed."""
        low, high = self.domain.force_range_N
        return Sweep(
            radius=1e-3 * self.domain.radius_mm * further,
            force_range=(low / further, high * further),
            samples=self.presses,
            seed=self.seed + 7919,
            orientation="random" if self.turned else "fixed",
        )

    def forward_maps(
        self,
        sensor: Sensor | None = None,
        probes: tuple[Probe, ...] | None = None,
        further: float = FURTHER,
        settings: SolveSettings = SolveSettings(),
    ) -> tuple[ForwardMap, ...]:
        """Forward maps of the sensor under its probes, or of another sensor, other probes, another reach."""
        return solve_maps(sensor or self.sensor, probes or self.probes, self.sweep(further), settings)


def _probes_of(samples: Samples) -> tuple[tuple[Probe, ...], bool]:
    """The probes, and whether they are turned at random; one that is turned by one angle carries it."""
    probes, turned = [], False
    for name in np.unique(samples.probe):
        angles = samples.orientation_deg[samples.probe == name]
        try:
            probe = parse_probe(str(name))
        except ValueError as error:
            raise DatasetError(f"the dataset's probe {str(name)!r}: {error}") from error
        turned = turned or (np.ptp(angles) > 0.0 and probe.period > 0.0)
        probes.append(probe if np.ptp(angles) > 0.0 else probe.rotated(float(np.deg2rad(angles[0]))))
    return tuple(probes), bool(turned)


def press_on(forward_maps: tuple[ForwardMap, ...], sweep: Sweep) -> LabelledPresses:
    """Clean charges of a sweep's presses from these forward maps, one for each probe."""
    presses = sweep.over([forward_map.probe for forward_map in forward_maps])
    charge = np.empty((len(presses), len(forward_maps[0].sensor.electrodes)))
    for number, forward_map in enumerate(forward_maps):
        rows = np.flatnonzero(presses.probe == number)
        chosen = presses[rows]
        charge[rows] = forward_map.forward(chosen.x, chosen.y, chosen.force, chosen.turn)
    return LabelledPresses(np.stack([1e3 * presses.x, 1e3 * presses.y, presses.force], axis=1), 1e12 * charge)
