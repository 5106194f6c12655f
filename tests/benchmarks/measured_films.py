"""Presses on simulated films as a rig measures them, and the errors of the contacts of a calibrated film."""

import numpy as np

from isocharge.serve import MeasuredPresses
from isocharge.train import CalibrationProblem
from isocharge.train.data.contact_errors import position_error, rms

POSITION_STD_mm = 0.1
"""Standard deviation of x and y of a press, mm."""

FORCE_STD = 0.01
"""Standard deviation of the force of a press, relative to the force."""


def with_rig_errors(contact: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the contacts that a rig with random errors measures.

    Args:
        contact: True contacts (x, y, F), shape (n, 3), mm and N.
        rng: Random number generator of the errors.
    """
    count = len(contact)
    measured_contact = contact.copy()
    measured_contact[:, :2] += POSITION_STD_mm * rng.standard_normal((count, 2))
    measured_contact[:, 2] *= np.exp(FORCE_STD * rng.standard_normal(count))
    return measured_contact


def measured_presses(problem: CalibrationProblem, contact: np.ndarray, charge: np.ndarray) -> MeasuredPresses:
    """Return measured presses, which are on the lines 2, 3, ... of a file.

    Args:
        problem: The films, whose electrodes are those of the presses.
        contact: Measured contacts (x, y, F), shape (n, 3), mm and N; NaN where a quantity was not measured.
        charge: Charges with noise, shape (n, n_electrode), pC.
    """
    count = len(contact)
    return MeasuredPresses(
        contact=contact,
        charge_pC=charge,
        position_std_mm=np.full(count, POSITION_STD_mm),
        force_std=np.full(count, FORCE_STD),
        electrodes=problem.electrodes,
        lines=tuple(range(2, count + 2)),
    )


def contact_errors(contact: np.ndarray, std: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Return the root-mean-square errors of contacts, and the shares within two standard deviations.

    Args:
        contact: Estimated contacts (x, y, F), shape (n, 3), mm and N.
        std: Reported standard deviations of x, y and F, shape (n, 3), mm and N.
        truth: True contacts, shape (n, 3), mm and N.
    """
    is_within = np.abs(contact - truth) < 2.0 * std
    return {
        "position_mm": rms(position_error(contact, truth)),
        "force_percent": 100.0 * rms(contact[:, 2] / truth[:, 2] - 1.0),
        "position_coverage": float(is_within[:, :2].mean()),
        "force_coverage": float(is_within[:, 2].mean()),
    }
