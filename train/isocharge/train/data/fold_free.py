"""How far from the centre a dataset's map from contacts to charges can be inverted.

The simulator's search for folds and for contacts far apart with the same charges, on the series fitted to the dataset.
"""

import numpy as np

from isocharge.common.errors import DatasetError
from isocharge.simulate.forward.charge_map import Domain, within
from isocharge.simulate.identifiability.ambiguous_pairs import find_ambiguous_pairs
from isocharge.simulate.identifiability.working_area import working_area
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.train.data.charge_field import ChargeField
from isocharge.train.data.presses import LabelledPresses

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


def invertible_domain(
    field: ChargeField, presses: LabelledPresses, noise: NoiseModel
) -> tuple[Domain, tuple[str, ...]]:
    """The largest disk in which the map certainly does not fold, and sentences on folds and ambiguous pairs.

    A fit to measured charges, which have more noise than `SURE`, or to few presses is too poor for a certain fold: the
    domain then stays, and the sentence says where the map seems to fold. Pairs are searched for where it is smooth.

    Args:
        field: Fitted to the presses.
        presses: For the sentence: how many of them are left.
        noise: Of good presses: what it hides is the same charge.

    Raises:
        DatasetError: If hardly anything is left of the domain.
    """
    asked, fold = field.domain, _fold_radius(field, noise)
    if field.error > SURE:
        if fold < (CREDIBLE_SMOOTH if field.error < SMOOTH else CREDIBLE_NOISY) * asked.radius:
            return asked, (
                f"the map from contacts to charges seems to fold about {fold:.2g} mm from the centre, where two "
                "contacts give the same charges; the presses cannot tell it for certain, and the model is trained "
                f"across it, up to {asked.radius:g} mm; see 'isocharge simulate identify', then ask for a smaller "
                "radius or add an electrode",
            )
        fold = np.inf
    if fold < SMALLEST_SHARE * asked.radius:
        raise DatasetError(
            f"the map from contacts to charges folds {fold:g} mm from the centre, of {asked.radius:g} mm asked for: "
            "beyond, two contacts give the same charges; add an electrode, or take a biaxial film"
        )
    domain, cautions = asked, []
    if fold < asked.radius:
        domain = asked.within(fold)
        cautions.append(
            f"the map from contacts to charges folds beyond {fold:g} mm: two contacts give the same charges there; the "
            f"model is trained for {fold:g} mm, not {asked.radius:g} mm, on {len(presses.within(fold))} of "
            f"{len(presses)} presses"
        )
    if field.error < SMOOTH:
        inner = within(field, RIM * domain.radius)
        if pairs := find_ambiguous_pairs(inner, noise, asked.force_range[0], PAIR_PLACES).summary:
            which = "no model tells which of them it is; see 'isocharge simulate identify'"
            cautions.append(f"{pairs[0].lower()}{pairs[1:-1]}; {which}")
    return domain, tuple(cautions)


def _fold_radius(field: ChargeField, noise: NoiseModel) -> float:
    """Distance of the nearest fold from the centre, mm; infinite if there is none."""
    area = working_area(within(field, RIM * field.domain.radius), noise, search_pairs=False)
    return float(f"{area.unambiguous_radius:.6g}") if np.isfinite(area.fold_radius) else np.inf
