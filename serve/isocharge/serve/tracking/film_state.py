"""Estimated state of a film, which the module `film_follower` computes from touches."""

from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array


class FilmStateEstimate(NamedTuple):
    """Estimate of the pretension of a film, and of the changes of the film along its uncertain directions.

    Attributes:
        pretension_MPa: Estimate of the pretension, MPa.
        std_MPa: Standard deviation of the pretension, MPa.
        directions: Estimated coordinates along the directions at the estimated pretension, shape (n_direction,), in
            standard deviations.
        directions_per_MPa: Derivative of `directions` with respect to the pretension, shape (n_direction,), 1/MPa.
    """

    pretension_MPa: float
    std_MPa: float
    directions: Array
    directions_per_MPa: Array

    def charge_ratio(self, log_changes: Array, change_MPa: float = 0.0) -> Array:
        """Compute the ratio of the charges of the estimated film to the charges of the calibrated film.

        The ratio contains only the effect of the changes along the directions, because both films are assumed to have
        the same pretension.

        Args:
            log_changes: Changes of ln Q by one unit of each direction, shape (n_direction, n_electrode).
            change_MPa: Pretension for which the ratio is computed, minus the estimated pretension, MPa.

        Returns:
            Ratios, shape (n_electrode,), dimensionless.
        """
        directions = self.directions + change_MPa * self.directions_per_MPa
        return np.asarray(np.exp(directions @ log_changes))
