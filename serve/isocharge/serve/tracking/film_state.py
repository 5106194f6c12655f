"""State of a film that changes after its calibration, its prior, and its estimate from touches.

The state is a vector of these unknowns:

- the change t of the mean pretension, MPa, and the changes z along the uncertain directions of the film
  (`isocharge.serve.model.charge_series`),
- the logarithm of the change of the gain of each electrode,
- a common offset, pC. This charge is added to all electrodes during a touch, for example by a warm finger.

All touches share the state, and each touch has a contact that is not known. The charges of four electrodes have one
degree of freedom more than a contact. The state with which the charges of the touches can be explained best is found by
`robust_estimate`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.model.charge_series import ChargeSeries
from isocharge.serve.model.robust_estimate import ModelValues, Prior, RobustEstimate, robust_estimate

GAIN_STD = 0.003
"""Scale of the prior of the change of a gain. The prior has heavy tails, because one gain may change by percents."""

OFFSET_STD_RATIO = 0.05
"""Scale of the prior of the common offset, relative to the largest offset. The prior has heavy tails."""

SMALLEST_TENSION_STD_MPa = 1e-4
"""Smallest standard deviation of the prior of the pretension, MPa. The covariance of the prior stays invertible."""

SMALLEST_OFFSET_STD_pC = 1e-3
"""Smallest scale of the prior of the common offset, pC, for touches without offsets."""

HEAVY_TAIL_FREEDOM = 2.0
"""Degrees of freedom of the heavy-tailed priors (Student's t distribution)."""

OFFSET_SCATTER = 0.5
"""Standard deviation of the offset of a single touch about the common offset, relative to the common offset."""

MAX_DIRECTION = 5.0
"""Largest change along a direction, in standard deviations."""

MAX_LOG_GAIN = 0.3
"""Largest logarithm of the change of a gain."""

FORCE_MARGIN = 1.5
"""Factor by which the force of a touch may exceed the range of forces of the charge map."""

SECONDS_PER_HOUR = 3600.0

NO_CHANGE_PROBABILITY = 0.5
"""Probability before the first touch that the pretension has not changed since the calibration."""

MAX_LOG_ODDS = 50.0
"""Largest magnitude of the logarithm of odds."""


class Touch(NamedTuple):
    """A touch, described by its charges near the largest force.

    Attributes:
        charge_pC: Average touch charges, shape (n_electrode,), pC.
        variance_pC2: Variance of the noise of the average charges, shape (n_electrode,), pC^2.
        contact: Contact (x, y, F) from which the search starts, shape (3,), mm and N.
        clock_s: Time of the touch, s.
    """

    charge_pC: Array
    variance_pC2: Array
    contact: Array
    clock_s: float


@dataclass(frozen=True)
class FilmModel:
    """Charges of touches on a film that has changed since its calibration, and the prior of the changes.

    Attributes:
        series: Charge map of the film.
        offset_ratio: Charge that an offset adds to each electrode, relative to the common offset, shape (n_electrode,).
        drift_MPa_per_root_hour: Standard deviation of the change of the pretension in an hour, MPa.
        largest_offset_pC: Largest tolerated standard deviation of the common offset, pC; 0 if touches have no offset.
    """

    series: ChargeSeries
    offset_ratio: Array
    drift_MPa_per_root_hour: float
    largest_offset_pC: float

    @property
    def film(self) -> slice:
        """Slice of the state of the film (t, z_1, ..., z_K) in the state."""
        return slice(0, 1 + self.series.direction_count)

    @property
    def gains(self) -> slice:
        """Slice of the logarithms of the gains in the state."""
        return slice(self.film.stop, self.film.stop + len(self.series.electrodes))

    @property
    def offset(self) -> int:
        """Index of the common offset in the state."""
        return int(self.gains.stop)

    @property
    def size(self) -> int:
        """Number of unknowns in the state."""
        return self.offset + 1

    def values(self, contacts: Array, state: Array) -> ModelValues:
        """Compute the charges of touches and their derivatives.

        Args:
            contacts: Contacts (x, y, ln F), shape (n, 3), mm and the logarithm of N.
            state: State, shape (size,).
        """
        film = self.series.changes(np.column_stack([contacts[:, :2], np.exp(contacts[:, 2])]), state[self.film])
        gains = np.exp(state[self.gains])
        film_charge_pC = film.charge_pC * gains
        by_state = np.zeros((*film_charge_pC.shape, self.size))
        by_state[:, :, self.film] = film.by_state * gains[:, None]
        by_state[:, :, self.gains] = film_charge_pC[:, :, None] * np.eye(gains.size)
        by_state[:, :, self.offset] = self.offset_ratio
        charge_pC = film_charge_pC + state[self.offset] * self.offset_ratio
        return ModelValues(charge_pC, film.by_contact * gains[:, None], by_state)

    def prior(self, elapsed_s: float) -> Prior:
        """Return the prior of the state.

        Args:
            elapsed_s: Time since the stream began, s. The pretension may have drifted in this time.
        """
        std = np.ones(self.size)
        drift_MPa = self.drift_MPa_per_root_hour * np.sqrt(elapsed_s / SECONDS_PER_HOUR)
        std[0] = max(np.hypot(self.series.tension_std_MPa, drift_MPa), SMALLEST_TENSION_STD_MPa)
        std[self.gains] = GAIN_STD
        std[self.offset] = max(OFFSET_STD_RATIO * self.largest_offset_pC, SMALLEST_OFFSET_STD_pC)
        freedom = np.full(self.size, np.inf)
        freedom[self.gains] = HEAVY_TAIL_FREEDOM
        freedom[self.offset] = HEAVY_TAIL_FREEDOM
        return Prior(np.zeros(self.size), np.diag(std**2), freedom)

    def touch_covariance(self, state: Array, covariance: Array) -> Array:
        """Return the covariance of the state of a single touch, whose offset scatters about the common offset.

        Args:
            state: State that many touches share, shape (size,).
            covariance: Covariance of this state, shape (size, size).
        """
        touch_covariance = covariance.copy()
        touch_covariance[self.offset, self.offset] += (OFFSET_SCATTER * state[self.offset]) ** 2
        return touch_covariance

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Smallest and largest state, each of shape (size,)."""
        largest = np.full(self.size, MAX_DIRECTION)
        largest[self.gains] = MAX_LOG_GAIN
        largest[self.offset] = np.inf
        smallest = -largest
        smallest[0] = self.series.node_MPa[0]
        largest[0] = self.series.node_MPa[-1]
        return smallest, largest

    @property
    def contact_bounds(self) -> tuple[Array, Array]:
        """Smallest and largest contact (x, y, ln F), each of shape (3,)."""
        radius_mm = self.series.domain.radius
        smallest_N, largest_N = self.series.domain.force_range
        lowest = np.array([-radius_mm, -radius_mm, np.log(smallest_N / FORCE_MARGIN)])
        highest = np.array([radius_mm, radius_mm, np.log(largest_N * FORCE_MARGIN)])
        return lowest, highest

    def estimate(self, touches: Sequence[Touch], state: Array, contacts: Array, elapsed_s: float) -> RobustEstimate:
        """Estimate the state and the contacts of touches.

        The charges of a touch have three errors: their noise, the part of the charges that the charge map does not
        describe, and the deviation of the state from the state at the latest touch. The pretension may have drifted
        since the touch, and the offset scatters from touch to touch.

        Args:
            touches: The latest touches.
            state: State from which the search starts, shape (size,).
            contacts: Contacts (x, y, ln F) from which the search starts, shape (n, 3).
            elapsed_s: Time since the stream began, s.
        """
        charge_pC = np.array([touch.charge_pC for touch in touches])
        variance_pC2 = np.array([touch.variance_pC2 for touch in touches])
        age_s = touches[-1].clock_s - np.array([touch.clock_s for touch in touches])
        values = self.values(contacts, state)

        model_error_pC = self.series.charge_std * values.charge_pC
        drift_MPa = self.drift_MPa_per_root_hour * np.sqrt(np.maximum(age_s, 0.0) / SECONDS_PER_HOUR)
        drift_pC = drift_MPa[:, None] * values.by_state[:, :, 0]
        scatter_pC = OFFSET_SCATTER * state[self.offset] * self.offset_ratio
        covariance_pC2 = (
            (variance_pC2 + model_error_pC**2)[:, :, None] * np.eye(len(self.offset_ratio))
            + drift_pC[:, :, None] * drift_pC[:, None, :]
            + np.outer(scatter_pC, scatter_pC)
        )
        return robust_estimate(
            self.values,
            charge_pC,
            covariance_pC2,
            self.prior(elapsed_s),
            state,
            contacts,
            contact_bounds=self.contact_bounds,
            state_bounds=self.bounds,
        )

    def averaged_over_no_change(self, estimate: RobustEstimate, elapsed_s: float) -> tuple[Array, Array]:
        """Return the mean and the covariance of the state if the pretension may not have changed at all.

        The probability of no change is `NO_CHANGE_PROBABILITY` before the touches. The touches change its odds by the
        ratio of the probability densities of t = 0 after and before them (Savage-Dickey ratio, Dickey 1971).

        Args:
            estimate: Estimate of the state from touches, with a pretension that has changed.
            elapsed_s: Time since the stream began, s.
        """
        state, covariance = estimate.state, estimate.covariance
        variance = covariance[0, 0]
        prior_variance = self.prior(elapsed_s).covariance[0, 0]
        log_ratio = 0.5 * (np.log(prior_variance / variance) - state[0] ** 2 / variance)
        log_odds = log_ratio + np.log(NO_CHANGE_PROBABILITY / (1.0 - NO_CHANGE_PROBABILITY))
        probability = 1.0 / (1.0 + np.exp(-np.clip(log_odds, -MAX_LOG_ODDS, MAX_LOG_ODDS)))

        # Without a change, the other unknowns have their conditional distribution for t = 0.
        gain = covariance[:, 0] / variance
        shift = gain * state[0]
        unchanged_covariance = covariance - np.outer(gain, covariance[0])
        mixed = (1.0 - probability) * covariance + probability * unchanged_covariance
        mixed += probability * (1.0 - probability) * np.outer(shift, shift)
        return state - probability * shift, mixed
