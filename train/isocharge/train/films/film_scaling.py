"""Charge scales and contexts of films.

The context of a film contains the properties on which its scaled charges depend.

Let E be Young's modulus, h the thickness, d the geometric mean of d31 and d32, and g the gain of an electrode. The
charge Q of the electrode under a force F then has the following form:

    Q / (g d E)  =  function of F / (E h), of the position in the frame of the electrodes, and of the context.

The context contains the logarithms of three quantities: the ratio of the pretension to E, the ratio of d31 to d32, and
h. The context also contains the position of the film's centre in the frame of the electrodes, the rotation of the
electrodes, and the radius of the probe. The noise and the limits of the domain are the same for all films. After the
scaling, they depend on the scales of the charges and forces of a film. For this reason, the context also contains the
mean scale of the charges, the scale of the forces, and the gain of each electrode relative to the mean gain.
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
"""Number of films from which the mean and the standard deviation of the context are computed."""


class ContextStatistics(NamedTuple):
    """Mean and standard deviation of each value of the context over many films, both of shape (n_context,)."""

    mean: Array
    std: Array


@dataclass(frozen=True)
class FilmScaling:
    """Charge scales, contexts and coordinate transformations of films.

    Arrays of film parameters can have any number of leading dimensions.

    Attributes:
        prior: Distribution of the films.
        domain: Working area and range of forces, which define the unit coordinates.
    """

    prior: FilmPrior
    domain: Domain

    def log_charge_scale(self, parameters: Array) -> Array:
        """Compute the logarithms of the charge scales of the electrodes.

        The charge scale of an electrode is the product of three quantities: Young's modulus, the geometric mean of d31
        and d32, and the gain of the electrode. Each quantity is divided by its value for the described film.

        Args:
            parameters: Parameters of the films, shape (..., n_parameter).

        Returns:
            Logarithms of the charge scales, shape (..., n_electrode).
        """
        # These parameters are logarithms, so the sum of two parameters is the logarithm of a product.
        log_mean_piezo = 0.5 * (_shared(parameters, "d31") + _shared(parameters, "d32"))
        log_common_scale = _shared(parameters, "young") + log_mean_piezo
        return np.asarray(_log_gains(parameters) + log_common_scale[..., None])

    def rotation(self, parameters: Array) -> Array:
        """Compute the matrices T of `to_film`. Each matrix rotates positions by the angle of the electrodes.

        Args:
            parameters: Parameters of the films, shape (..., n_parameter).

        Returns:
            Matrices T, shape (..., 3, 3).
        """
        rotation = np.zeros((*parameters.shape[:-1], 3, 3))
        rotation[..., :2, :2] = _rotation_matrices(_shared(parameters, "rotation"))
        rotation[..., 2, 2] = 1.0
        return rotation

    def offset(self, parameters: Array) -> Array:
        """Compute the offset vectors o of `to_film` in unit coordinates.

        `to_film` converts a contact (x, y, ln F) on the described film into the corresponding contact on another film.
        The position moves with the electrodes, which are rotated and then displaced. The force is multiplied by k / k0,
        where k is the stiffness of the film, and k0 is that of the described film. The vector o is the constant part of
        this conversion: the displacement along x and y, and ln(k / k0).

        Args:
            parameters: Parameters of the films, shape (..., n_parameter).

        Returns:
            Vectors o, shape (..., 3).
        """
        # Position: a point p moves with the electrodes to R (p - s) + s + ds, where R is the rotation matrix, s is the
        # shift in the sensor file, and ds is the additional shift of the film. The part that does not depend on p is
        # s + ds - R s.
        described_shift = np.array(self.prior.sensor.calibration.shift)
        rotated_shift = _rotation_matrices(_shared(parameters, "rotation")) @ described_shift
        position_offset = described_shift + _shift(parameters) - rotated_shift

        # Force: the stiffness is Young's modulus times the thickness. Both parameters are logarithms of ratios.
        log_stiffness_ratio = _shared(parameters, "young") + _shared(parameters, "thickness")
        offset = np.concatenate([position_offset, log_stiffness_ratio[..., None]], axis=-1)  # in (x, y, ln F)
        return np.asarray(offset / self.domain.scale)  # in unit coordinates

    def to_film(self, parameters: Array, unit: Array) -> Array:
        """Convert the unit coordinates u on the described film into the unit coordinates T u + o on another film.

        The position moves with the electrodes, and the force is proportional to the stiffness.

        Args:
            parameters: Parameters of the films, shape (..., n_parameter).
            unit: Unit coordinates u on the described film, shape (..., 3).

        Returns:
            Unit coordinates on the other film, shape (..., 3).
        """
        rotated_unit = (self.rotation(parameters) @ unit[..., None])[..., 0]  # T u, with u as a column vector
        return np.asarray(rotated_unit + self.offset(parameters))

    def context(self, parameters: Array) -> Array:
        """Compute the standardised contexts of films.

        Each value is standardised with its mean and its standard deviation over the prior.

        Args:
            parameters: Parameters of the films, shape (..., n_parameter).

        Returns:
            Contexts, shape (..., n_context), where n_context is 9 + n_electrode.
        """
        return np.asarray((self._raw_context(parameters) - self.statistics.mean) / self.statistics.std)

    @cached_property
    def statistics(self) -> ContextStatistics:
        """Mean and standard deviation of each context value before standardisation, over films drawn from the prior."""
        raw_context = self._raw_context(self.prior.draw(np.random.default_rng(0), N_FILMS))
        return ContextStatistics(raw_context.mean(axis=0), raw_context.std(axis=0))

    def _raw_context(self, parameters: Array) -> Array:
        """Compute the contexts of films before they are standardised.

        The context of a film contains the pretension divided by Young's modulus, the ratio of d31 to d32, the
        thickness, the position (x, y) of the film's centre relative to the electrodes, the rotation of the electrodes,
        the probe radius, the mean scale of the charges, the stiffness, and the gains relative to their mean. All values
        except the position, the rotation and the probe radius are logarithms.

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

        # Centre of the film in the axes of the electrodes, relative to its described position. The additional last axis
        # makes each shift a column vector, shape (..., 2, 1).
        rotation_to_electrodes = _rotation_matrices(-_shared(parameters, "rotation"))
        rotated_shift = (rotation_to_electrodes @ shift[..., None])[..., 0]
        centre = described_shift - rotated_shift

        shared_columns = [
            np.log(strain + SOFTENING),  # the constant is added because a slack film has the strain 0
            _shared(parameters, "d31") - _shared(parameters, "d32"),
            _shared(parameters, "thickness"),
            centre[..., 0],
            centre[..., 1],
            _shared(parameters, "rotation"),
            _shared(parameters, "probe_radius"),
            self.log_charge_scale(parameters).mean(axis=-1),
            _shared(parameters, "young") + _shared(parameters, "thickness"),
        ]
        log_gains = _log_gains(parameters)
        log_relative_gains = log_gains - log_gains.mean(axis=-1, keepdims=True)
        return np.concatenate([np.stack(shared_columns, axis=-1), log_relative_gains], axis=-1)


def _shared(parameters: Array, name: str) -> Array:
    """Return the parameter with the given name, which all electrodes share, shape (...)."""
    return np.asarray(parameters[..., SHARED.index(name)])


def _log_gains(parameters: Array) -> Array:
    """Return ln(gain / gain of the described film) for each electrode, shape (..., n_electrode)."""
    return parameters[..., len(SHARED) :]


def _shift(parameters: Array) -> Array:
    """Return the displacement (x, y) of the electrodes from their described place, shape (..., 2), mm."""
    return np.stack([_shared(parameters, "shift_x"), _shared(parameters, "shift_y")], axis=-1)


def _rotation_matrices(angle: Array) -> Array:
    """Return the matrices, shape (..., 2, 2), that rotate anticlockwise by angles of shape (...), rad."""
    cosine = np.cos(angle)
    sine = np.sin(angle)
    first_row = np.stack([cosine, -sine], axis=-1)
    second_row = np.stack([sine, cosine], axis=-1)
    return np.stack([first_row, second_row], axis=-2)
