"""Measurement of the errors of a network, and of its wrong answers without a flag, on presses not used for training."""

from collections.abc import Callable, Mapping
from statistics import NormalDist

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.flags import STRESS
from isocharge.serve.model.contact import Contacts, Validity
from isocharge.serve.model.metadata import ModelMetadata, UnnoticedPresses
from isocharge.train.data.channel_noise import Noise, misfit_noise
from isocharge.train.data.contact_errors import contact_error_statistics, position_error, rounded
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.training.fit import Fitted

Predict = Callable[[Array], tuple[Array, Array, Array]]
"""Function that estimates contacts from charges.

The argument contains charges, shape (n, n_electrode), pC. The first result contains contacts (x, y, F), shape (n, 3),
mm and N. The second result contains the standard deviations of the contacts, shape (n, 3), and the third result
contains the misfits, shape (n, 1)."""

FORCES_NEAR_1_N = (0.8, 1.25)
"""Smallest and largest force of the presses on which the detection of faults is measured, N."""

N_GOOD_PRESSES = 50_000
"""Smallest number of presses with noise for the percentiles of the misfit. If there are fewer, they are repeated."""

HELD_PRESSES = "measured_presses"
"""Name of the error entry that contains the number of measured presses. Simulated presses have no such entry."""


def evaluate(fitted: Fitted) -> dict[str, float]:
    """Measure the errors of a trained network on presses that were not used in its training.

    If the network was trained on measured presses, its errors are taken from the cross-validation. These errors also
    contain the errors of the measured places and forces.

    Args:
        fitted: The network, with its noise and its presses for the test.

    Returns:
        Errors by name. The position errors are in mm, and the force errors are in percent of the force. The coverages
        of the 68 % and 95 % intervals are the fractions of the true values that lie in these intervals, 0 to 1. If the
        network always returns the same force, there are no errors of the force, and the coverages refer only to x and
        y. Further entries are the misfits that 1 % and 0.1 % of the good presses exceed. For simulated presses, the
        result also contains the errors without noise, and the fractions of faults that cause an alarm. For measured
        presses, the result also contains the number of presses.
    """
    if fitted.cross_validated is None:
        return simulated_errors(fitted.predict, fitted.test, fitted.noise)

    contact, std, misfit = fitted.cross_validated
    truth = fitted.test.contact
    errors = contact_errors(contact, std, truth)
    if "constant_force" in fitted.made_with:  # the network always returns the same force
        errors = {name: error for name, error in errors.items() if not name.startswith("force_")}
        errors |= _coverages(contact[:, :2], std[:, :2], truth[:, :2])
    # `HELD_PRESSES` is the name of the entry with the number of presses.
    return {**errors, HELD_PRESSES: float(len(truth)), **_misfit_percentiles(misfit)}


def simulated_errors(predict: Predict, presses: LabelledPresses, noise: Noise) -> dict[str, float]:
    """Measure the errors of a network on simulated presses, with and without noise, and its detection of faults.

    A fault counts as detected if the misfit is larger than the misfits of 99 % of good presses.

    Args:
        predict: Function that computes contacts, standard deviations and misfits from charges.
        presses: Presses without noise.
        noise: Noise to add.

    Returns:
        Errors by name, as `evaluate` returns them.
    """
    # Errors with and without noise
    contact, std, _ = predict(presses.noisy(noise, seed=1))
    clean_contact, _, _ = predict(presses.charge)
    clean_median_mm, clean_p95_mm = np.percentile(position_error(clean_contact, presses.contact), [50, 95])

    # Misfits of good presses. The misfit is a distance in standard deviations of `unit_noise`: the given noise, or the
    # noise `reference` if the given noise is zero.
    unit_noise = misfit_noise(noise)
    _, _, misfits = predict(presses.repeated(N_GOOD_PRESSES).noisy(unit_noise, seed=1))
    misfit_threshold = np.percentile(misfits, 99.0)  # for the detection of faults

    # Presses for the simulation of faults
    min_force, max_force = FORCES_NEAR_1_N
    force = presses.contact[:, 2]
    presses_near_1_N = presses[(force >= min_force) & (force <= max_force)]
    return {
        **contact_errors(contact, std, presses.contact),
        "clean_position_median_mm": rounded(clean_median_mm),
        "clean_position_p95_mm": rounded(clean_p95_mm),
        **_misfit_percentiles(misfits),
        **_measure_detection(predict, presses_near_1_N, unit_noise, misfit_threshold),
    }


