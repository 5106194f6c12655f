"""Figures of merit: errors of contacts, and which methods nothing beats."""

from typing import Any

import numpy as np

from isocharge.arrays import Array
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.data.presses import position_error


def rounded(value: float | None, digits: int = 4) -> float | None:
    """To significant digits, for the record; None if there is no such number."""
    return None if value is None or not np.isfinite(value) else float(f"{value:.{digits}g}")


def errors(contact: Array, truth: Array) -> dict[str, Any]:
    """Errors of contacts.

    Args:
        contact: (x_mm, y_mm, force_N), shape (n, 3); NaN where a method gave no answer.
        truth: The presses, shape (n, 3).

    Returns:
        Position errors in mm, relative force errors in percent, over the presses that were answered, and the share
        answered; None for what no press gives.
    """
    answered = np.isfinite(contact[:, :2]).all(axis=1)
    if not answered.any():
        return dict.fromkeys((*POSITION, *FORCE)) | {"answered": 0.0}
    position = position_error(contact[answered], truth[answered])
    force = 100.0 * np.abs(contact[answered, 2] / truth[answered, 2] - 1.0)
    figures = {
        "position_rms_mm": rms(position),
        "position_median_mm": float(np.median(position)),
        "position_p95_mm": float(np.percentile(position, 95)),
        "force_rms_percent": rms(force),
        "force_median_percent": float(np.median(force)),
        "answered": float(np.mean(answered)),
    }
    return {name: rounded(value) for name, value in figures.items()}


POSITION = ("position_rms_mm", "position_median_mm", "position_p95_mm")
FORCE = ("force_rms_percent", "force_median_percent")


def pareto(cost: Array, error: Array) -> np.ndarray:
    """Which methods no other beats in both: none has a lower cost and error, nor one equal and the other lower.

    Args:
        cost: Shape (n,).
        error: Shape (n,); NaN is never on the front.

    Returns:
        Shape (n,), bool.
    """
    lower = (cost[None] <= cost[:, None]) & (error[None] <= error[:, None])
    strictly = (cost[None] < cost[:, None]) | (error[None] < error[:, None])
    front: np.ndarray = ~(lower & strictly).any(axis=1) & np.isfinite(cost) & np.isfinite(error)
    return front


def coverage(contact: Array, std: Array, truth: Array, levels: Array) -> Array:
    """Share of truths within the central interval of each nominal level, Gaussian; shape (n_level, 3) for x, y, F."""
    from scipy.stats import norm

    deviation = np.abs(contact - truth) / std
    within: Array = np.mean(deviation[None] <= norm.ppf(0.5 + 0.5 * levels)[:, None, None], axis=1)
    return within
