"""How far from the centre a dataset's map from contacts to charges can be inverted.

The simulator's search for folds and for contacts far apart with the same charges, on the series fitted to the dataset.
"""

import numpy as np

from isocharge.simulate.forward.charge_map import ChargeMap, Domain, within
from isocharge.simulate.identifiability.ambiguous_pairs import AmbiguousPairs, find_ambiguous_pairs
from isocharge.simulate.identifiability.working_area import working_area
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.train.data.charge_field import ChargeField

SURE = 3e-4
"""Largest error of the fitted charges, relative, for which a fold is certain: a poor fit has folds of its own."""

SMOOTH = 2e-3
"""Largest error of a poor fit to charges without noise, relative."""

CREDIBLE_SMOOTH, CREDIBLE_NOISY = 0.95, 0.8
"""Share of the radius within which a fold of a poor fit is believed: its spurious folds lie at the rim, where presses
hold it from one side only, and noise moves them inwards."""

RIM = 0.98
"""Searched radius over the domain's, dimensionless: at the very rim no press holds the slopes from outside."""

PAIR_PLACES = 400
"""Places from which contacts with the same charges are looked for; 400 take half a second."""

SMALLEST_SHARE = 0.2
"""Smallest fold-free radius over the dataset's, dimensionless, for which a training makes sense."""


def fold_free_domain(field: ChargeField, noise: NoiseModel) -> Domain:
    """The field's domain up to the nearest fold; all of it without folds, or where the fit is too poor."""
    fold = np.inf if field.error > SURE else _fold_radius(field, noise)
    return field.domain.within(min(fold, field.domain.radius))


def probable_fold(field: ChargeField, noise: NoiseModel) -> float:
    """Distance of a fold that a fit shows which is too poor to be certain of it, mm; infinite if there is none.

    Measured charges have more noise than `SURE`, and few presses fit an electrode within the working area poorly.
    """
    if field.error <= SURE:
        return np.inf
    credible = CREDIBLE_SMOOTH if field.error < SMOOTH else CREDIBLE_NOISY
    fold = _fold_radius(field, noise)
    return fold if fold < credible * field.domain.radius else np.inf


def ambiguous_pairs(field: ChargeField, noise: NoiseModel, radius: float) -> AmbiguousPairs:
    """Contacts far apart, within a radius (mm), whose charges differ by less than the noise; none where the fit is too
    poor to decide."""
    if field.error >= SMOOTH:
        return AmbiguousPairs.none()
    return find_ambiguous_pairs(_inner(field, radius), noise, field.domain.force_range[0], PAIR_PLACES)


def _inner(field: ChargeField, radius: float) -> ChargeMap:
    return within(field, RIM * radius)


def _fold_radius(field: ChargeField, noise: NoiseModel) -> float:
    area = working_area(_inner(field, field.domain.radius), noise, search_pairs=False)
    return float(f"{area.unambiguous_radius:.6g}") if np.isfinite(area.fold_radius) else np.inf
