"""The released network for all films, and presses of films drawn from its prior."""

from collections.abc import Callable

import numpy as np
import pytest

from isocharge.serve import MeasuredPresses
from isocharge.simulate import Circle, load_sensor
from isocharge.train import CalibrationScene, SensorFilms, films_for
from isocharge.train.calibration.film_charges import FilmCharges

Rig = Callable[..., tuple[np.ndarray, MeasuredPresses]]


@pytest.fixture(scope="session", params=["four-25um-biaxial", "three-25um-biaxial"])
def layout(request) -> SensorFilms:
    return films_for(load_sensor(request.param), Circle(1e-3))


@pytest.fixture(scope="session")
def four() -> SensorFilms:
    return films_for(load_sensor("four-25um-biaxial"), Circle(1e-3))


@pytest.fixture(scope="session")
def scene(four) -> CalibrationScene:
    return four.scene


def contacts(rng: np.random.Generator, count: int, radius_mm: float = 8.0) -> np.ndarray:
    radius, angle = radius_mm * np.sqrt(rng.random(count)), 2.0 * np.pi * rng.random(count)
    force = np.exp(rng.uniform(np.log(0.05), np.log(2.0), count))
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), force])


def rig(
    charges: FilmCharges, count: int, seed: int, position_std_mm: float = 0.1, force_std: float = 0.01
) -> tuple[np.ndarray, MeasuredPresses]:
    """A film drawn from the prior, and presses on it: noisy charges, and places and forces as a rig reads them."""
    rng = np.random.default_rng(seed)
    parameters = charges.prior.draw(rng, 1)[0]
    contact = contacts(rng, count)
    charge = charges.charge_pC(parameters, contact)
    charge = charge + np.hypot(1.0, 0.002 * charge) * rng.standard_normal(charge.shape)
    read = contact.copy()
    read[:, :2] += position_std_mm * rng.standard_normal((count, 2))
    read[:, 2] *= np.exp(force_std * rng.standard_normal(count))
    names = charges.prior.sensor.electrode_names
    return parameters, presses_of(read, charge, names, position_std_mm, force_std)


def presses_of(contact, charge, names, position_std_mm=0.1, force_std=0.01) -> MeasuredPresses:
    """Presses on the lines 2, 3, ... of a file."""
    count = len(contact)
    std = np.full(count, position_std_mm), np.full(count, force_std)
    return MeasuredPresses(contact, charge, *std, names, tuple(range(2, count + 2)))
