"""A map from contacts to charges whose inverse is known in closed form, and a task on it.

    ln Q_e = c + (2/3) ln F + b d_e . u + a_e |u|^2,   u = s (sinh(x / s), sinh(y / s)),

with d_e the electrodes' directions, and a_e = +-a for four electrodes in turn, 0 for three. The d_e and a_e add up to
zero and the a_e d_e, too: the mean logarithm gives F, and its differences along the d_e give u.
"""

from dataclasses import dataclass

import numpy as np
import pytest

from isocharge.simulate import Domain, noise_model
from isocharge.train.data.presses import LabelledPresses, draw_contacts
from isocharge.train.report.methods import FittingTask

DOMAIN = Domain(8.0, (0.05, 2.0))


@dataclass(frozen=True)
class KnownMap:
    """Charges and their inverse."""

    count: int
    level: float = np.log(800.0)
    slope: float = 0.05
    bend: float = 8.0
    quadratic: float = 0.003

    @property
    def directions(self):
        angle = 2.0 * np.pi * np.arange(self.count) / self.count
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def charges(self, contact):
        bent = self.bend * np.sinh(contact[:, :2] / self.bend)
        sign = np.array([1.0, -1.0, 1.0, -1.0]) if self.count == 4 else np.zeros(self.count)
        square = self.quadratic * (bent**2).sum(axis=1)[:, None] * sign
        return np.exp(self.level + 2.0 / 3.0 * np.log(contact[:, 2:]) + self.slope * bent @ self.directions.T + square)

    def presses(self, count, seed):
        contact = draw_contacts(np.random.default_rng(seed), DOMAIN, count)
        return LabelledPresses(contact, self.charges(contact))

    def task(self):
        return FittingTask(self.presses(3000, 1), DOMAIN, noise_model("reference"))


@pytest.fixture(scope="session", params=[3, 4])
def known(request):
    return KnownMap(request.param)


@pytest.fixture(scope="session")
def task(known):
    return known.task()


@pytest.fixture(scope="session")
def test_presses(known):
    return known.presses(300, 3)
