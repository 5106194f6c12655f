"""Faulty presses: how often a released model flags them, and how often its answer is wrong without a flag.

A press is wrong without a flag if x, y or the force is more than four reported standard deviations from the truth while
the answer carries no flag other than `stress`, which says that the film yields and not that the answer is doubtful.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np

from drawn_contacts import draw_contacts
from isocharge.common.arrays import Array, Booleans
from isocharge.serve import Predictor
from isocharge.serve.flags import STRESS
from isocharge.simulate import ChargeSpline, Circle, ForwardMap, Sensor, load_sensor, noise_model, parse_probe
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
    film = load_sensor(FILM_SENSOR).film
    area = math.pi * film.radius**2
    return {
        "probe of 2 mm radius": film_map(2.0),
        "probe of 4 mm radius": film_map(4.0),
        "film 10 % thicker": film_map(thickness=1.1 * film.thickness),
        "pretension of 0.5 MPa": film_map(pretension=0.5),
        "closed cavity of 20 mm": film_map(back_volume=20.0 * area),
        "closed cavity of 2000 mm": film_map(back_volume=2000.0 * area),
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


def fault_shares(
    model: str, nominal: ForwardMap, variants: dict[str, ForwardMap], presses: int, seed: int
) -> dict[str, Shares]:
    """Measure the shares of presses inside the working area of a released model with every fault, by its name.

    Args:
        model: Name of the released model, which is also the name of its sensor.
        nominal: Forward map of the film and the probe of the released models.
        variants: Forward maps of another probe or film, by the name of the fault.
        presses: Number of presses.
        seed: Seed of the presses, the noise and the faults.
    """
    predictor = Predictor(model)
    sensor = load_sensor(model)
    rng = np.random.default_rng(seed)
    radius_mm = math.sqrt(predictor.validity.inscribed_radius_squared_mm2)
    film = with_electrodes(nominal, sensor)
    contact = draw_contacts(rng, presses, radius_mm, FORCE_RANGE_N)
    clean = film.charges(contact)

    def with_gains(*gains: float) -> list[Array]:
        """Return the charges with one electrode's gain changed, for every gain and every electrode."""
        return [clean * (1.0 + (gain - 1.0) * unit) for gain in gains for unit in np.eye(clean.shape[1])]

    # Charges of the presses with each fault. A fault may have several forms, for example at several electrodes.
    faults = {"none": [clean]}
    for percent in (1, 2, 5, 20):
        faults[f"one gain {percent} % off"] = with_gains(1.0 - 0.01 * percent, 1.0 + 0.01 * percent)
    faults["one electrode dead"] = with_gains(0.0)
    names = predictor.metadata.electrodes
    for first, second in combinations(range(len(names)), 2):
        swapped = clean.copy()
        swapped[:, [first, second]] = swapped[:, [second, first]]
        faults[f"{names[first]} and {names[second]} swapped"] = [swapped]
    faults["all turned by one place"] = [np.roll(clean, 1, axis=1), np.roll(clean, -1, axis=1)]
    phase = rng.uniform(0.0, 2.0 * np.pi, presses)
    faults["hum of 5 pC"] = [clean + HUM_pC * np.sin(phase)[:, None]]
    for offset_pC in (10.0, 30.0):
        faults[f"warmth of {offset_pC:g} pC"] = [clean + offset_pC, clean - offset_pC]
    for name, forward_map in variants.items():
        faults[name] = [with_electrodes(forward_map, sensor).charges(contact)]
    results = {}
    for name, charges in faults.items():
        all_contacts = np.tile(contact, (len(charges), 1))
        results[name] = answer_shares(predictor, all_contacts, np.concatenate(charges), rng)

    # Faults that only some of the presses have
    clipped = (clean > CLIPPING_pC).any(axis=1)
    clipped_charge = np.minimum(clean, CLIPPING_pC)[clipped]
    results["clipped, no `[saturation]`"] = answer_shares(predictor, contact[clipped], clipped_charge, rng)
    # The charges of two presses are added, which is exact for a taut film and approximate for a slack one.
    second_contact = draw_contacts(rng, presses, radius_mm, SECOND_FINGER_FORCE_N)
    apart = np.linalg.norm((second_contact - contact)[:, :2], axis=1) > SECOND_FINGER_DISTANCE_mm
    charge_of_both = (clean + film.charges(second_contact))[apart]
    results["two fingers"] = answer_shares(predictor, contact[apart], charge_of_both, rng)
    return results


@dataclass(frozen=True)
class RingShares(Shares):
    """What happens to presses in a ring about the centre of the film.

    Attributes:
        mirrored: Share whose charges a press inside the working area also has within the noise, %. No method can notice
            these presses.
    """

    mirrored: float


def whole_film_shares(model: str, presses: int, seed: int, edges_mm: Sequence[float]) -> dict[str, RingShares]:
    """Measure the shares inside the working area of a model, of every ring outside it, of all rings, and of the film.

    A ring that the working area covers is left out, and one that it covers in part begins at the edge of the area.

    Args:
        model: Name of the released model.
        presses: Number of presses in each ring.
        seed: Seed of the presses and the noise.
        edges_mm: Radii that part the rings, ascending, mm.
    """
    predictor = Predictor(model)
    rng = np.random.default_rng(seed)
    sensor = sensor_from_dict(predictor.metadata.sensor)
    probe = parse_probe(predictor.metadata.probes[0])
    radius_mm = round(math.sqrt(predictor.validity.inscribed_radius_squared_mm2), 3)
    inner_map = ChargeSpline.of(ForwardMap.build(sensor, probe, radius_mm, FORCE_RANGE_N))
    outer_map = whole_film_map(sensor, probe, FORCE_RANGE_N)

    def ring(inner_mm: float, outer_mm: float) -> RingShares:
        """Press a ring, and count what the model answers."""
        reachable_mm = min(outer_mm, outer_map.domain.radius)
        contact = draw_contacts(rng, presses, reachable_mm, WHOLE_FILM_FORCES_N, inner_mm)
        is_inside = np.hypot(contact[:, 0], contact[:, 1]) <= inner_map.domain.radius
        charge = outer_map.charges(contact)
        charge[is_inside] = inner_map.charges(contact[is_inside])
        shares = answer_shares(predictor, contact, charge, rng)
        is_mirrored = np.zeros(presses, dtype=bool)
        is_mirrored[~is_inside] = has_mirror(inner_map, charge[~is_inside], noise_model("reference"))
        return RingShares(shares.flagged, shares.unnoticed, 100.0 * float(is_mirrored.mean()))

    limits_mm = {"inside the working area": (0.0, radius_mm)}
    for inner, outer in pairwise(edges_mm):
        if outer > radius_mm:
            limits_mm[f"{inner:g} to {outer:g} mm"] = (max(inner, radius_mm), outer)
    results = {name: ring(*limits) for name, limits in limits_mm.items()}

    # The means over several rings are weighted by the areas of the rings.
    areas = [outer**2 - inner**2 for inner, outer in limits_mm.values()]
    rows = [list(vars(shares).values()) for shares in results.values()]
    results["all outside the working area"] = RingShares(*np.average(rows[1:], axis=0, weights=areas[1:]).tolist())
    results["whole film"] = RingShares(*np.average(rows, axis=0, weights=areas).tolist())
    return results
