"""Training data from measured presses on a sensor for which there is no network for all films.

The film of such a sensor cannot be calibrated. Instead, measured presses correct the forward map of the described
sensor. A network is then trained on simulated presses whose charges the corrected map computes.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Booleans
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.files import sha256_of
from isocharge.common.measured_presses import MeasuredPresses, presses_text
from isocharge.simulate import Dataset, Domain, ForwardMap, Probe, Samples, Sensor, Sweep, noise_model
from isocharge.simulate.dataset.sweep import outside_samples
from isocharge.simulate.sensor.sensor_file import sensor_to_toml
from isocharge.train.data.presses import (
    SOLVER,
    LabelledPresses,
    check_enough,
    check_known_columns,
    complete,
    draw_contacts,
    held_out,
    presses_sha256,
)
from isocharge.train.rig.corrected_film import CorrectedFilm, correct_film
from isocharge.train.training.fitted import Provenance
from isocharge.train.training.source import TrainingData

_log = logging.getLogger(__name__)

PRESSES = "presses.csv"
"""File beside the model that contains the presses from which the correction was computed."""

HELD_OUT = "held_out.csv"
"""File beside the model that contains the presses on which the errors were measured."""

SENSOR = "sensor.toml"
"""File beside the model that contains the description of the sensor."""

TRAINING_PRESSES = 24_000
"""Number of presses of the corrected map on which the network is trained."""

MAP_MARGIN = 1.01
"""Factor by which the radius and the range of forces of a forward map exceed those of the domain, dimensionless.

