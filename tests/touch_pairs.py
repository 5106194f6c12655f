"""Pairs of touches that an independent solver computes, and what released models answer to them."""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve import Predictor
from isocharge.serve.flags import MISFIT, STRESS
from isocharge.simulate import ForwardMap, Sensor, noise_model, parse_probe
from isocharge.simulate.forward.charge_spline import with_fast_derivatives
from isocharge.simulate.identifiability.mirror_region import DETECTABLE_SIGMAS
from isocharge.simulate.identifiability.nearest_contact import search
from isocharge.simulate.sensor.sensor_file import sensor_from_dict
from membrane_solver import Membrane, Touch, solve_touches
from press_faults import WRONG_STDS, contacts_between, inscribed_radius

FORCES_N = (0.1, 1.0)
"""Range of the force of each touch, N."""

NOISE = noise_model("reference")


@dataclass(frozen=True)
class PairShares:
    """What happens to pairs of touches.

    Attributes:
        pairs: Number of pairs.
        flagged: Share that carries a flag other than `stress`, %.
        misfit: Share that carries the flag `misfit`, %.
        unnoticed: Share without such a flag whose answer is wrong for both touches, %.
        detectable: Share with charges that no single press in the working area has within the noise, %. NaN if it was
            not computed.
        median_misfit: Median of the misfit of the model, in standard deviations.
    """

    pairs: int
    flagged: float
    misfit: float
    unnoticed: float
    detectable: float
    median_misfit: float


class PairStudy:
    """Pairs of touches in the working area of one released model.

    Args:
        model: Name of the released model.
    """

    def __init__(self, model: str) -> None:
        self.predictor = Predictor(model)
        metadata = self.predictor.metadata
        self.sensor = sensor_from_dict(metadata.sensor)
        self.radius_mm = round(inscribed_radius(metadata.working_area_mm), 3)
        self.probe = parse_probe(metadata.probes[0])

    def shares(self, count: int, apart_mm: float, seed: int, *, with_limit: bool) -> PairShares:
        """Solve random pairs, and count what the model answers.

        Args:
            count: Number of pairs.
            apart_mm: Smallest distance between both touches, mm.
            seed: Seed of the pairs and the noise.
            with_limit: Whether to compute `detectable`, which needs an accurate forward map of the working area.
        """
        rng = np.random.default_rng(seed)
        first, second = self.contacts(rng, count, apart_mm)
        charge = np.array([pair_charge(self.sensor, pair) for pair in zip(first, second, strict=True)])
        noisy_charge = NOISE.add(charge, rng)
        answers = self.predictor.predict_batch(noisy_charge)
        words = self.predictor.validity.batch_flags(answers)
        flagged = np.array([bool(set(flags) - {STRESS}) for flags in words])
        numbers = np.stack(answers, axis=1).astype(float)
        is_wrong = np.ones(count, dtype=bool)
        for contact in (first, second):
            is_wrong &= (np.abs(numbers[:, :3] - contact) > WRONG_STDS * numbers[:, 3:6]).any(axis=1)

        return PairShares(
            count,
            flagged=100.0 * float(flagged.mean()),
            misfit=100.0 * float(np.mean([MISFIT in flags for flags in words])),
            unnoticed=100.0 * float((is_wrong & ~flagged).mean()),
            detectable=self.detectable_share(noisy_charge) if with_limit else np.nan,
            median_misfit=float(np.median(numbers[:, 6])),
        )

    def detectable_share(self, charge: Array) -> float:
        """Return the share of charges, %, that no single press in the working area has within the noise."""
        force_range = self.predictor.metadata.force_range_N
        inner_map = with_fast_derivatives(ForwardMap.build(self.sensor, self.probe, self.radius_mm, force_range))
        _, residual = search(inner_map, charge, NOISE.sigma(charge))
        return 100.0 * float((np.linalg.norm(residual, axis=1) > DETECTABLE_SIGMAS).mean())

    def contacts(self, rng: np.random.Generator, count: int, apart_mm: float) -> tuple[Array, Array]:
        """Draw pairs of contacts in the working area, each of shape (count, 3), mm and N."""
        drawn: list[tuple[Array, Array]] = []
        while len(drawn) < count:
            first, second = contacts_between(rng, 0.0, self.radius_mm, 2, FORCES_N)
            if np.hypot(*(first - second)[:2]) >= apart_mm:
                drawn.append((first, second))
        return np.array([first for first, _ in drawn]), np.array([second for _, second in drawn])


def pair_charge(sensor: Sensor, contacts: tuple[Array, ...]) -> Array:
    """Solve touches at the same time, and return their charges, shape (n_electrode,), pC.

    Args:
        sensor: Sensor whose electrodes are quadrilaterals, with an isotropic pretension.
        contacts: Contacts (x, y, F) of disks with a radius of 1 mm, mm and N.
    """
    film = sensor.film
    membrane = Membrane(film.radius, film.thickness, film.young, film.poisson, film.pretension)
    solution = solve_touches(membrane, [Touch(*contact) for contact in contacts])
    piezo = sensor.piezo
    charges = [solution.charge(np.array(e.corners), piezo.d31, piezo.d32) for e in sensor.electrodes]
    return np.array(charges)
