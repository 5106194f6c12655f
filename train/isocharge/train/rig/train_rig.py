"""From measured presses to a released model: split, calibrate, correct, train on the corrected map, measure."""

import io
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.files import sha256_of
from isocharge.common.progress import StageProgress, Warn
from isocharge.serve.model.model_folder import check_target
from isocharge.serve.prediction.measured_presses import MeasuredPresses, write_presses
from isocharge.simulate.dataset.shards import Dataset, Samples
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.measuring_chain.noise_file import noise_model
from isocharge.simulate.sensor.probe import Probe
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.simulate.sensor.sensor_file import sensor_to_toml
from isocharge.train.calibration.film_charges import CONTACT_STEPS
from isocharge.train.calibration.films_for import SensorFilms
from isocharge.train.data.domain import ContactDomain
from isocharge.train.data.measured import SOLVER, check_enough, complete, held_out, presses_sha256
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.films.film_presses import draw_contacts
from isocharge.train.release.measured import MeasuredTest
from isocharge.train.release.release import Release, train_model
from isocharge.train.rig.origin import origin_section
from isocharge.train.rig.rig_film import RigFilm, calibrated_film, corrected_film
from isocharge.train.training.config import FitConfig

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
        radius: Largest distance of a contact that the model shall know, m.
    """

    presses: MeasuredPresses
    sensor: Sensor
    probe: Probe
    radius: float = DEFAULT_RADIUS


def train_rig(
    rig: Rig,
    films: SensorFilms | None,
    folder: Path,
    config: FitConfig | None = None,
    *,
    drawn: int = DRAWN,
    command: str = "",
    version: int = 1,
    fresh: bool = False,
    progress: StageProgress | None = None,
    warn: Warn = warnings.warn,
) -> Release:
    """Train a model on measured presses and write it; its errors are those of presses that were held out.

    Args:
        rig: From 50 presses on.
        films: The network for all films of the layout, to calibrate the film with; None to correct the sensor as
            described instead, which takes more presses.
        folder: The model's folder, `models/NAME`.
        config: Sizes, steps, seed, noise; the defaults if absent.
        drawn: Presses of the corrected map to train on.
        command: How to make this model again, for the card.
        version: Number of the version folder.
        fresh: Throw away what an earlier run left.
        progress: Called with steps done, all steps, and a text with the loss.
        warn: Called with what the user should know of the presses.

    Raises:
        OutputExists: If the version exists; checked before the work begins.
        PressError: If there are too few presses, or no film explains them.
        DatasetError, TrainingError: As `train_model`.
    """
    check_target(folder, version, rig.sensor.electrode_names)
    domain = _domain(rig, films)
    presses = _usable(rig.presses, domain, rig.sensor.name, warn)
    held = held_out(presses.contact)
    film = _film(rig, films, presses[~held], domain, warn)
    if film.scattered:
        warn(
            f"the presses scatter about the corrected map by {film.scatter:.2g} times what noise and rig explain; the "
            "model's standard deviations are for the noise it is trained with (training.noise in --config)"
        )
    config = config or FitConfig()
    return train_model(
        _drawn(film, drawn, config.training.seed),
        folder,
        config,
        test=_test(film, presses, held),
        command=command,
        version=version,
        fresh=fresh,
        progress=progress,
        warn=warn,
    )


def _domain(rig: Rig, films: SensorFilms | None) -> ContactDomain:
    if films is None:
        return ContactDomain(1e3 * rig.radius, DEFAULT_FORCE_RANGE)
    domain, charges = films.films.domain, films.scene.charges
    radius_mm = min(1e3 * rig.radius, domain.radius_mm, charges.radius_mm - CONTACT_STEPS[0])
    low, high = charges.force_range_N
    step = float(np.exp(CONTACT_STEPS[2]))
    forces = (max(domain.force_range_N[0], low * step), min(domain.force_range_N[1], high / step))
    return ContactDomain(float(f"{radius_mm:.6g}"), forces)


def _usable(presses: MeasuredPresses, domain: ContactDomain, sensor: str, warn: Warn) -> MeasuredPresses:
    """Complete presses with positive charges within the domain; what is left out is said."""
    low, high = domain.force_range_N
    x_mm, y_mm, force_N = presses.contact.T
    rules: dict[str, Booleans] = {
        "with an unknown place, force or charge": ~complete(presses),
        "with a charge that is not positive": np.asarray((presses.charge_pC <= 0.0).any(axis=1)),
        f"beyond {domain.radius_mm:g} mm from the centre, or outside {low:.3g} to {high:.3g} N": (
            np.asarray((np.hypot(x_mm, y_mm) > domain.radius_mm) | (force_N < low) | (force_N > high))
        ),
    }
    out = np.zeros(len(presses), dtype=np.bool_)
    reasons = []
    for reason, rows in rules.items():
        if count := int((rows & ~out).sum()):
            reasons.append(f"{count} {reason}")
        out |= rows
    check_enough(int((~out).sum()), len(presses), sensor)
    if reasons:
        warn(f"{int(out.sum())} of {len(presses)} presses are left out: {'; '.join(reasons)}")
    return presses[~out]


def _film(rig: Rig, films: SensorFilms | None, presses: MeasuredPresses, domain: ContactDomain, warn: Warn) -> RigFilm:
    if films is not None:
        return calibrated_film(presses, films, domain, warn)
    low, high = domain.force_range_N
    forward_map = ForwardMap.build(
        rig.sensor, rig.probe, 1e-3 * domain.radius_mm * BEYOND, (low / BEYOND, high * BEYOND)
    )
    return corrected_film(presses, forward_map, domain, noise_model("reference"), warn)


def _drawn(film: RigFilm, count: int, seed: int) -> Dataset:
    """Presses of the corrected map, as a dataset."""
    contact = draw_contacts(np.random.default_rng(seed), film.domain, count)
    charge_pC = film.charge_pC(contact)
    probe = np.full(count, film.forward_map.probe.notation)
    x_mm, y_mm, force_N = contact.T
    samples = Samples(x_mm, y_mm, force_N, probe, np.zeros(count), charge_pC)
    about = {
        "ranges": {"radius_mm": film.domain.radius_mm, "force_N": list(film.domain.force_range_N)},
        SOLVER: {"map": "forward map of the film, corrected by measured presses"},
    }
    return Dataset(film.sensor, samples, about, _sha256(contact, charge_pC))


def _sha256(*columns: Array) -> str:
    return sha256_of(b"".join(np.ascontiguousarray(column).tobytes() for column in columns))


def _test(film: RigFilm, presses: MeasuredPresses, held: Booleans) -> MeasuredTest:
    measured = {
        "presses_sha256": presses_sha256(presses),
        "trained_on": int((~held).sum()),
        "held_out": int(held.sum()),
        "calibrated": film.calibration is not None,
        "correction_percent": float(f"{film.correction_percent(presses.contact):.4g}"),
        "scatter": float(f"{film.scatter:.4g}"),
    }
    return MeasuredTest(
        LabelledPresses(presses.contact[held], presses.charge_pC[held]),
        origin_section(film, presses, held, HELD),
        {"measured": measured},
        {
            PRESSES: _text(presses[~held]),
            HELD: _text(presses[held]),
            SENSOR: sensor_to_toml(film.sensor).encode(),
        },
    )


def _text(presses: MeasuredPresses) -> bytes:
    text = io.StringIO()
    write_presses(text, presses)
    return text.getvalue().encode()
