"""Errors on presses that a network never saw: the figures in cards, reports and the demo."""

from collections.abc import Callable, Mapping

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.simulate import Dataset, NoiseModel
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.data.misfit_charges import misfit_noise
from isocharge.train.data.presses import LabelledPresses, position_error
from isocharge.train.training.fitted import Fitted

Predict = Callable[[Array], tuple[Array, Array, Array]]
"""Charges (n, n_electrode), pC, to contact (n, 3), mm and N, standard deviations (n, 3) and misfit (n, 1)."""

FALSE_ALARMS = 0.01
"""Share of good presses whose misfit is above the alarm's threshold, dimensionless."""

ABOUT_1_N = (0.8, 1.25)
"""Smallest and largest force that counts as 1 N where faults are looked for, N."""

DRAWS = 20
"""Draws of the noise for the misfit's rare values."""

HELD_PRESSES = "measured_presses"
"""Entry of a model's errors: number of measured presses that they were measured on. Simulated errors have none."""

ONLY_SIMULATED = ("position_p99_mm", "force_p99_percent")
"""Errors that take more presses than a rig makes."""


def evaluate(fitted: Fitted, presses: LabelledPresses | Dataset | None = None, *, seed: int = 1) -> dict[str, float]:
    """Errors of a fitted network.

    Args:
        fitted: The network.
        presses: To measure on; those that the network was not shown if absent. Measured ones count as they are, what
            the rig does not know of places and forces included; to clean ones the network's noise is added.
        seed: Of the noise.

    Returns:
        Position errors in mm, relative force errors in percent, coverage of the 68 and 95 % intervals (share of
        coordinates, 0 to 1), and the misfits that 1 % and 0.1 % of good presses exceed. For clean presses also the
        errors without noise, and the share of faults that the former misfit finds; for measured ones their number.
    """
    if isinstance(presses, Dataset):
        presses = LabelledPresses.of(presses)
    test = fitted.test if presses is None else presses
    if not test.measured and isinstance(fitted.noise, NoiseModel):
        return simulated_errors(fitted.predict, test, fitted.noise, seed)
    judged = fitted.judged if presses is None else None
    errors = contact_errors(*(judged or fitted.predict(test.charge))[:2], test.contact)
    kept = {name: error for name, error in errors.items() if name not in ONLY_SIMULATED}
    if fitted.good.measured or not isinstance(fitted.noise, NoiseModel):
        misfit = fitted.judged[2] if fitted.judged else fitted.predict(fitted.good.charge)[2]
        alarm = {"misfit_p99": rounded(alarm_threshold(misfit))}
        if fitted.judged:
            alarm["misfit_p999"] = rounded(np.percentile(misfit, 99.9))
    else:
        alarm = misfit_errors(fitted.predict, fitted.good, fitted.noise, seed)
    return {**kept, HELD_PRESSES: float(len(test)), **alarm}


def simulated_errors(predict: Predict, presses: LabelledPresses, noise: NoiseModel, seed: int = 1) -> dict[str, float]:
    """Errors on clean presses, with noise and without; see `evaluate`."""
    contact, std, _ = predict(presses.noisy(noise, seed))
    clean = position_error(predict(presses.charge)[0], presses.contact)
    return {
        **contact_errors(contact, std, presses.contact),
        "clean_position_median_mm": rounded(np.median(clean)),
        "clean_position_p95_mm": rounded(np.percentile(clean, 95)),
        **misfit_errors(predict, presses, noise, seed),
    }


def contact_errors(contact: Array, std: Array, truth: Array) -> dict[str, float]:
    """Errors of contacts (x, y, F) and coverage of their standard deviations, all of shape (n, 3), mm and N."""
    position, force = position_error(contact, truth), contact[:, 2] / truth[:, 2] - 1.0
    deviation = np.abs(contact - truth) / std
    errors = {
        "position_median_mm": np.median(position),
        "position_rms_mm": rms(position),
        "position_p95_mm": np.percentile(position, 95),
        "position_p99_mm": np.percentile(position, 99),
        "force_median_percent": 100.0 * np.median(np.abs(force)),
        "force_rms_percent": 100.0 * rms(force),
        "force_p99_percent": 100.0 * np.percentile(np.abs(force), 99),
        "coverage_68": np.mean(deviation < 1.0),
        "coverage_95": np.mean(deviation < 1.96),
    }
    return {name: rounded(value) for name, value in errors.items()}


def misfit_errors(predict: Predict, presses: LabelledPresses, noise: NoiseModel, seed: int) -> dict[str, float]:
    """Misfits that few good presses exceed, and the share of faults that they find, on clean presses."""
    unit = misfit_noise(noise)
    good = np.concatenate([predict(presses.noisy(unit, seed + draw))[2] for draw in range(DRAWS)])
    alarm = alarm_threshold(good)
    faults = _detected_faults(predict, presses[about_1_N(presses.contact[:, 2])], unit, alarm, seed + DRAWS)
    return {"misfit_p99": rounded(alarm), "misfit_p999": rounded(np.percentile(good, 99.9)), **faults}


def alarm_threshold(good_misfits: Array) -> float:
    """The misfit that the share `FALSE_ALARMS` of good presses exceeds; `good_misfits` has shape (n,)."""
    return float(np.percentile(good_misfits, 100.0 * (1.0 - FALSE_ALARMS)))


def about_1_N(force: Array) -> Booleans:
    """Which forces, N, count as 1 N; the same shape."""
    low, high = ABOUT_1_N
    return np.asarray((force >= low) & (force <= high))


def rounded(value: float | np.floating) -> float:
    """A figure as metadata have it, to four digits."""
    return float(f"{value:.4g}")


def _detected_faults(
    predict: Predict, presses: LabelledPresses, noise: NoiseModel, limit: float, seed: int
) -> Mapping[str, float]:
    """Share of presses with a fault whose misfit is above the limit, every electrode in turn."""
    if not len(presses):
        return {}
    charge, count = presses.noisy(noise, seed), presses.charge.shape[1]

    def share(gain: float) -> float:
        faults = [charge * np.where(np.arange(count) == electrode, gain, 1.0) for electrode in range(count)]
        return float(np.mean(predict(np.concatenate(faults))[2] > limit))

    return {
        "found_gain_20_percent": rounded(0.5 * (share(0.8) + share(1.2))),
        "found_dead_electrode": rounded(share(0.0)),
    }
