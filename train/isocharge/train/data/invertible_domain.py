"""Disk in which the map from contacts to charges is invertible, so that a network can be trained."""

import numpy as np

from isocharge.common.contact_domain import Domain
from isocharge.common.errors import DatasetError
from isocharge.serve.model.charge_series import ChargeSeries
from isocharge.simulate import NoiseModel
from isocharge.simulate.forward.charge_map import within
from isocharge.simulate.identifiability.working_area import working_area
from isocharge.train.data.presses import LabelledPresses

MAX_ERROR_OF_CERTAIN_FOLD = 3e-4
"""Largest relative error of the fitted charges at which a fold counts as certain. A poor fit has spurious folds."""

SEARCHED_RADIUS_RATIO = 0.98
"""Ratio of the radius within which folds are searched for to the radius of the domain.

At the edge of the domain, the presses do not determine the derivatives of the charges accurately."""

SMALLEST_SHARE = 0.2
"""Smallest ratio of the radius without folds to the radius of the dataset at which a network can be trained."""


def invertible_domain(
    field: ChargeSeries, presses: LabelledPresses, noise: NoiseModel
) -> tuple[Domain, tuple[str, ...]]:
    """Return the disk on which a network is trained, and sentences for the user about ambiguous contacts.

    At a fold, the map from contacts to charges turns back, so that contacts on both sides of the fold have the same
    charges. If an accurate fit shows a fold, the disk is reduced to the radius of the fold, and a sentence states this.
    Otherwise, the disk is the domain of the field.

    Args:
        field: Charge field that was fitted to the presses.
        presses: Presses to which the field was fitted. A sentence states how many of them lie in the disk.
        noise: Noise of good presses. Charges that differ by less than the noise count as equal.

    Returns:
        The domain, which is the disk with the range of forces, and the sentences.

    Raises:
        DatasetError: If the radius of the disk is less than `SMALLEST_SHARE` of the radius of the field.
    """
    requested_domain = field.domain
    if field.charge_std > MAX_ERROR_OF_CERTAIN_FOLD:
        return requested_domain, ()
    fold_radius = _fold_radius(field, noise)
    if not fold_radius < requested_domain.radius:
        return requested_domain, ()

    if fold_radius < SMALLEST_SHARE * requested_domain.radius:
        raise DatasetError(
            f"the map from contacts to charges folds {fold_radius:g} mm from the centre, of "
            f"{requested_domain.radius:g} mm asked for: beyond, two contacts give the same charges; add an "
            "electrode, or take a biaxial film"
        )
    return requested_domain.within(fold_radius), (_fold_caution(field, presses, fold_radius),)


def _fold_caution(field: ChargeSeries, presses: LabelledPresses, fold_radius: float) -> str:
    """Return a sentence that states the radius of a certain fold, to which the domain is reduced.

    The sentence also names the command that tracks contacts beyond the fold.

    Args:
        field: Charge field, whose domain is not reduced yet.
        presses: The presses, some of which lie beyond the fold.
        fold_radius: Distance of the fold from the centre, mm.
    """
    requested_radius = field.domain.radius
    remaining_count = len(presses.within(fold_radius))
    caution = (
        f"the map from contacts to charges folds beyond {fold_radius:g} mm: two contacts give the same charges there; "
        f"the model is trained for {fold_radius:g} mm, not {requested_radius:g} mm, on {remaining_count} of "
        f"{len(presses)} presses"
    )
    return f"{caution}; 'serve stream --track' follows contacts to {requested_radius:g} mm"


def _fold_radius(field: ChargeSeries, noise: NoiseModel) -> float:
    """Return the rounded radius of the largest disk without folds, mm, or infinity if the domain has no fold.

    Args:
        field: Charge field in whose domain folds are searched for.
        noise: Noise of good presses.
    """
    area = working_area(within(field, SEARCHED_RADIUS_RATIO * field.domain.radius), noise, search_pairs=False)
    if not np.isfinite(area.fold_radius):
        return np.inf
    return float(f"{area.unambiguous_radius:.6g}")
