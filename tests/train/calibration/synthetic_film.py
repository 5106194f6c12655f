"""A film whose charges are a closed formula, in place of a solved film.

The logarithm of a charge is linear in the properties of the film and in ln F, and the effects of the properties are
linear in the position and in ln F:

    ln Q_e = a + 0.7 ln F + d_e p / L + sum_k v_k (c_ke + s_ke p / L + t_ke ln F),

with the position p, the direction d_e of the electrode, and the deviation v_k of a property from its mean.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from isocharge.common.contact_domain import with_log_force
from isocharge.simulate import Domain

LENGTH_MM = 7.0
"""Distance over which a charge changes by a factor e."""

EFFECT = 0.08
"""Typical relative effect of one standard deviation of a property on a charge."""


@dataclass(frozen=True)
class SyntheticFilm:
    """Charges of similar films, with the interface of `FilmCharges` that the estimator uses.

    Attributes:
        prior: Declarations of the properties.
        domain: Contacts for which the charges are known.
    """

    prior: object
    domain: Domain

    @property
    def values(self):
        return self.prior.mean

    @property
    def even(self):
        return self

    @cached_property
    def effects(self):
        """Derivatives of the coefficients with respect to the properties, shape (4, n_property, n_electrode)."""
        shape = (4, len(self.prior.names), len(self.prior.sensor.electrode_names))
        effects = EFFECT * np.random.default_rng(0).standard_normal(shape) / self.prior.std[:, None]
        effects *= np.reshape([1.0, 0.5 / LENGTH_MM, 0.5 / LENGTH_MM, 0.15], (4, 1, 1))
        effects[0, self.prior.index("pretension")] = -0.2  # a taut film gives smaller charges
        return effects

    def coefficients(self, values):
        """Coefficients of ln Q of a film in 1, x, y and ln F, shape (4, n_electrode)."""
        centres = np.array([electrode.centre for electrode in self.prior.sensor.electrodes])
        x, y = centres.T / np.hypot(*centres.T) / LENGTH_MM
        mean_film = np.array([np.full(len(x), np.log(600.0)), x, y, np.full(len(x), 0.7)])
        return mean_film + np.einsum("k,fke->fe", values - self.prior.mean, self.effects)

    def linearised(self, values, contact):
        terms = np.column_stack([np.ones(len(contact)), with_log_force(contact)])
        coefficients = self.coefficients(values)
        charge = np.exp(terms @ coefficients)
        contact_slopes = charge[:, :, None] * coefficients[1:].T
        return charge, contact_slopes, charge[:, :, None] * np.einsum("nf,fke->nek", terms, self.effects)

    def charges(self, values, contact):
        return self.linearised(values, contact)[0]
