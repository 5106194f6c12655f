"""Scaling of the charges of films, and the context: the properties of a film on which the scaled charges depend.

E is Young's modulus, h is the thickness, d is the geometric mean of d31 and d32, and g is the gain of an electrode. The
charge Q of this electrode then has the form

    Q / (g d E)  =  function of F / (E h), of the position in the frame of the electrodes, and of the context.

The context contains the softened pretension over E, ln(d31 / d32), h, the position of the film's centre in the frame of
the electrodes, the rotation of the film, and the radius of the probe. The noise and the limits of the domain do not
scale with the film. The context therefore also contains the scales by which charges and forces are divided. The scales
are the scale of all charges, the scale of the force, and the gain of each electrode relative to the mean gain.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.forward.charge_map import Domain
from isocharge.simulate.forward.film_grid import SOFTENING
from isocharge.simulate.sensor.film_prior import SHARED, FilmPrior

N_FILMS = 4096
"""Number of films from which mean and standard deviation of the context are computed."""


class ContextStatistics(NamedTuple):
    """Mean and standard deviation of the context over the films, each of shape (n_context,)."""

    mean: Array
    std: Array


@dataclass(frozen=True)
class FilmScaling:
    """Exact scales and contexts of films. Parameters can have any leading dimensions.

    Attributes:
        prior: Distribution of the films.
        domain: Contacts, to which the unit coordinates refer.
    """

    prior: FilmPrior
    domain: Domain

    def log_charge_scale(self, parameters: Array) -> Array:
        """Compute the logarithms of those factors of the charges that follow exactly from the parameters.

        The factor of an electrode is the product of three ratios between the film and the described film: Young's
        modulus, the geometric mean of d31 and d32, and the gain of the electrode.

        Args:
            parameters: Parameters of the films, shape (..., n_parameter).

        Returns:
            Logarithms of the factors, shape (..., n_electrode).
        """
        mean_piezo = 0.5 * (_shared(parameters, "d31") + _shared(parameters, "d32"))
        common = _shared(parameters, "young") + mean_piezo
        return np.asarray(_gains(parameters) + common[..., None])

    def rotation(self, parameters: Array) -> Array:
        """Compute the matrix T of `to_film`, the rotation of the electrodes.

        Args:
            parameters: Parameters of the films, shape (..., n_parameter).

        Returns:
            Matrices T, shape (..., 3, 3).
        """
        rotation = np.zeros((*parameters.shape[:-1], 3, 3))
        rotation[..., :2, :2] = _rotation(_shared(parameters, "rotation"))
        rotation[..., 2, 2] = 1.0
        return rotation

    def offset(self, parameters: Array) -> Array:
        """Compute the vector o of `to_film` in unit coordinates.

        The electrodes are rotated about the origin and then displaced. The first two components of o are this
        displacement. The third component is the logarithm of the stiffness relative to the described film.

        Args:
            parameters: Parameters of the films, shape (..., n_parameter).

        Returns:
            Vectors o, shape (..., 3).
        """
        # A point p moves with the electrodes to R (p - s) + s + ds, where s is the shift in the sensor file and ds the
        # additional shift of the film. The part that does not depend on p is s + ds - R s.
        described_shift = np.array(self.prior.sensor.calibration.shift)
        rotated_shift = _rotation(_shared(parameters, "rotation")) @ described_shift
        position_offset = described_shift + _shift(parameters) - rotated_shift

        log_stiffness = _shared(parameters, "young") + _shared(parameters, "thickness")
        offset = np.concatenate([position_offset, log_stiffness[..., None]], axis=-1)  # x, y and ln F
        return np.asarray(offset / self.domain.scale)

    def to_film(self, parameters: Array, unit: Array) -> Array:
        """Transform unit coordinates u on the described film into unit coordinates on another film, T u + o.

        The position moves with the electrodes, and the force is proportional to the stiffness.

        Args:
            parameters: Parameters of the films, shape (..., n_parameter).
            unit: Unit coordinates u on the described film, shape (..., 3).

        Returns:
            Unit coordinates on the other film, shape (..., 3).
        """
        rotated = (self.rotation(parameters) @ unit[..., None])[..., 0]  # T u, with u as a column vector
        return np.asarray(rotated + self.offset(parameters))

    def context(self, parameters: Array) -> Array:
        """Compute the context of films, standardised over the prior.

        Args:
            parameters: Parameters of the films, shape (..., n_parameter).

        Returns:
            Contexts, shape (..., n_context), where n_context is 9 + n_electrode.
        """
        return np.asarray((self._raw_context(parameters) - self.statistics.mean) / self.statistics.std)

    @cached_property
    def statistics(self) -> ContextStatistics:
        """Mean and standard deviation of the context over films drawn from the prior."""
        raw = self._raw_context(self.prior.draw(np.random.default_rng(0), N_FILMS))
        return ContextStatistics(raw.mean(axis=0), raw.std(axis=0))

    def _raw_context(self, parameters: Array) -> Array:
        """Compute the numbers that describe films, before they are standardised.

        The numbers are the pretension strain, the ratio of d31 to d32, the thickness, the position (x, y) of the film
        relative to the electrodes, the rotation of the electrodes, the probe radius, the mean scale of the charges, the
        stiffness, and the gains relative to their mean. All except position, rotation and radius are logarithms.

        Args:
            parameters: Parameters of the films, shape (..., n_parameter).

        Returns:
            Contexts, shape (..., n_context).
        """
        film = self.prior.sensor.film
        described_shift = np.array(self.prior.sensor.calibration.shift)
        young = film.young * np.exp(_shared(parameters, "young"))
        strain = _shared(parameters, "pretension") / young
        shift = described_shift + _shift(parameters)

        # Centre of the film in the axes of the electrodes, relative to its described position. The shifts get a last
        # axis for the product of matrix and vector.
        rotation_to_electrodes = _rotation(-_shared(parameters, "rotation"))
        rotated_shift = (rotation_to_electrodes @ shift[..., None])[..., 0]
        centre = described_shift - rotated_shift

        shared_columns = [
            np.log(strain + SOFTENING),  # a slack film has the strain 0
            _shared(parameters, "d31") - _shared(parameters, "d32"),
            _shared(parameters, "thickness"),
            centre[..., 0],
            centre[..., 1],
            _shared(parameters, "rotation"),
            _shared(parameters, "probe_radius"),
            self.log_charge_scale(parameters).mean(axis=-1),
            _shared(parameters, "young") + _shared(parameters, "thickness"),
        ]
        gains = _gains(parameters)
        relative_gains = gains - gains.mean(axis=-1, keepdims=True)
        return np.concatenate([np.stack(shared_columns, axis=-1), relative_gains], axis=-1)


def _shared(parameters: Array, name: str) -> Array:
    """Return the parameter with this name, which does not belong to a single electrode, shape (...)."""
    return np.asarray(parameters[..., SHARED.index(name)])


def _gains(parameters: Array) -> Array:
    """Return the logarithms of the gains, shape (..., n_electrode)."""
    return parameters[..., len(SHARED) :]


def _shift(parameters: Array) -> Array:
    """Return the shift of the electrodes, shape (..., 2), mm."""
    return np.stack([_shared(parameters, "shift_x"), _shared(parameters, "shift_y")], axis=-1)


def _rotation(angle: Array) -> Array:
    """Return matrices, shape (..., 2, 2), of rotations by angles of shape (...), rad, anticlockwise."""
    cosine = np.cos(angle)
    sine = np.sin(angle)
    first_row = np.stack([cosine, -sine], axis=-1)
    second_row = np.stack([sine, cosine], axis=-1)
    return np.stack([first_row, second_row], axis=-2)
