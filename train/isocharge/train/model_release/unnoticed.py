"""Measurement of the share of wrong answers without a flag, for presses outside the working area of a model."""

import math
from collections.abc import Iterator
from textwrap import fill

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.serve.flags import STRESS
from isocharge.serve.model.contact import Contacts
from isocharge.serve.model.metadata import ModelMetadata, UnnoticedPresses, percent_text
from isocharge.serve.model.validity import Validity
from isocharge.train.training.fitted import Fitted

WRONG_STDS = 4.0
"""Error of a coordinate or of the force above which an answer counts as wrong, in reported standard deviations."""

NOISE_SEED = 11
"""Seed of the noise of the presses."""

MAX_CARD_ROWS = 8
"""Largest number of rows of the table in a card."""

CARD_WIDTH = 120
"""Largest length of a line of text in a card, characters."""

MIN_NAMED_SHARE = 0.005
"""Smallest total share of wrong answers without a flag for which a card contains a table."""


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
    contact, std, misfit = fitted.predict(presses.noisy(fitted.misfit_noise, NOISE_SEED))
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


def unnoticed_section(unnoticed: UnnoticedPresses | None) -> str:
    """Return the section of a card about presses outside the working area.

    The shares of wrong answers without a flag are listed by the distance from the centre, unless the total share is
    very small. Neighbouring rings are joined, so that the table has at most `MAX_CARD_ROWS` rows. The section is empty
    if the shares were not measured.

    Args:
        unnoticed: Shares of the presses to which the model gives a wrong answer without a flag; None if the shares were
            not measured.
    """
    if unnoticed is None:
        return ""
    sentence = fill(f"{unnoticed.summary}.", CARD_WIDTH)
    heading_and_sentence = f"## Presses outside the working area\n\n{sentence}\n"
    if unnoticed.total_share < MIN_NAMED_SHARE:
        return heading_and_sentence + "\n"

    table_rows = "".join(_ring_rows(unnoticed))
    return f"{heading_and_sentence}\n| distance from the centre | wrong without a flag |\n|---|---|\n{table_rows}\n"


def _ring_rows(unnoticed: UnnoticedPresses) -> Iterator[str]:
    """Yield the rows of the table in a card.

    Each row states a range of distances from the centre, and the share of wrong answers without a flag in this range. A
    row combines several neighbouring rings.

    Args:
        unnoticed: Shares of the presses to which the model gives a wrong answer without a flag.
    """
    edges = unnoticed.ring_edges_mm
    ring_areas = np.diff(edges**2)  # divided by pi, in mm^2
    ring_count = len(ring_areas)
    rings_per_row = math.ceil(ring_count / MAX_CARD_ROWS)
    for first_ring in range(0, ring_count, rings_per_row):
        end_ring = min(first_ring + rings_per_row, ring_count)
        rings = slice(first_ring, end_ring)
        # The share of each ring is weighted by the area of the ring.
        row_share = np.average(unnoticed.ring_shares[rings], weights=ring_areas[rings])
        distances = f"{edges[first_ring]:.3g} to {edges[end_ring]:.3g} mm"
        yield f"| {distances} | {percent_text(float(row_share))} |\n"
