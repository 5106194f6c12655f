"""Settings of a report, test presses of a dataset, and theoretical limits of the error on these presses.

The test charges are computed from solutions of the film that are not part of the training data. The forward map of the
test covers a slightly larger range of distances and forces than the forward map of the dataset. The nodes of the two
maps therefore lie at different distances and forces. The theoretical limits are the Bayes limit and the Cramér-Rao
limit.
"""

from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import DatasetError
from isocharge.common.statistics import rms
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
from isocharge.train.bayes.limit import BayesProblem, bayes_estimate
from isocharge.train.data.presses import LabelledPresses, domain_of
from isocharge.train.report.measures import ContactErrors, round_significant


@dataclass(frozen=True)
class Settings:
    """Settings of a report: numbers of presses, sizes of networks, and durations.

    The names of the attributes are keys of `report.json`.

    Attributes:
        presses: Number of simulated test presses.
        hold_out: Fraction of the training positions that is used for validation, 0 to 1.
        learn_from: Largest number of presses of the dataset that is used.
        sizes: Widths of the hidden layers of each network that is trained for the comparison.
        steps: Number of optimiser steps of these networks.
        seconds: Duration for which single predictions of a method are timed, s. Its predictions of batches are timed
            for the same duration.
        batch: Number of presses in a batch.
        draws: Number of times that noise is drawn for the test presses, for the error maps and the coverage of the
            evaluated model.
        limited: Number of test presses for which the Bayes limit is computed.
        accuracy: Relative accuracy of the charges in the solves of the film.
        shapes: Probes for which the models were not trained, in the notation of `parse_probe`.
        mismatch_cases: Whether the methods are also tested on a film with another pretension. This film has to be
            solved.
        seed: Seed of all random numbers.
        quick: Whether the methods are fitted with reduced effort.
    """

    presses: int = 4096
    hold_out: float = 0.1
    learn_from: int = 200_000
    sizes: tuple[tuple[int, ...], ...] = ((16, 16), (32, 32), (64, 64, 64), (128, 128, 128))
    steps: int = 2_000
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

    def forward_maps(
        self,
        *,
        range_factor: float = TEST_RANGE_FACTOR,
        accuracy: float = ACCURACY,
        executor: Executor | None = None,
    ) -> tuple[ForwardMap, ...]:
        """Solve the film, and return the forward map of the sensor for each probe.

        Args:
            range_factor: Factor by which the ranges of distances and forces of the maps exceed those of the dataset.
            accuracy: Relative accuracy of the charges.
            executor: Executor of the simulations of the film; None to simulate in this process.
        """
        sweep = self.test_sweep(range_factor)
        return solve_maps(self.sensor, self.probes, sweep, SolveSettings(accuracy=accuracy), executor=executor)


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


BAYES = "Bayes limit"
"""Name of the Bayes limit in pictures and tables."""

CRAMER_RAO = "Cramér-Rao"
"""Name of the Cramér-Rao limit in pictures and tables."""


@dataclass(frozen=True)
class ErrorLimits:
    """Theoretical limits of the error on the test presses.

    Attributes:
        posterior_mean: Posterior means (x, y, F) of the first m test presses with noise, shape (m, 3), mm and N. The
            error of these means is the Bayes limit. None if there are several probes or orientations of a probe,
            because the probe or its orientation would then be a further unknown.
        cramer_rao: Cramér-Rao limit of each test press, for unbiased estimators. If there are several probes, it is the
            limit for the first probe.
    """

    posterior_mean: Array | None
    cramer_rao: CramerRao

    @classmethod
    def compute(
        cls,
        case: EvaluationCase,
        charge_map: ChargeSpline,
        clean_presses: LabelledPresses,
        noisy_charge: Array,
        executor: Executor | None = None,
    ) -> "ErrorLimits":
        """Compute the Cramér-Rao limit for all test presses, and the Bayes limit for the first test presses.

        The Bayes limit is the error of the posterior means. It is left out if there are several probes or several
        orientations of a probe, because these would be further unknowns.

        Args:
            case: The conditions of the test: sensor, probes, working area, forces and noise.
            charge_map: Map from contacts to charges for the first probe. Its domain is that of the case.
            clean_presses: The test presses without noise.
            noisy_charge: Charges of the first m test presses with noise, for the Bayes limit, shape (m, n_electrode),
                pC.
            executor: Executor of the integrals of the Bayes limit; None to compute them in this process.

        Returns:
            Cramér-Rao limits of all presses, and posterior means of the first m presses (None if the Bayes limit is
            left out).
        """
        cramer_rao = limits_at(charge_map, clean_presses.contact, case.noise)
        if len(case.probes) > 1 or case.is_rotated:
            return cls(None, cramer_rao)
        problem = BayesProblem(case.sensor, case.probes[0], case.domain.radius, case.domain.force_range, case.noise)
        posterior_mean, _ = bayes_estimate(problem, noisy_charge, charge_map=charge_map, executor=executor)
        return cls(posterior_mean, cramer_rao)

    def to_dict(self, truth: Array) -> dict[str, Any]:
        """Return the limits as `report.json` contains them.

        Args:
            truth: True contacts (x, y, F) of all test presses, shape (n, 3), mm and N.

        Returns:
            The entries "bayes" (None if it was not computed) and "cramer_rao", each with the errors in mm and %.
        """
        bayes = None
        if self.posterior_mean is not None:
            count = len(self.posterior_mean)
            errors = ContactErrors.compute(self.posterior_mean, truth[:count])
            bayes = {**asdict(errors), "presses": count}
        position_mm = self.cramer_rao.position
        force_percent = 100.0 * rms(self.cramer_rao.force)
        cramer_rao = {
            "position_rms_mm": round_significant(rms(position_mm)),
            "position_median_mm": round_significant(float(np.median(position_mm))),
            "force_rms_percent": round_significant(force_percent),
        }
        return {"bayes": bayes, "cramer_rao": cramer_rao}
