"""Measurement of the share of wrong answers without a flag, for presses outside the working area of a model."""

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.serve.flags import STRESS
from isocharge.serve.model.contact import Contacts
from isocharge.serve.model.metadata import ModelMetadata, UnnoticedPresses
from isocharge.serve.model.validity import Validity
from isocharge.train.training.fitted import Fitted

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
    presses = outside.test
    contact, std, misfit = fitted.predict(presses.noisy(fitted.misfit_noise, seed=11))
    is_value_wrong = np.abs(contact - presses.contact) > WRONG_STDS * std  # for x, y and F, shape (n, 3)
    is_wrong = is_value_wrong.any(axis=1)
    is_unnoticed = is_wrong & ~is_flagged(metadata, contact, std, misfit)
    return outside.unnoticed_shares(is_unnoticed)


def is_flagged(metadata: ModelMetadata, contact: Array, std: Array, misfit: Array) -> Booleans:
    """Return whether each answer carries a flag that warns of a wrong answer.

    All flags except `stress` are such warnings. The flag `stress` means that the film may be damaged.

    Args:
        metadata: Metadata of the model.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        std: Standard deviations of the contacts, shape (n, 3), mm, mm and N.
        misfit: Misfits, shape (n, 1).

    Returns:
        Whether each answer carries such a flag, shape (n,).
    """
    correlation = np.full_like(std, np.nan)  # no flag depends on the correlations
    fields = np.concatenate([contact, std, misfit, correlation], axis=1).T  # one row for each field of `Contacts`
    flags = Validity.of(metadata).batch_flags(Contacts(*fields))
    return np.array([any(flag != STRESS for flag in answer_flags) for answer_flags in flags])
