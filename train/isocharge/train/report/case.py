"""How much work a report is, the presses that every method is measured on, and what the noise allows on them.

Test charges come from solves that training never saw: the forward map of the test reaches a little further than the
dataset's, so that its distances and forces, hence all its solves, are others. The limits are Bayes' and Cramér-Rao's.
"""

from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import DatasetError
from isocharge.simulate import (
    ChargeSpline,
    Dataset,
    Domain,
    ForwardMap,
    NoiseModel,
    Probe,
    Samples,
    Sensor,
    SolveSettings,
    Sweep,
    limits_at,
    noise_model,
    parse_probe,
)
from isocharge.simulate.dataset.sweep import solve_maps
from isocharge.simulate.identifiability.cramer_rao import CramerRao
from isocharge.simulate.mechanics.theory import ACCURACY
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.bayes.limit import BayesProblem, bayes_estimate
from isocharge.train.data.presses import LabelledPresses, domain_of
from isocharge.train.report.measures import Errors, rounded


@dataclass(frozen=True)
class Settings:
    """Sizes of a report.

    Attributes:
        presses: Test presses.
        hold_out: Share of the dataset's positions that hyperparameters are chosen by.
        learn_from: Presses of the dataset that are used at most.
        sizes: Hidden layers of the networks.
        steps: Their optimiser steps.
        seconds: Time in which single predictions of a method are timed, and the same for batches, s.
        batch: Presses in a batch.
        draws: Draws of the noise for maps and coverage of the released model.
        limited: Test presses that the Bayes limit is integrated for.
        accuracy: Relative error of a charge in the films that are solved.
        shapes: Probes that the models do not expect, as notations.
        mismatch_cases: Whether another pretension is tried, which takes solves.
        seed: Of everything random.
        quick: Whether methods are fitted small.
    """

    presses: int = 4096
    hold_out: float = 0.1
    learn_from: int = 200_000
    sizes: tuple[tuple[int, ...], ...] = ((16, 16), (32, 32), (64, 64, 64), (128, 128, 128))
    steps: int = 4_000
    seconds: float = 0.1
    batch: int = 4096
    draws: int = 20
    limited: int = 4096
    accuracy: float = ACCURACY
    shapes: tuple[str, ...] = ("circle:0.5", "circle:1.5", "circle:2.0", "rectangle:4.0x2.0", "triangle:4.0")
    mismatch_cases: bool = True
    seed: int = 0
    quick: bool = False


QUICK = Settings(
    presses=512,
    learn_from=3000,
    sizes=((16, 16),),
    steps=150,
    seconds=0.01,
    batch=512,
    draws=4,
    limited=128,
    accuracy=1e-2,
    shapes=("circle:2.0",),
    mismatch_cases=False,
    quick=True,
)
"""Everything once, small: seconds, to try it out. Its figures mean nothing."""


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
        further: float = FURTHER,
        accuracy: float = ACCURACY,
        executor: Executor | None = None,
    ) -> tuple[ForwardMap, ...]:
        """Forward maps of the sensor under its probes, solved so much further than the dataset reaches."""
        return solve_maps(
            self.sensor, self.probes, self.sweep(further), SolveSettings(accuracy=accuracy), executor=executor
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


BAYES, CRAMER_RAO = "Bayes limit", "Cramér-Rao"
"""Their names in pictures."""


@dataclass(frozen=True)
class ErrorBounds:
    """Both limits on the same presses.

    Attributes:
        bayes: Posterior means for the first of the noisy test presses, (x, y, F), shape (m, 3), mm and N; None where
            the probe is not known to the sensor, and the posterior would be one over probes, too.
        cramer_rao: Of every press, for unbiased estimates; with several probes as if the first one pressed.
    """

    bayes: Array | None
    cramer_rao: CramerRao

    @classmethod
    def of(
        cls,
        case: EvaluationCase,
        charges: ChargeSpline,
        clean: LabelledPresses,
        noisy: Array,
        executor: Executor | None = None,
    ) -> "ErrorBounds":
        """Both limits.

        Args:
            case: Sensor, probe, prior and noise.
            charges: Of the case's first probe, over exactly its contacts.
            clean: Test presses.
            noisy: Charges of the first of them with noise, shape (m, n_electrode), pC: for the Bayes limit.
            executor: Integrates.
        """
        bayes = None
        if len(case.probes) == 1 and not case.rotated:
            problem = BayesProblem(case.sensor, case.probes[0], case.domain.radius, case.domain.force_range, case.noise)
            bayes, _ = bayes_estimate(problem, noisy, charge_map=charges, executor=executor)
        return cls(bayes, limits_at(charges, clean.contact, case.noise))

    def record(self, truth: Array) -> dict[str, Any]:
        """Root-mean-square errors for the record; Cramér-Rao's holds for unbiased estimates only."""
        bayes, position = None, self.cramer_rao.position
        if self.bayes is not None:
            bayes = {**asdict(Errors.of(self.bayes, truth[: len(self.bayes)])), "presses": len(self.bayes)}
        return {
            "bayes": bayes,
            "cramer_rao": {
                "position_rms_mm": rounded(rms(position)),
                "position_median_mm": rounded(float(np.median(position))),
                "force_rms_percent": rounded(100.0 * rms(self.cramer_rao.force)),
            },
        }
