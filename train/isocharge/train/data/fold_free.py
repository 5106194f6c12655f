"""How far from the centre a dataset's map from contacts to charges can be turned back.

The simulator's search for folds, on the series fitted to the dataset, be that simulated or measured.
"""

from dataclasses import dataclass

import numpy as np

from isocharge.arrays import Array
from isocharge.simulate.identifiability.working_area import working_area
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.train.data.charge_field import ChargeField
from isocharge.train.data.domain import ContactDomain

SURE = 3e-4
"""Error of the fitted charges above which nothing is said: the slopes of a poor fit fold by themselves."""

RIM = 0.98
"""Share of the radius that is looked at: at the very rim no press holds the slopes from outside."""

SMALLEST_SHARE = 0.2
"""Share of the asked radius that has to be left for a training to make sense."""


@dataclass(frozen=True)
class FieldModel:
    """A `ChargeField` as the simulator's searches take it (`forward.charge_model.ChargeModel`): SI units.

    Attributes:
        field: The series.
    """

    field: ChargeField

    @property
    def radius(self) -> float:
        """Of the disk, m."""
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
    """The domain without what lies beyond the nearest fold; as it is if there is none, or if nobody can say."""
    if field.error > SURE:
        return field.domain
    area = working_area(FieldModel(field), noise, twins=False)
    if not np.isfinite(area.fold_radius):
        return field.domain
    return ContactDomain(float(f"{1e3 * area.unfolded:.6g}"), field.domain.force_range_N)
