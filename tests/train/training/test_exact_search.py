"""The caution about a network whose errors are larger than those of an exact search."""

import re
from typing import NamedTuple

import numpy as np
import pytest

from isocharge.simulate import Domain, NoiseModel
from isocharge.simulate.forward.charge_map import FunctionMap
from isocharge.train import LabelledPresses
from isocharge.train.training.exact_search import error_cautions

NOISE = NoiseModel("white", white=1.0, gain=0.0)
SLOPES = np.array([[30.0, 5.0, 400.0], [-20.0, 25.0, 350.0], [0.0, -30.0, 420.0], [10.0, 10.0, 500.0]])
"""Derivatives of the four charges with respect to x, y and ln F, pC/mm, pC/mm and pC."""


def linear_charges(contact):
    """Return charges that are linear in (x, y, ln F), shape (n, 4), pC."""
    coordinates = np.column_stack([contact[:, :2], np.log(contact[:, 2])])
    return 3_000.0 + coordinates @ SLOPES.T


class ScatteredNetwork(NamedTuple):
    """A network whose errors are independent and normally distributed."""

    contact: np.ndarray
    std: np.ndarray

    def predict(self, charge):
        """Return contacts with errors, instead of contacts that are computed from the charges."""
        error = self.std * np.random.default_rng(7).standard_normal(self.contact.shape)
        estimate = self.contact + error
        estimate[:, 2] = self.contact[:, 2] * np.exp(error[:, 2])
        return estimate, np.ones((len(charge), 3)), np.zeros((len(charge), 1))


@pytest.mark.parametrize("ratio", [1.0, 1.3], ids=["efficient", "30 % larger errors"])
def test_errors_of_a_network_are_compared_with_the_cramer_rao_limit(ratio):
    """The search reaches the limit (J' J)^-1 of the linear map, so a network with `ratio` times the limit has this
    ratio.
    """
    rng = np.random.default_rng(3)
    contact = np.column_stack([rng.uniform(-5.0, 5.0, (20_000, 2)), rng.uniform(0.2, 1.0, 20_000)])
    limit_std = np.sqrt(np.linalg.inv(SLOPES.T @ SLOPES).diagonal())
    presses = LabelledPresses(contact, linear_charges(contact))
    charge_map = FunctionMap(linear_charges, tuple("ABCD"), Domain(10.0, (0.05, 2.0)))
    network = ScatteredNetwork(contact[:2_000], ratio * limit_std)
    cautions = error_cautions(network, presses, charge_map, NOISE, seed=1)
    if ratio == 1.0:
        assert cautions == ()
    else:
        (caution,) = cautions
        position, force = map(float, re.search(r"(\S+) \(position\) and (\S+) \(force\) times", caution).groups())
        assert position == pytest.approx(ratio, rel=0.05)
        assert force == pytest.approx(ratio, rel=0.05)
        assert "training.steps" in caution
