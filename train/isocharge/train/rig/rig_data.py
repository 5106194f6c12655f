"""From measured presses to training data: split, calibrate, correct, and draw presses of the corrected map."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from isocharge.common.arrays import Booleans
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import ModelError, SceneError
from isocharge.common.files import sha256_of
from isocharge.serve.prediction.measured_presses import MeasuredPresses, presses_text
from isocharge.simulate import Dataset, Domain, ForwardMap, Probe, Samples, Sensor, noise_model
from isocharge.simulate.sensor.sensor_file import sensor_to_toml
from isocharge.train.calibration.problem import CalibrationProblem
from isocharge.train.data.presses import (
    SOLVER,
    LabelledPresses,
    check_enough,
    complete,
    draw_contacts,
    held_out,
    presses_sha256,
)
from isocharge.train.rig.rig_film import RigFilm, calibrated_film, corrected_film
from isocharge.train.training.fitted import Provenance
from isocharge.train.training.source import TrainingData

_log = logging.getLogger(__name__)

PRESSES, HELD, SENSOR = "presses.csv", "held_out.csv", "sensor.toml"
"""Files beside the model: what it was fitted to, what it is judged by, and the sensor as calibrated."""

DRAWN = 24_000
"""Presses of the corrected map that the network is trained on."""

BEYOND = 1.01
"""How much further than its contacts a forward map is solved, in distance and force: for slopes at the rim."""


@dataclass(frozen=True)
class Rig:
    """What was measured on what.

    Attributes:
        presses: With place, force and charges; others are left out.
        sensor: As described.
        probe: What pressed.
        radius: Largest distance of a contact that the model shall know, mm.
    """

    presses: MeasuredPresses
    sensor: Sensor
    probe: Probe
    radius: float = DEFAULT_RADIUS

    def problem(self, models: Path | None = None) -> CalibrationProblem | None:
        """How to calibrate its film; None, with a warning, if no network for all films fits layout and probe.

        Args:
            models: Folder of models that is searched first.
        """
        try:
            return CalibrationProblem.of(self.sensor, self.probe, models)
        except (ModelError, SceneError) as error:
            _log.warning("the film is not calibrated, the presses correct the sensor as described: %s", error)
            return None


def rig_data(rig: Rig, problem: CalibrationProblem | None, *, drawn: int = DRAWN, seed: int = 0) -> TrainingData:
    """What a network of a film on a rig is fitted to: presses of the film's map, as calibrated and corrected.

    Args:
        rig: From 50 presses on; a fifth of them is held out, and the network is judged by those.
        problem: How to calibrate the film first, `rig.problem()`; None to correct the sensor as described instead,
            which takes more presses.
        drawn: Presses of the corrected map to train on.
        seed: Of those presses.

    Raises:
        PressError: If there are too few presses, or no film explains them.

    Warns the logger of this module of presses that are left out, and of a scatter that noise and rig do not explain.
    """
    domain = _domain(rig, problem)
    presses = _usable(rig, domain)
    held = held_out(presses.contact)
    film = _film(rig, problem, presses[~held], domain)
    if film.scattered:
        _log.warning(
            "the presses scatter about the corrected map by %.2g times what noise and rig explain; the model's "
            "standard deviations are for the noise it is trained with (training.noise in --config)",
            film.scatter,
        )
    return replace(
        TrainingData.of(_dataset(film, drawn, seed)),
        test=LabelledPresses(presses.contact[held], presses.charge_pC[held], measured=True),
        provenance=_provenance(film, presses, held),
    )


def _domain(rig: Rig, problem: CalibrationProblem | None) -> Domain:
    if problem is None:
        return Domain(rig.radius, DEFAULT_FORCE_RANGE)
    return Domain(min(rig.radius, problem.domain.radius), problem.domain.force_range)


def _usable(rig: Rig, domain: Domain) -> MeasuredPresses:
    """Complete presses within the domain; what is left out is said."""
    presses = rig.presses.of_electrodes(rig.sensor.electrode_names, rig.sensor.name)
    (x, y, force), (low, high) = presses.contact.T, domain.force_range
    rules: dict[str, Booleans] = {
        "with an unknown place, force or charge": ~complete(presses),
        f"beyond {domain.radius:g} mm from the centre, or outside {low:.3g} to {high:.3g} N": (
            np.asarray((np.hypot(x, y) > domain.radius) | (force < low) | (force > high))
        ),
    }
    out, reasons = np.zeros(len(presses), dtype=np.bool_), []
    for reason, rows in rules.items():
        if count := int((rows & ~out).sum()):
            reasons.append(f"{count} {reason}")
        out |= rows
    check_enough(int((~out).sum()), len(presses), rig.sensor.name)
    if reasons:
        _log.warning("%d of %d presses are left out: %s", out.sum(), len(presses), "; ".join(reasons))
    return presses[~out]


def _film(rig: Rig, problem: CalibrationProblem | None, presses: MeasuredPresses, domain: Domain) -> RigFilm:
    if problem is not None:
        return calibrated_film(presses, problem, domain)
    low, high = domain.force_range
    forward_map = ForwardMap.build(rig.sensor, rig.probe, domain.radius * BEYOND, (low / BEYOND, high * BEYOND))
    return corrected_film(presses, forward_map, domain, noise_model("reference"))


def _dataset(film: RigFilm, count: int, seed: int) -> Dataset:
    """Presses of the corrected map."""
    contact = draw_contacts(np.random.default_rng(seed), film.domain, count)
    (x, y, force), charge = contact.T, film.charges(contact)
    probe = np.full(count, film.forward_map.probe.notation)
    manifest = {
        "ranges": {"radius_mm": film.domain.radius, "force_N": list(film.domain.force_range)},
        SOLVER: {"map": "forward map of the film, corrected by measured presses"},
    }
    checksum = sha256_of(np.ascontiguousarray(contact).tobytes() + np.ascontiguousarray(charge).tobytes())
    samples = Samples(x, y, force, probe, np.zeros(count), charge)
    return Dataset(film.forward_map.sensor, samples, manifest, checksum)


def _provenance(film: RigFilm, presses: MeasuredPresses, held: Booleans) -> Provenance:
    """Card, metadata and files of a model that is fitted to presses of which some are held out."""
    measured = {
        "presses_sha256": presses_sha256(presses),
        "trained_on": int((~held).sum()),
        "held_out": int(held.sum()),
        "calibrated": film.calibration is not None,
        "correction_percent": float(f"{film.correction_percent(presses.contact):.4g}"),
        "scatter": float(f"{film.scatter:.4g}"),
    }
    sentences = "\n".join(f"- {sentence}" for sentence in _sentences(film, presses, held))
    return Provenance(
        f"## Fitted to measured presses\n\n{sentences}\n\n",
        {"measured": measured},
        {
            PRESSES: presses_text(presses[~held]).encode(),
            HELD: presses_text(presses[held]).encode(),
            SENSOR: sensor_to_toml(film.forward_map.sensor).encode(),
        },
    )


def _sentences(film: RigFilm, presses: MeasuredPresses, held: Booleans) -> Iterator[str]:
    """What a model was fitted to."""
    yield (
        f"{(~held).sum()} measured presses of one film; {held.sum()} others are in `{HELD}`: they were held out, "
        "and the errors below are of them."
    )
    yield (
        f"The rig knows places to {np.median(presses.position_std_mm):.3g} mm and forces to "
        f"{100.0 * np.median(presses.force_std):.3g} %, as given."
    )
    if film.calibration is None:
        yield (
            "The film was not calibrated, for no network for all films fits its layout and probe: the presses correct "
            "the sensor as described. Where they are far apart the film may differ from both."
        )
    else:
        yield from film.calibration.summary
    correction = film.correction
    low, high = correction.domain.force_range
    if correction.nothing:
        yield "No correction beyond the film's physics: the presses are most probable without."
    else:
        yield (
            f"Beyond the film's physics the charges are corrected by {film.correction_percent(presses.contact):.2g} % "
            "(root mean square), smoothly in place and logarithm of the force. "
            f"Farther than {correction.domain.radius:.3g} mm from the centre, and outside {low:.3g} to {high:.3g} N, "
            "no press was made: the correction stays as at the nearest press."
        )
    if film.scattered:
        yield (
            f"The presses scatter about the corrected map by {film.scatter:.2g} times what noise and rig explain: more "
            "noise than assumed, or a film that the correction follows only roughly."
        )
