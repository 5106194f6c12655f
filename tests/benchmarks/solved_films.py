"""Films with imperfections, whose charges are solved in full for every press.

A calibration uses forward maps. These films do not use those maps: each press is a separate nonlinear solve of the
orthotropic, unevenly stretched film in its oval clamp.
"""

from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from isocharge.simulate import Circle, Sensor, press, touch_charge
from isocharge.train import CalibrationProblem
from isocharge.train.data.presses import draw_contacts

PRETENSION_MPa = (0.6, 1.2)
"""Range of the mean pretensions of the films."""

LARGEST_OVAL = 0.012
"""Largest parameter e of the oval clamp."""


@dataclass(frozen=True)
class Unevenness:
    """Ranges from which the unevenness of films is drawn.

    Attributes:
        tension: Uneven part of the tension over its mean; T1 / T2 is (1 + u) / (1 - u).
        young_ratio: E1 / E2.
    """

    tension: tuple[float, float]
    young_ratio: tuple[float, float]


FILMS = {
    "typical": Unevenness((0.1, 0.3), (1.05, 1.3)),
    "moduli": Unevenness((0.1, 0.1), (1.6, 1.6)),
    "tension": Unevenness((0.5, 0.5), (1.1, 1.1)),
}
"""Kinds of films by name."""

LARGEST_FORCE_N = 1.6
"""Largest force of a press."""


@dataclass(frozen=True)
class SolvedFilm:
    """A film with imperfections, and the charges of its presses without noise.

    Attributes:
        contact: Presses (x, y, F) on the film as it is calibrated, shape (n, 3), mm and N.
        charge: Their charges, shape (n, n_electrode), pC.
        later_contact: Presses on the film after its pretension has changed.
        later_charge: Their charges.
    """

    contact: np.ndarray
    charge: np.ndarray
    later_contact: np.ndarray
    later_charge: np.ndarray


def draw_film(problem: CalibrationProblem, kind: Unevenness, seed: int) -> tuple[Sensor, Circle]:
    """Draw a film: its properties from the prior distribution, and its unevenness from the ranges of a kind."""
    rng = np.random.default_rng([seed, 49])
    prior = problem.prior.layout.prior
    values = prior.draw(rng, 1)[0]
    values[prior.index("pretension")] = rng.uniform(*PRETENSION_MPa)
    sensor, probe = prior.film(values)
    angle = rng.uniform(0.0, np.pi, 3)
    unevenness = rng.uniform(*kind.tension) * sensor.film.pretension
    film = replace(
        sensor.film,
        deviator=(unevenness * np.cos(2.0 * angle[0]), unevenness * np.sin(2.0 * angle[0])),
        young_ratio=rng.uniform(*kind.young_ratio),
        axis=angle[1],
        oval=rng.uniform(0.0, LARGEST_OVAL),
        oval_axis=angle[2],
    )
    return replace(sensor, film=film), probe


def solve_charges(sensor: Sensor, probe: Circle, contact: np.ndarray) -> np.ndarray:
    """Solve the film under each contact (x, y, F), shape (3,) or (n, 3), and return the charges, pC."""
    rows = [touch_charge(sensor, press(sensor.film, probe, (x, y), force)) for x, y, force in contact.tolist()]
    return np.array(rows)


def stored_charges(path: Path, contact: np.ndarray) -> np.ndarray | None:
    """Return the charges that an earlier run stored for the same contacts, or None if there are none."""
    if not path.exists():
        return None
    with np.load(path) as stored:
        return stored["charge"] if np.array_equal(stored["contact"], contact) else None


def solved_film(
    problem: CalibrationProblem,
    kind: Unevenness,
    seed: int,
    change_MPa: float,
    counts: tuple[int, int],
    folder: Path,
    pool: Executor,
) -> SolvedFilm:
    """Draw a film and solve its presses, or read them from an earlier run.

    The presses before the change are solved only once for all changes.

    Args:
        problem: The films.
        kind: Kind of the film.
        seed: Seed of the film and of the contacts.
        change_MPa: Change of the pretension after the calibration.
        counts: Number of presses before and after the change.
        folder: Folder in which solved presses of this kind of film are stored.
        pool: Processes that solve the presses.
    """
    rng = np.random.default_rng([seed, 50])
    sensor, probe = draw_film(problem, kind, seed)
    later = replace(sensor, film=replace(sensor.film, pretension=sensor.film.pretension + change_MPa))
    arrays = {}
    for prefix, change, film, count in (("", 0.0, sensor, counts[0]), ("later_", change_MPa, later, counts[1])):
        contact = draw_contacts(rng, problem.domain, count)
        contact[:, 2] = np.minimum(contact[:, 2], LARGEST_FORCE_N)
        path = folder / f"{problem.sensor.name}-{seed}-{change:+g}-{count}.npz"
        charge = stored_charges(path, contact)
        if charge is None:
            parts = np.array_split(contact, max(count // 10, 1))
            charge = np.concatenate(list(pool.map(partial(solve_charges, film, probe), parts)))
            folder.mkdir(parents=True, exist_ok=True)
            np.savez(path, contact=contact, charge=charge)
        arrays[f"{prefix}contact"] = contact
        arrays[f"{prefix}charge"] = charge
    return SolvedFilm(**arrays)