The margin is needed in order to compute finite differences at the edge of the domain."""


@dataclass(frozen=True)
class Rig:
    """Measured presses, with the sensor and the probe with which they were made.

    Attributes:
        presses: The presses. Presses with an unknown place, force or charge are not used.
        sensor: The sensor as described.
        probe: The probe.
        radius: Radius of the working area of the model, mm.
    """

    presses: MeasuredPresses
    sensor: Sensor
    probe: Probe
    radius: float = DEFAULT_RADIUS


def rig_data(rig: Rig, *, training_presses: int = TRAINING_PRESSES, seed: int = 0) -> TrainingData:
    """Create the training data of a sensor from measured presses on it.

    The forward map of the described sensor is corrected by the measured presses. The network is trained on random
    presses whose charges the corrected map computes. A fifth of the measured presses is held out as test data.

    A warning is logged if presses are left out. Another warning is logged if the measured presses differ from the
    corrected map more than noise and errors of the contacts explain.

    Args:
        rig: The measured presses, 50 or more, with their sensor and probe.
        training_presses: Number of random presses for the training.
        seed: Seed of the random presses.

    Returns:
        The random presses for the training, and the held-out presses for the test.

    Raises:
        PressError: If there are too few presses.
    """
    domain = Domain(rig.radius, DEFAULT_FORCE_RANGE)
    presses = _usable_presses(rig, domain)
    is_held_out = held_out(presses.contact)

    # Finite differences at the edge of the domain need the map a little beyond the edge.
    min_force, max_force = domain.force_range
    map_radius = domain.radius * MAP_MARGIN
    map_force_range = (min_force / MAP_MARGIN, max_force * MAP_MARGIN)
    described_map = ForwardMap.build(rig.sensor, rig.probe, map_radius, map_force_range)

    corrected_film = correct_film(presses[~is_held_out], described_map, domain, noise_model("reference"))
    if corrected_film.is_scattered:
        _log.warning(
            "the presses scatter about the corrected map %.2g times as much as noise and errors of the contacts "
            "explain; the model's standard deviations are those for the noise of its training (training.noise in "
            "--config)",
            corrected_film.scatter,
        )
    random_presses = _draw_dataset(corrected_film, training_presses, seed)
    test_presses = LabelledPresses(presses.contact[is_held_out], presses.charge_pC[is_held_out], measured=True)
    provenance = _provenance(corrected_film, presses, is_held_out)
    return replace(TrainingData.of(random_presses), test=test_presses, provenance=provenance)


def _usable_presses(rig: Rig, domain: Domain) -> MeasuredPresses:
    """Return the complete presses within the domain, and log a warning about the other presses.

    A press is complete if its place, its force and the charges of all electrodes are known.

    Args:
        rig: Measured presses and the sensor on which they were made.
        domain: Positions and forces that are used.

    Returns:
        The usable presses, with charges in the order of the sensor's electrodes.

    Raises:
        PressError: If a column is missing, or too few presses remain.
    """
    presses = rig.presses.of_electrodes(rig.sensor.electrode_names, rig.sensor.name)
    check_known_columns(presses)
    is_incomplete = ~complete(presses)
    is_outside = ~is_incomplete & domain.is_outside(presses.contact)  # so that each press counts for one reason only
    is_usable = ~(is_incomplete | is_outside)
    check_enough(int(is_usable.sum()), len(presses), rig.sensor.name)

    reasons = []
    if is_incomplete.any():
        reasons.append(f"{is_incomplete.sum()} with an unknown place, force or charge")
    if is_outside.any():
        min_force, max_force = domain.force_range
        reasons.append(
            f"{is_outside.sum()} beyond {domain.radius:g} mm from the centre, or outside {min_force:.3g} to "
            f"{max_force:.3g} N"
        )
    if reasons:
        _log.warning("%d of %d presses are left out: %s", (~is_usable).sum(), len(presses), "; ".join(reasons))
    return presses[is_usable]


def _draw_dataset(film: CorrectedFilm, count: int, seed: int) -> Dataset:
    """Draw random presses, compute their charges with the corrected map, and return them as a dataset.

    Args:
        film: Corrected film.
        count: Number of presses.
        seed: Seed of the presses.

    Returns:
        The dataset, whose charges have no noise.
    """
    contact = draw_contacts(np.random.default_rng(seed), film.domain, count)
    charge = film.charges(contact)
    x_mm, y_mm, force_N = contact.T
    probe_column = np.full(count, film.forward_map.probe.notation)
    orientation_deg = np.zeros(count)  # the probe is not turned against its notation
    samples = Samples(x_mm, y_mm, force_N, probe_column, orientation_deg, charge)

    # A dataset with an entry for the solver counts as simulated, not as measured.
    manifest = {
        "ranges": {"radius_mm": film.domain.radius, "force_N": list(film.domain.force_range)},
        SOLVER: {"map": "forward map of the film, corrected by measured presses"},
    }
    contact_bytes = np.ascontiguousarray(contact).tobytes()
    charge_bytes = np.ascontiguousarray(charge).tobytes()
    checksum = sha256_of(contact_bytes + charge_bytes)
    # The presses outside the domain have the charges of the described sensor, because no press was measured there.
    sweep = Sweep(film.domain.radius, film.domain.force_range, seed=seed)
    outside = outside_samples(film.forward_map.sensor, [film.forward_map.probe], sweep)
    return Dataset(film.forward_map.sensor, samples, manifest, checksum, outside)


def _provenance(film: CorrectedFilm, presses: MeasuredPresses, is_held_out: Booleans) -> Provenance:
    """Return the origin of a model of the corrected film: a section of the model card, metadata and files.

    Args:
        film: Corrected film.
        presses: All usable presses.
        is_held_out: Whether each press is held out for the test, shape (n_press,).
    """
    measured = {
        "presses_sha256": presses_sha256(presses),
        "trained_on": int((~is_held_out).sum()),
        "held_out": int(is_held_out.sum()),
        "correction_percent": float(f"{film.correction_percent(presses.contact):.4g}"),
        "scatter": float(f"{film.scatter:.4g}"),
    }
    sentences = "\n".join(f"- {sentence}" for sentence in _sentences(film, presses, is_held_out))
    return Provenance(
        card=f"## Fitted to measured presses\n\n{sentences}\n\n",
        made_with={"measured": measured},
        files={
            PRESSES: presses_text(presses[~is_held_out]).encode(),
            HELD_OUT: presses_text(presses[is_held_out]).encode(),
            SENSOR: sensor_to_toml(film.forward_map.sensor).encode(),
        },
    )


def _sentences(film: CorrectedFilm, presses: MeasuredPresses, is_held_out: Booleans) -> Iterator[str]:
    """Yield the sentences of the model card about the presses and the correction.

    Args:
        film: Corrected film.
        presses: All usable presses.
        is_held_out: Whether each press is held out for the test, shape (n_press,).
    """
    n_fitted = (~is_held_out).sum()
    yield (
        f"The model was fitted to {n_fitted} measured presses of one film. {is_held_out.sum()} other "
        f"presses, in `{HELD_OUT}`, were held out, and the errors below are those of these presses."
    )
    position_std_mm = np.median(presses.position_std_mm)
    force_std_percent = 100.0 * np.median(presses.force_std)
    yield (
        f"The places of the presses are known to {position_std_mm:.3g} mm and the forces to {force_std_percent:.3g} %, "
        "as stated with the presses."
    )
    yield (
        "The film was not calibrated, because no network for all films fits its layout and probe. The presses correct "
        "the sensor as described. Where the presses are far apart, the film may differ from the corrected sensor."
    )
    if film.correction.is_zero:
        yield "The charges are not corrected, because the presses are most probable without a correction."
    else:
        correction_percent = film.correction_percent(presses.contact)
        presses_domain = film.correction.domain  # range of the presses to which the correction was fitted
        min_force, max_force = presses_domain.force_range
        yield (
            f"The charges are corrected by {correction_percent:.2g} % (root mean square), "
            "smoothly in place and logarithm of the force. No press was made farther than "
            f"{presses_domain.radius:.3g} mm from the centre, or outside {min_force:.3g} to {max_force:.3g} N; "
            "there the correction is that of the nearest press."
        )
    if film.is_scattered:
        yield (
            f"The presses scatter about the corrected map {film.scatter:.2g} times as much as noise and errors of the "
            "contacts explain. Either the noise is larger than assumed, or the correction follows the film only "
            "roughly."
        )
