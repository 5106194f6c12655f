"""Faulty presses: how often a released model flags them, and how often its answer is wrong without a flag.

A press is wrong without a flag if x, y or the force is more than four reported standard deviations from the truth while
the answer carries no flag other than `stress`, which says that the film yields and not that the answer is doubtful.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np

from drawn_contacts import draw_contacts
from isocharge.common.arrays import Array, Booleans
from isocharge.serve import Predictor
from isocharge.serve.flags import STRESS
from isocharge.simulate import Circle, ForwardMap, Sensor, load_sensor, noise_model, parse_probe
from isocharge.simulate.forward.charge_spline import with_fast_derivatives
from isocharge.simulate.forward.whole_film import whole_film_map
from isocharge.simulate.identifiability.mirror_region import has_mirror
from isocharge.simulate.sensor.sensor_file import sensor_from_dict
from solved_charges import with_film

FILM_SENSOR = "three-25um-biaxial"
"""Sensor whose film all sensors of the study share; only their electrodes and piezoelectric coefficients differ."""

FILM_RADIUS_mm = 15.001
"""Distance from the centre up to which faults of presses inside the working area need charges, mm."""

FORCE_RANGE_N = (0.05, 2.0)
"""Range of forces, N; it is the range of the released models."""

WHOLE_FILM_FORCES_N = (0.2, 2.0)
"""Range of forces of presses anywhere on the film, N."""

WRONG_STDS = 4.0
"""Number of reported standard deviations beyond which an answer counts as wrong."""

CLIPPING_pC = 1500.0
"""Largest charge of an amplifier with 1 nF and 1.5 V, pC."""

HUM_pC = 5.0
"""Amplitude of the hum, pC; all electrodes see it with the same phase, which is drawn for each press."""

SECOND_FINGER_DISTANCE_mm = 4.0
"""Smallest distance between two fingers, mm."""

SECOND_FINGER_FORCE_N = (0.1, 1.0)
"""Range of the force of the second finger, N."""


def film_map(probe_radius_mm: float = 1.0, **changes: float) -> ForwardMap:
    """Build the forward map of the built-in film under a round probe; by default, that of the released models.

    Args:
        probe_radius_mm: Radius of the probe, mm.
        changes: Other values of attributes of the film.
    """
    sensor = with_film(load_sensor(FILM_SENSOR), **changes)
    return ForwardMap.build(sensor, Circle(probe_radius_mm), FILM_RADIUS_mm, FORCE_RANGE_N)


def film_variants() -> dict[str, ForwardMap]:
    """Build the forward maps of another probe or film, by the name of the fault."""
    return {
        "probe of 2 mm radius": film_map(2.0),
        "probe of 4 mm radius": film_map(4.0),
        "film 10 % thicker": film_map(thickness=1.1 * load_sensor(FILM_SENSOR).film.thickness),
        "pretension of 0.5 MPa": film_map(pretension=0.5),
    }


def with_electrodes(forward_map: ForwardMap, sensor: Sensor) -> ForwardMap:
    """Return the charges that another sensor collects on the same film."""
    return replace(forward_map, sensor=replace(sensor, film=forward_map.sensor.film))


@dataclass(frozen=True)
class Shares:
    """What happens to presses with a fault.

    Attributes:
        flagged: Share that carries a flag other than `stress`, %.
        unnoticed: Share that is wrong and carries no such flag, %.
    """

    flagged: float
    unnoticed: float


def answer_shares(predictor: Predictor, contact: Array, charge: Array, rng: np.random.Generator) -> Shares:
    """Add `reference` noise to charges, predict, and count flags and wrong answers.

    Args:
        predictor: The model.
        contact: True contacts, shape (n, 3), mm and N.
        charge: Charges without noise, shape (n, n_electrode), pC.
        rng: Random number generator of the noise.
    """
    answers = predictor.predict_batch(noise_model("reference").add(charge, rng))
    flags = predictor.validity.batch_flags(answers)
    flagged: Booleans = np.array([bool(set(words) - {STRESS}) for words in flags])
    numbers = np.stack(answers, axis=1).astype(float)
    error = np.abs(numbers[:, :3] - contact)
    wrong = (error > WRONG_STDS * numbers[:, 3:6]).any(axis=1)
    return Shares(100.0 * float(flagged.mean()), 100.0 * float((wrong & ~flagged).mean()))


class FaultStudy:
    """Presses inside the working area of one released model, with every fault in turn.

    Args:
        model: Name of the released model, which is also the name of its sensor.
        nominal: Forward map of the film and the probe of the released models.
        variants: Forward maps of another probe or film, by the name of the fault.
        presses: Number of presses.
        seed: Seed of the presses, the noise and the faults.
    """

    def __init__(
        self, model: str, nominal: ForwardMap, variants: dict[str, ForwardMap], presses: int, seed: int
    ) -> None:
        self.predictor = Predictor(model)
        sensor = load_sensor(model)
        self.nominal = with_electrodes(nominal, sensor)
        self.variants = {name: with_electrodes(variant, sensor) for name, variant in variants.items()}
        self.rng = np.random.default_rng(seed)
        self.radius_mm = math.sqrt(self.predictor.validity.inscribed_radius_squared_mm2)
        self.contact = draw_contacts(self.rng, presses, self.radius_mm, FORCE_RANGE_N)
        self.clean_charge = self.nominal.charges(self.contact)

    def shares(self, contact: Array, charge: Array) -> Shares:
        """Add noise, predict, and count.

        Args:
            contact: True contacts, shape (n, 3), mm and N.
            charge: Charges with the fault and without noise, shape (n, n_electrode), pC.
        """
        return answer_shares(self.predictor, contact, charge, self.rng)

    def average(self, faulty_charges: list[Array]) -> Shares:
        """Return the mean over several forms of a fault, for example over the electrode that has it."""
        contact = np.tile(self.contact, (len(faulty_charges), 1))
        return self.shares(contact, np.concatenate(faulty_charges))

    def with_gain(self, *gains: float) -> list[Array]:
        """Return the charges with one electrode's gain changed, for every gain and every electrode."""
        count = self.clean_charge.shape[1]
        return [self.clean_charge * (1.0 + (gain - 1.0) * unit) for gain in gains for unit in np.eye(count)]

    def swapped(self) -> Iterator[tuple[str, Array]]:
        """Yield a name and the charges for every pair of electrodes that is swapped."""
        names = self.predictor.metadata.electrodes
        for first, second in combinations(range(len(names)), 2):
            charge = self.clean_charge.copy()
            charge[:, [first, second]] = charge[:, [second, first]]
            yield f"{names[first]} and {names[second]} swapped", charge

    def of_two_fingers(self) -> tuple[Array, Array]:
        """Return contacts of the first finger and the charges of both.

        The charges of two presses are added, which is exact for a taut film and approximate for a slack one.
        """
        second = draw_contacts(self.rng, len(self.contact), self.radius_mm, SECOND_FINGER_FORCE_N)
        distance = np.linalg.norm((second - self.contact)[:, :2], axis=1)
        apart = distance > SECOND_FINGER_DISTANCE_mm
        charge = self.clean_charge[apart] + self.nominal.charges(second[apart])
        return self.contact[apart], charge

    def results(self) -> dict[str, Shares]:
        """Return the shares of every fault, by its name."""
        contact = self.contact
        clean = self.clean_charge
        results = {"none": self.shares(contact, clean)}
        for percent in (1, 2, 5, 20):
            change = 0.01 * percent
            results[f"one gain {percent} % off"] = self.average(self.with_gain(1.0 - change, 1.0 + change))
        results["one electrode dead"] = self.average(self.with_gain(0.0))
        for name, charge in self.swapped():
            results[name] = self.shares(contact, charge)
        results["all turned by one place"] = self.average([np.roll(clean, 1, axis=1), np.roll(clean, -1, axis=1)])

        clipped = (clean > CLIPPING_pC).any(axis=1)
        results["clipped, no `[saturation]`"] = self.shares(contact[clipped], np.minimum(clean, CLIPPING_pC)[clipped])
        phase = self.rng.uniform(0.0, 2.0 * np.pi, len(clean))
        results["hum of 5 pC"] = self.shares(contact, clean + HUM_pC * np.sin(phase)[:, None])
        for offset_pC in (10.0, 30.0):
            results[f"warmth of {offset_pC:g} pC"] = self.average([clean + offset_pC, clean - offset_pC])
        results["two fingers"] = self.shares(*self.of_two_fingers())
        for name, forward_map in self.variants.items():
            results[name] = self.shares(contact, forward_map.charges(contact))
        return results


