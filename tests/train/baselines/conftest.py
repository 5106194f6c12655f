"""A map from contacts to charges whose inverse is known in closed form, and a task on it.

    ln Q_e = c + (2/3) ln F + b d_e . u + a_e |u|^2,   u = s (sinh(x / s), sinh(y / s)),

with d_e the electrodes' directions, and a_e = +-a for four electrodes in turn, 0 for three. The d_e and a_e add up to
zero and the a_e d_e, too: the mean logarithm gives F, and its differences along the d_e give u.
"""

from dataclasses import dataclass

import numpy as np
import pytest

from isocharge.simulate import noise_model
from isocharge.train.baselines import FittingTask
from isocharge.train.data.domain import ContactDomain
from isocharge.train.data.presses import LabelledPresses

DOMAIN = ContactDomain(8.0, (0.05, 2.0))


@dataclass(frozen=True)
class KnownMap:
    """Charges and their inverse."""

    electrodes: int
    level: float = np.log(800.0)
    slope: float = 0.05
    bend_mm: float = 8.0
    quadratic: float = 0.003

    @property
    def directions(self):
        angle = 2.0 * np.pi * np.arange(self.electrodes) / self.electrodes
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def charge_pC(self, contact):
        bent = self.bend_mm * np.sinh(contact[:, :2] / self.bend_mm)
        sign = np.array([1.0, -1.0, 1.0, -1.0]) if self.electrodes == 4 else np.zeros(self.electrodes)
        square = self.quadratic * (bent**2).sum(axis=1)[:, None] * sign
        return np.exp(self.level + 2.0 / 3.0 * np.log(contact[:, 2:]) + self.slope * bent @ self.directions.T + square)

    def contact(self, charge_pC):
        logs = np.log(charge_pC)
        mean = logs.mean(axis=1, keepdims=True)
        bent = (logs - mean) @ self.directions / (0.5 * self.electrodes * self.slope)
        position = self.bend_mm * np.arcsinh(bent / self.bend_mm)
        return np.column_stack([position, np.exp(1.5 * (mean - self.level))])

    def presses(self, count, seed):
        rng = np.random.default_rng(seed)
        radius, angle = DOMAIN.radius_mm * np.sqrt(rng.random(count)), 2.0 * np.pi * rng.random(count)
        force = np.exp(rng.uniform(*np.log(DOMAIN.force_range_N), count))
        contact = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), force])
        return LabelledPresses(contact, self.charge_pC(contact))


@pytest.fixture(scope="session", params=[3, 4])
def known(request):
    return KnownMap(request.param)


@pytest.fixture(scope="session")
def task(known):
    return FittingTask(
        known.presses(3000, 1), known.presses(500, 2), DOMAIN, noise_model("reference"), copies=2, quick=True
    )


@pytest.fixture(scope="session")
def test_presses(known):
    return known.presses(300, 3)
