"""How far from the centre a dataset's map from contacts to charges can be turned back.

The simulator's search for folds and for contacts far apart with the same charges, on the series fitted to the dataset,
be that simulated or measured.
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.forward.charge_model import within_radius
from isocharge.simulate.identifiability.ambiguities import AmbiguousPairs, find_ambiguous_pairs
from isocharge.simulate.identifiability.working_area import working_area
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.train.data.charge_field import ChargeField
from isocharge.train.data.domain import ContactDomain

SURE = 3e-4
"""Largest error of the fitted charges, relative, for which a fold is certain: a poor fit has folds of its own."""

SMOOTH = 2e-3
"""Largest error of a poor fit to charges without noise, relative."""

CREDIBLE_SMOOTH, CREDIBLE_NOISY = 0.95, 0.8
"""Share of the radius within which a fold of a poor fit is believed: its own folds lie at the rim, where presses hold
it from one side only, and noise moves them inwards."""

RIM = 0.98
"""Searched radius over the domain's, dimensionless: at the very rim no press holds the slopes from outside."""

TWIN_PLACES = 400
"""Places from which contacts with the same charges are looked for; 400 take half a second."""

SMALLEST_SHARE = 0.2
"""Smallest fold-free radius over the dataset's, dimensionless, for which a training makes sense."""


@dataclass(frozen=True)
class FieldModel:
    """A `ChargeField` as the simulator's searches take it (`forward.charge_model.ChargeModel`): SI units.

    Attributes:
        field: The series.
    """

    field: ChargeField

    @property
    def radius(self) -> float:
        """Largest distance of a contact from the centre, m."""
        return 1e-3 * RIM * self.field.domain.radius_mm

    @property
    def force_range(self) -> tuple[float, float]:
        """N."""
        return self.field.domain.force_range_N

    def charge(self, contact: Array) -> Array:
        """(x, y, F), (n, 3), m and N, to (n, n_electrode), C."""
        return 1e-12 * self.field.charge_pC(contact * [1e3, 1e3, 1.0])

    def jacobian(self, contact: Array) -> Array:
        """d(Q)/d(x, y, ln F): (n, 3) to (n, n_electrode, 3), C/m, C/m and C."""
        domain = self.field.domain
        logs = self.field.log_charge(domain.to_unit(contact * [1e3, 1e3, 1.0]))
        slope = 1e-12 * np.exp(logs[:, :1]) * logs[:, 1:] * (np.array([1e3, 1e3, 1.0]) / domain.scale)[:, None]
        by_contact: Array = slope.transpose(0, 2, 1)
        return by_contact


def fold_free_domain(field: ChargeField, noise: NoiseModel) -> ContactDomain:
    """The field's domain up to the nearest fold; all of it without folds, or where the fit is too poor."""
    fold_mm = np.inf if field.error > SURE else _fold_mm(field, noise)
    return ContactDomain(min(fold_mm, field.domain.radius_mm), field.domain.force_range_N)


def probable_fold_mm(field: ChargeField, noise: NoiseModel) -> float:
    """Distance of a fold that a fit shows which is too poor to be certain of it, mm; infinite if there is none.

    Measured charges have more noise than `SURE`, and few presses fit an electrode within the working area poorly.
    """
    if field.error <= SURE:
        return np.inf
    credible = CREDIBLE_SMOOTH if field.error < SMOOTH else CREDIBLE_NOISY
    fold_mm = _fold_mm(field, noise)
    return fold_mm if fold_mm < credible * field.domain.radius_mm else np.inf


def twins_within(field: ChargeField, noise: NoiseModel, radius_mm: float) -> AmbiguousPairs:
    """Contacts far apart, within a radius (mm), whose charges differ by less than the noise; none where the fit is too
    poor to tell."""
    if field.error >= SMOOTH:
        return AmbiguousPairs.none()
    model = FieldModel(field)
    inside = within_radius(model, min(1e-3 * RIM * radius_mm, model.radius))
    return find_ambiguous_pairs(inside, noise, inside.force_range[0], TWIN_PLACES)


def _fold_mm(field: ChargeField, noise: NoiseModel) -> float:
    area = working_area(FieldModel(field), noise, twins=False)
    return float(f"{1e3 * area.unfolded:.6g}") if np.isfinite(area.fold_radius) else np.inf
