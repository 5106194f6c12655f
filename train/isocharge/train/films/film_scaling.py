"""What a film's parameters do to its charges exactly, and the context by which a network knows the rest.

With E h the stretching stiffness, d the geometric mean of d31 and d32, and g the gain of an electrode,

    Q / (g d E)  =  function of F / (E h), of the place in the frame of the electrodes, and of the context:

the softened pretension over E, ln d31/d32, h, where the film's centre lies in that frame, its rotation, and the
probe's radius. The noise and the ends of the domain do not scale along, so the context also has the scales that were
divided out: of all charges, of the force, and each gain about their mean.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.forward.charge_map import Domain
from isocharge.simulate.forward.film_grid import SOFTENING
from isocharge.simulate.sensor.film_prior import SHARED, FilmPrior

DRAWS = 4096
"""Films drawn to standardise the context."""


@dataclass(frozen=True)
class FilmScaling:
    """The exact scales of films, and their context, for parameters of any leading shape.

    Attributes:
        prior: The films.
        domain: The contacts; unit coordinates refer to it.
    """

    prior: FilmPrior
    domain: Domain

    def log_charge_scale(self, parameters: Array) -> Array:
        """ln of the charges' exact factors, 1 for the described film: (..., n_parameter) to (..., n_electrode)."""
        common = _of(parameters, "young") + 0.5 * (_of(parameters, "d31") + _of(parameters, "d32"))
        return np.asarray(parameters[..., len(SHARED) :] + common[..., None])

    def rotation(self, parameters: Array) -> Array:
        """Matrix T of `to_film`, (..., n_parameter) to (..., 3, 3): the rotation of the electrodes."""
        rotation = np.zeros((*parameters.shape[:-1], 3, 3))
        rotation[..., :2, :2] = _rotation(_of(parameters, "rotation"))
        rotation[..., 2, 2] = 1.0
        return rotation

    def offset(self, parameters: Array) -> Array:
        """Offset o of `to_film`, (..., n_parameter) to (..., 3)."""
        described = np.array(self.prior.sensor.calibration.shift)
        moved = described + _shift(parameters) - _rotation(_of(parameters, "rotation")) @ described
        stiffness = _of(parameters, "young") + _of(parameters, "thickness")
        return np.asarray(np.concatenate([moved, stiffness[..., None]], axis=-1) / self.domain.scale)

    def to_film(self, parameters: Array, unit: Array) -> Array:
        """Unit coordinates on the described film with the scales divided out, (..., 3), to those on the film: T u + o.

        The place is carried along by the electrodes; the force grows with the stiffness.
        """
        return np.asarray((self.rotation(parameters) @ unit[..., None])[..., 0] + self.offset(parameters))

    def context(self, parameters: Array) -> Array:
        """What a network knows of a film, standardised over the films: (..., n_parameter) to (..., 9 + n_electrode)."""
        centre, spread = self.standard
        return np.asarray((self._raw_context(parameters) - centre) / spread)

    @cached_property
    def standard(self) -> tuple[Array, Array]:
        """Means and standard deviations of the context over the films, each of shape (9 + n_electrode,)."""
        raw = self._raw_context(self.prior.draw(np.random.default_rng(0), DRAWS))
        return raw.mean(axis=0), raw.std(axis=0)

    def _raw_context(self, parameters: Array) -> Array:
        film, described = self.prior.sensor.film, np.array(self.prior.sensor.calibration.shift)
        strain = _of(parameters, "pretension") / (film.young * np.exp(_of(parameters, "young")))
        back = _rotation(-_of(parameters, "rotation"))
        centre = described - (back @ (described + _shift(parameters))[..., None])[..., 0]
        gains = parameters[..., len(SHARED) :]
        columns = [
            np.log(strain + SOFTENING),
            _of(parameters, "d31") - _of(parameters, "d32"),
            _of(parameters, "thickness"),
            centre[..., 0],
            centre[..., 1],
            _of(parameters, "rotation"),
            _of(parameters, "probe_radius"),
            self.log_charge_scale(parameters).mean(axis=-1),
            _of(parameters, "young") + _of(parameters, "thickness"),
        ]
        return np.concatenate([np.stack(columns, axis=-1), gains - gains.mean(axis=-1, keepdims=True)], axis=-1)


def _of(parameters: Array, name: str) -> Array:
    """One of the parameters that all films share, shape (...)."""
    return np.asarray(parameters[..., SHARED.index(name)])


def _shift(parameters: Array) -> Array:
    return np.stack([_of(parameters, "shift_x"), _of(parameters, "shift_y")], axis=-1)


def _rotation(angle: Array) -> Array:
    """Matrices of shape (..., 2, 2) for rotations by angles (...), rad, anticlockwise."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)
