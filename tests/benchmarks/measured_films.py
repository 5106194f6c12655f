"""Presses on simulated films as a rig measures them."""

import numpy as np

from isocharge.serve import MeasuredPresses
from isocharge.train import CalibrationProblem

POSITION_STD_mm = 0.1
"""Standard deviation of x and y of a press, mm."""

FORCE_STD = 0.01
"""Standard deviation of the force of a press, relative to the force."""


def with_rig_errors(contact: np.ndarray, rng: np.random.Generator, scale: float = 1.0) -> np.ndarray:
    """Return the contacts that a rig with random errors measures.

    Args:
        contact: True contacts (x, y, F), shape (n, 3), mm and N.
        rng: Random number generator of the errors.
        scale: Factor for the standard deviations of the errors.
    """
    count = len(contact)
    measured_contact = contact.copy()
    measured_contact[:, :2] += scale * POSITION_STD_mm * rng.standard_normal((count, 2))
    measured_contact[:, 2] *= np.exp(scale * FORCE_STD * rng.standard_normal(count))
    return measured_contact


def measured_presses(
    problem: CalibrationProblem, contact: np.ndarray, charge: np.ndarray, scale: float = 1.0
) -> MeasuredPresses:
    """Return measured presses, which are on the lines 2, 3, ... of a file.

    Args:
        problem: The films, whose electrodes are those of the presses.
        contact: Measured contacts (x, y, F), shape (n, 3), mm and N; NaN where a quantity was not measured.
        charge: Charges with noise, shape (n, n_electrode), pC.
        scale: Factor for the stated standard deviations of the rig.
    """
    count = len(contact)
    return MeasuredPresses(
        contact=contact,
        charge_pC=charge,
        position_std_mm=np.full(count, scale * POSITION_STD_mm),
        force_std=np.full(count, scale * FORCE_STD),
        electrodes=problem.electrodes,
        lines=tuple(range(2, count + 2)),
    )
