"""A film whose charges have a systematic error that no simulated film has, and measured presses on this film."""

import numpy as np
import pytest

from isocharge.serve import MeasuredPresses
from isocharge.simulate import Domain
from isocharge.train.data.presses import draw_contacts

DOMAIN = Domain(7.5, (0.06, 1.9))


def systematic_error(contact, electrodes=4):
    """Return relative errors of the charges of up to 3 %, shape (n, n_electrode).

    They are smooth functions of the position, different for each electrode.
    """
    x, y, _ = contact.T
    return 0.03 * np.column_stack([np.sin(x / 4 + k) * np.cos(y / 5) for k in range(electrodes)])


def measured_presses(truth, count):
    """Return presses of a simulated rig on a film with the systematic error.

    The measured positions have errors of 0.05 mm and the forces of 0.5 %, and the charges have the reference noise.

    Args:
        truth: Forward map of the film without the systematic error.
        count: Number of presses.
    """
    rng = np.random.default_rng(3)
    contact = draw_contacts(rng, DOMAIN, count)
    exact_charge = truth.charges(contact) * np.exp(systematic_error(contact, len(truth.electrodes)))
    charge = exact_charge + np.hypot(1.0, 0.002 * exact_charge) * rng.standard_normal(exact_charge.shape)
    contact[:, :2] += 0.05 * rng.standard_normal((count, 2))
    contact[:, 2] *= np.exp(0.005 * rng.standard_normal(count))
    return MeasuredPresses(
        contact=contact,
        charge_pC=charge,
        position_std_mm=np.full(count, 0.05),
        force_std=np.full(count, 0.005),
        electrodes=truth.electrodes,
        lines=tuple(range(2, count + 2)),
    )


@pytest.fixture(scope="session")
def truth(problem):
    """The forward map of a film that differs from the described one, drawn from the prior of calibrations."""
    parameters = problem.prior.draw(np.random.default_rng(0), 1)[0]
    return problem.charges.forward_map(parameters)
