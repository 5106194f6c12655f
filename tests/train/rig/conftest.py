"""A film with a systematic error that no physics has, and presses on it."""

import numpy as np
import pytest

from isocharge.serve import MeasuredPresses
from isocharge.simulate import Domain
from isocharge.train.data.presses import draw_contacts

DOMAIN = Domain(7.5, (0.06, 1.9))


def systematic(contact, electrodes=4):
    """3 % times smooth functions of place, another for each electrode."""
    x, y, _ = contact.T
    return 0.03 * np.column_stack([np.sin(x / 4 + k) * np.cos(y / 5) for k in range(electrodes)])


def measured(truth, count, share=1.0, seed=3):
    """Presses as a rig reads them: places to 0.05 mm, forces to 0.5 %, charges with noise."""
    rng = np.random.default_rng(seed)
    contact = draw_contacts(rng, DOMAIN, count)
    charge = truth.charges(contact) * np.exp(share * systematic(contact, len(truth.electrodes)))
    charge += np.hypot(1.0, 0.002 * charge) * rng.standard_normal(charge.shape)
    contact[:, :2] += 0.05 * rng.standard_normal((count, 2))
    contact[:, 2] *= np.exp(0.005 * rng.standard_normal(count))
    stds = np.full(count, 0.05), np.full(count, 0.005)
    return MeasuredPresses(contact, charge, *stds, truth.electrodes, tuple(range(2, count + 2)))


@pytest.fixture(scope="session")
def truth(problem):
    """The forward map of a film that nobody described, one of those that a calibration knows."""
    return problem.charges.forward_map(problem.prior.draw(np.random.default_rng(0), 1)[0])