def contact_errors(contact: Array, std: Array, truth: Array) -> dict[str, float]:
    """Compute the errors of estimated contacts, and the coverage of the intervals around them.

    Args:
        contact: Estimated contacts (x, y, F), shape (n, 3), mm and N.
        std: Standard deviations of the contacts, shape (n, 3), mm, mm and N.
        truth: True contacts, shape (n, 3).

    Returns:
        Errors by name, as `evaluate` returns them.
    """
    return contact_error_statistics(contact, truth) | _coverages(contact, std, truth)


def _coverages(estimate: Array, std: Array, truth: Array) -> dict[str, float]:
    """Return the fractions of true values in the 68 and 95 % intervals. All three arrays have the same shape."""
    deviation = np.abs(estimate - truth) / std  # in reported standard deviations
    return {
        "coverage_68": rounded(np.mean(deviation < 1.0)),
        "coverage_95": rounded(np.mean(deviation < NormalDist().inv_cdf(0.975))),
    }


def _misfit_percentiles(good_misfits: Array) -> dict[str, float]:
    """Return the misfits that 1 % and 0.1 % of good presses exceed."""
    p99, p999 = np.percentile(good_misfits, [99.0, 99.9])
    return {"misfit_p99": rounded(p99), "misfit_p999": rounded(p999)}


def _measure_detection(
    predict: Predict, presses: LabelledPresses, noise: Noise, threshold: float
) -> Mapping[str, float]:
    """Simulate one faulty electrode at a time, and compute the fraction of presses whose misfits exceed a threshold.

    Args:
        predict: Function that computes contacts, standard deviations and misfits from charges.
        presses: Presses without noise.
        noise: Noise to add.
        threshold: Misfit above which there is an alarm.

    Returns:
        Fractions by name, for a gain that is wrong by 20 % and for a dead electrode; empty if there are no presses.
    """
    if not len(presses):  # for example, if no force is near 1 N
        return {}
    noisy_charge = presses.noisy(noise, seed=2)  # other noise than that of the good presses

    def detected_fraction(*wrong_gains: float) -> float:
        """Return the share of alarms over all presses, electrodes and gains, with one wrong electrode at a time.

        An alarm is a misfit above `threshold`.

        Args:
            *wrong_gains: Factors, by one of which the charge of the wrong electrode is multiplied.
        """
        faulty_charges = []
        for gain in wrong_gains:
            for electrode in range(noisy_charge.shape[1]):
                faulty_charge = noisy_charge.copy()
                faulty_charge[:, electrode] *= gain
                faulty_charges.append(faulty_charge)
        _, _, misfit = predict(np.concatenate(faulty_charges))
        return rounded(np.mean(misfit > threshold))

    return {"found_gain_20_percent": detected_fraction(0.8, 1.2), "found_dead_electrode": detected_fraction(0.0)}


WRONG_STDS = 4.0
"""Error of a coordinate or of the force above which an answer counts as wrong, in reported standard deviations."""


def unnoticed_presses(fitted: Fitted, metadata: ModelMetadata) -> UnnoticedPresses | None:
    """Measure how often the answer to a press outside the working area is wrong and carries no flag.

    An answer is wrong if an estimated coordinate or the estimated force differs from the true value by more than
    `WRONG_STDS` standard deviations that the network reports.

    Args:
        fitted: The network.
        metadata: Metadata of the model, which contain the thresholds of the flags.

    Returns:
        The shares of wrong answers without a flag, by place; None if there are no presses outside the working area.
    """
    outside = fitted.outside
    if outside is None:
        return None
    presses = outside.test  # without noise
    contact, std, misfit = fitted.predict(presses.noisy(misfit_noise(fitted.noise), seed=11))
    is_value_wrong = np.abs(contact - presses.contact) > WRONG_STDS * std  # for x, y and F, shape (n, 3)
    is_wrong = is_value_wrong.any(axis=1)

    # The flag `stress` means that the film may be damaged. All other flags warn of a wrong answer.
    correlation = np.full_like(std, np.nan)  # no flag depends on the correlations
    contacts = Contacts(*np.concatenate([contact, std, misfit, correlation], axis=1).T)
    flags = Validity.of(metadata).batch_flags(contacts)
    is_flagged = np.array([any(flag != STRESS for flag in answer_flags) for answer_flags in flags])
    return outside.unnoticed_shares(is_wrong & ~is_flagged)
