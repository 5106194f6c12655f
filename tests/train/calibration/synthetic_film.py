"""A film whose charges are a closed formula, in place of a solved film.

The logarithm of a charge is linear in the properties of the film and in ln F, and the effects of the properties are
linear in the position and in ln F:

    ln Q_e = a + 0.7 ln F + d_e p / L + sum_k v_k (c_ke + s_ke p / L + t_ke ln F),

with the position p, the direction d_e of the electrode, and the deviation v_k of a property from its mean.
"""

from dataclasses import dataclass

import numpy as np

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
    def effects(self):
        """Derivatives of ln Q: constants, slopes in x, y and ln F, each of shape (n_property, n_electrode)."""
        rng = np.random.default_rng(0)
        shape = (len(self.prior.names), len(self.prior.sensor.electrode_names))
        constant, by_x, by_y, by_force = EFFECT * rng.standard_normal((4, *shape)) / self.prior.std[:, None]
        constant[self.prior.index("pretension")] = -0.2  # a taut film gives smaller charges
        return constant, 0.5 * by_x / LENGTH_MM, 0.5 * by_y / LENGTH_MM, 0.15 * by_force

    def linearised(self, values, contact):
        x, y, force = contact.T
        log_force = np.log(force)
        constant, by_x, by_y, by_force = self.effects
        outer = np.multiply.outer
        effect = constant + outer(x, by_x) + outer(y, by_y) + outer(log_force, by_force)
        log_charge = np.log(600.0) + 0.7 * log_force[:, None] + contact[:, :2] @ self._directions.T
        charge = np.exp(log_charge + np.einsum("k,nke->ne", values - self.prior.mean, effect))
        return charge, charge[:, :, None] * effect.swapaxes(1, 2)

    def charges(self, values, contact):
        return self.linearised(values, contact)[0]

    def contact_slopes(self, values, contact):
        charge, _ = self.linearised(values, contact)
        _, by_x, by_y, by_force = (np.tensordot(values - self.prior.mean, effect, 1) for effect in self.effects)
        slopes = np.column_stack([self._directions + np.column_stack([by_x, by_y]), 0.7 + by_force])
        return charge[:, :, None] * slopes

    @property
    def _directions(self):
        centres = np.array([electrode.centre for electrode in self.prior.sensor.electrodes])
        return centres / np.linalg.norm(centres, axis=1, keepdims=True) / LENGTH_MM