@dataclass(frozen=True)
class RingShares(Shares):
    """What happens to presses in a ring about the centre of the film.

    Attributes:
        mirrored: Share whose charges a press inside the working area also has within the noise, %. No method can notice
            these presses.
    """

    mirrored: float


class WholeFilmStudy:
    """Presses anywhere on the film of one released model.

    Args:
        model: Name of the released model.
        presses: Number of presses in each ring.
        seed: Seed of the presses and the noise.
    """

    def __init__(self, model: str, presses: int, seed: int) -> None:
        self.predictor = Predictor(model)
        self.presses = presses
        self.rng = np.random.default_rng(seed)
        metadata = self.predictor.metadata
        sensor = sensor_from_dict(metadata.sensor)
        probe = parse_probe(metadata.probes[0])
        self.radius_mm = round(math.sqrt(self.predictor.validity.inscribed_radius_squared_mm2), 3)
        self.inner_map = with_fast_derivatives(ForwardMap.build(sensor, probe, self.radius_mm, FORCE_RANGE_N))
        self.film_map = whole_film_map(sensor, probe, FORCE_RANGE_N)

    def ring(self, inner_mm: float, outer_mm: float) -> RingShares:
        """Press a ring, and count what the model answers."""
        reachable_mm = min(outer_mm, self.film_map.domain.radius)
        contact = draw_contacts(self.rng, self.presses, reachable_mm, WHOLE_FILM_FORCES_N, inner_mm)
        is_inside = np.hypot(contact[:, 0], contact[:, 1]) <= self.inner_map.domain.radius
        clean_charge = self.film_map.charges(contact)
        clean_charge[is_inside] = self.inner_map.charges(contact[is_inside])
        shares = answer_shares(self.predictor, contact, clean_charge, self.rng)
        is_mirrored = np.zeros(len(contact), dtype=bool)
        is_mirrored[~is_inside] = has_mirror(self.inner_map, clean_charge[~is_inside], noise_model("reference"))
        return RingShares(shares.flagged, shares.unnoticed, 100.0 * float(is_mirrored.mean()))

    def rings(self, edges_mm: Sequence[float]) -> dict[str, RingShares]:
        """Return the shares inside the working area, of every ring outside it, of all these rings, and of the film.

        A ring that the working area covers is left out, and one that it covers in part begins at the edge of the area.

        Args:
            edges_mm: Radii that part the rings, ascending, mm.
        """
        inside = self.ring(0.0, self.radius_mm)
        results = {"inside the working area": inside}
        outside = []
        for inner, outer in pairwise(edges_mm):
            if outer <= self.radius_mm:
                continue
            start = max(inner, self.radius_mm)
            shares = self.ring(start, outer)
            results[f"{inner:g} to {outer:g} mm"] = shares
            outside.append((outer**2 - start**2, shares))
        results["all outside the working area"] = weighted_mean(outside)
        results["whole film"] = weighted_mean([(self.radius_mm**2, inside), *outside])
        return results


def weighted_mean(items: Sequence[tuple[float, RingShares]]) -> RingShares:
    """Return the mean shares of rings, given with their weights."""
    weights = [weight for weight, _ in items]
    rows = [(shares.flagged, shares.unnoticed, shares.mirrored) for _, shares in items]
    flagged, unnoticed, mirrored = np.average(rows, axis=0, weights=weights).tolist()
    return RingShares(flagged, unnoticed, mirrored)
