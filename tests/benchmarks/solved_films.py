"""Films with imperfections, whose charges are solved in full for every press.

A calibration uses forward maps. These films do not use those maps: each press is a separate nonlinear solve of the
orthotropic, unevenly stretched film in its oval clamp.
"""

import sys
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import joblib
import numpy as np

from isocharge.simulate import Circle, Sensor
from isocharge.train import CalibrationProblem

sys.path.insert(0, str(Path(__file__).parents[1]))

from solved_charges import solved_charges

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


@joblib.Memory("build", verbose=0).cache(ignore=["executor"])
def solve_charges(sensor: Sensor, probe: Circle, contact: np.ndarray, executor: Executor) -> np.ndarray:
    """Solve the film under each contact, or read the charges that an earlier run has stored in the folder build.

    Args:
        sensor: The sensor.
        probe: The probe.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        executor: Executor that runs the solves.

    Returns:
        Charges, shape (n, n_electrode), pC.
    """
    parts = np.array_split(contact, max(len(contact) // 10, 1))
    return np.concatenate(list(executor.map(partial(solved_charges, sensor, probe), parts)))
