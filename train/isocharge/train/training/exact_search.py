"""Comparison of a trained network with an exact search for the contacts.

The search finds the contact whose charges are nearest to the measured charges (maximum likelihood). If the noise is
small, no estimator has a smaller rms error than this search (Kay 1993, 7.5). If the charges hardly determine a contact,
a good network has smaller errors than the search. If a network has much larger errors than the search, its training was
too short, or it has too few weights for its sensor.
"""

import numpy as np

from isocharge.simulate import ChargeMap, NoiseModel
from isocharge.simulate.identifiability.nearest_contact import explain
from isocharge.train.data.contact_errors import ContactErrorStatistics
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.training.folded_network import FoldedNetwork

MAX_ERROR_RATIO = 1.08
"""Largest rms error of a good network, relative to the rms error of the exact search, dimensionless."""

MAX_PRESSES = 2_000
"""Largest number of presses on which network and search are compared."""


def error_cautions(
    network: FoldedNetwork, presses: LabelledPresses, charge_map: ChargeMap, noise: NoiseModel, seed: int
) -> tuple[str, ...]:
    """Return a caution if the errors of a network are much larger than the errors of an exact search.

    The search finds the contact whose charges are nearest to given charges with noise. The first `MAX_PRESSES` presses
    are used for the comparison.

    Args:
        network: The trained network.
        presses: Simulated presses that were not used in the training.
        charge_map: Map from contacts to charges, which the search uses.
        noise: Noise that is added to the charges.
        seed: Seed of the noise.

    Returns:
        One sentence about the errors, or an empty tuple if the errors of the network are small enough.
    """
    first_rows = np.arange(min(len(presses), MAX_PRESSES))
    compared_presses = presses[first_rows]
    charge = compared_presses.noisy(noise, seed)
    network_contact, _, _ = network.predict(charge)
    # The search starts at the true contacts, so that it does not end at another contact with similar charges.
    search_contact, _ = explain(charge_map, charge, noise.sigma(charge), compared_presses.contact)
    network_errors = ContactErrorStatistics.of(network_contact, compared_presses.contact)
    search_errors = ContactErrorStatistics.of(search_contact, compared_presses.contact)
    position_ratio = network_errors.position_rms_mm / search_errors.position_rms_mm
    force_ratio = network_errors.force_rms_percent / search_errors.force_rms_percent
    if max(position_ratio, force_ratio) <= MAX_ERROR_RATIO:
        return ()
    return (
        f"the rms errors of the network are {position_ratio:.2f} (position) and {force_ratio:.2f} (force) times those "
        "of an exact search; more training.steps or a wider network.hidden may reduce them",
    )
