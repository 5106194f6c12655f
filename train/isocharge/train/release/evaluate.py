"""Errors of a predictor on presses that it never saw. One place for the figures in cards, reports and the demo."""

from collections.abc import Callable, Mapping

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.data.alarms import about_1_N, alarm_threshold
from isocharge.train.data.noise import misfit_noise, noisy_charges
from isocharge.train.data.presses import LabelledPresses, position_error

Predict = Callable[[Array], tuple[Array, Array, Array]]
"""Charges (n, n_electrode), pC, to contact (n, 3), contact_std (n, 3) and misfit (n, 1)."""

DRAWS = 20
"""Draws of the noise for the misfit's rare values."""


def measure_errors(predict: Predict, presses: LabelledPresses, noise: NoiseModel, seed: int = 1) -> Mapping[str, float]:
    """Errors with noise and on clean charges.

    Args:
        predict: The model.
        presses: Presses that training never saw.
        noise: Noise level.
        seed: Of the noise.

    Returns:
        Position errors in mm, relative force errors in percent, coverage of the 68 and 95 % intervals (share of
        coordinates, 0 to 1), the misfits that 1 % and 0.1 % of the noisy presses exceed, and the share of faults that
        the former finds.
    """
    unit = misfit_noise(noise)
    good = np.concatenate([predict(noisy_charges(presses, unit, seed + draw))[2] for draw in range(DRAWS)])
    alarm = alarm_threshold(good)
    contact, std, _ = predict(noisy_charges(presses, noise, seed))
    position, force = position_error(contact, presses.contact), contact[:, 2] / presses.contact[:, 2] - 1.0
    clean = position_error(predict(presses.charge_pC)[0], presses.contact)
    deviation = np.abs(contact - presses.contact) / std
    errors = {
        "position_median_mm": np.median(position),
        "position_rms_mm": rms(position),
        "position_p95_mm": np.percentile(position, 95),
        "position_p99_mm": np.percentile(position, 99),
        "force_median_percent": 100.0 * np.median(np.abs(force)),
        "force_rms_percent": 100.0 * rms(force),
        "force_p99_percent": 100.0 * np.percentile(np.abs(force), 99),
        "clean_position_median_mm": np.median(clean),
        "clean_position_p95_mm": np.percentile(clean, 95),
        "coverage_68": np.mean(deviation < 1.0),
        "coverage_95": np.mean(deviation < 1.96),
        "misfit_p99": alarm,
        "misfit_p999": np.percentile(good, 99.9),
        **_detected_faults(predict, presses, unit, alarm, seed),
    }
    return {name: float(f"{value:.4g}") for name, value in errors.items()}


def _detected_faults(
    predict: Predict, presses: LabelledPresses, noise: NoiseModel, limit: float, seed: int
) -> Mapping[str, float]:
    """Share of presses of about 1 N with a fault whose misfit is above the limit, every electrode in turn."""
    near = presses[about_1_N(presses.contact[:, 2])]
    if not len(near):
        return {}
    charge, count = noisy_charges(near, noise, seed + DRAWS), near.charge_pC.shape[1]

    def share(gain: float) -> float:
        faults = [charge * np.where(np.arange(count) == electrode, gain, 1.0) for electrode in range(count)]
        return float(np.mean(predict(np.concatenate(faults))[2] > limit))

    return {"found_gain_20_percent": 0.5 * (share(0.8) + share(1.2)), "found_dead_electrode": share(0.0)}
