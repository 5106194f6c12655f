"""Estimation of the noise in measured presses from the presses themselves.

For each press, a plane is fitted to the charges of its neighbours, which are the presses with the most similar
positions and forces. The plane predicts the charges of the press. The residuals of the prediction are attributed to the
noise of the channels, although they also contain the errors of the measured positions and forces. The variance of the
noise of a channel is modelled as white^2 + (gain * Q)^2, with the charge Q and two parameters, white and gain.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls
from scipy.spatial import cKDTree

from isocharge.common.arrays import Array
from isocharge.simulate import NoiseModel

NEIGHBOURS = 16
"""Number of presses to which a plane is fitted, which is four times the number of its coefficients."""

LEAST_CONTACTS = 8
"""Smallest number of different contacts to which a plane is fitted, which is twice the number of its coefficients."""

MIN_REPEATED_PRESSES = 100
"""Number of presses at repeated contacts from which the noise is estimated from these presses only.

The standard deviation of the noise of a channel is then known to about 10 %."""

SAME_CONTACT_DECIMALS = 3
"""Decimals of the unit coordinates in which two contacts agree if they count as the same contact."""

ROUNDS = 10
"""Number of weighted least-squares fits. The variances of each fit determine the weights of the next fit."""

TINY = 1e-30
"""Smallest divisor, so that no division by zero occurs."""

OUTLIER = 3.0
"""Number of standard deviations to which residuals are clipped, because larger residuals are not due to noise."""

LEAST_SHARE = 0.01
"""Smallest white noise of a channel, relative to the noise of its gain at a charge of the usual size.

The lower limit is needed because the presses do not determine the white noise if no charge is small.
"""

BOTH_SIGNS = 0.01
"""Fraction of the charges with the rarer sign above which a channel counts as one with charges of both signs."""

MIN_TRANSITION_RATIO = 0.5
"""Smallest `ChannelNoise.transition_charge` of a channel with both signs, relative to the usual size of its charges.

With a smaller value, the features of charges with little noise would have a kink where the charge changes its sign.
"""

LARGEST_EXPONENT = 50.0
"""Largest argument of the hyperbolic sine in the conversion of levels to charges, which limits the charges."""

LEAST_GAIN = 1e-4
"""Smallest relative noise of the gain, which is that of a good amplifier.

With a smaller value, the level asinh(gain Q / white) / gain would be practically equal to Q / white.
"""

CANDIDATES = 8
"""Number of planes that are compared in the search for the nearest point of all planes."""


@dataclass(frozen=True)
class ChannelNoise:
    """A noise model with separate parameters for each channel.

    Attributes:
        white: Constant part of the standard deviation, shape (n_electrode,), pC.
        gain: Part of the standard deviation that is proportional to the charge, shape (n_electrode,), dimensionless.
        name: Name of the noise model.
    """

    white: Array
    gain: Array
    name: str = "measured"

    @classmethod
    def estimate(cls, charge: Array, unit_contact: Array) -> "ChannelNoise":
        """Estimate the noise of each channel from measured presses.

        If contacts are repeated, the residuals are the differences between the repeated charges and their means. They
        contain only noise. Otherwise, a plane through the neighbours of a press estimates the charges of the press
        without noise. The residuals are then the differences between the measured and the estimated charges, and also
        contain the curvature of the map from contacts to charges. The white noise and the noise of the gain are
        fitted to these residuals. Both kinds of noise have lower limits.

        Args:
            charge: Measured charges, shape (n, n_electrode), pC.
            unit_contact: Contacts in unit coordinates, shape (n, 3).

        Returns:
            Noise model with the white noise and the noise of the gain of each channel.
        """
        size, residual = _repeated_residuals(unit_contact, charge)
        if len(residual) < MIN_REPEATED_PRESSES:
            planes = LocalPlanes.fit(unit_contact, charge)
            size = planes.value
            residual = planes.residual
        channel_variances = [
            _fit_variances(channel_size, channel_residual)
            for channel_size, channel_residual in zip(size.T, residual.T, strict=True)
        ]
        white_std, gain_std = np.sqrt(np.array(channel_variances)).T  # each of shape (n_electrode,)
        gain = np.maximum(gain_std, LEAST_GAIN)
        # The presses do not determine the white noise if all charges are large. Its lower limit is a small fraction of
        # the noise of the gain at the usual charge.
        smallest_white = LEAST_SHARE * gain * usual_size(charge)
        white = np.maximum(white_std, smallest_white)
        return cls(white, gain)

    @classmethod
    def alike(cls, noise: NoiseModel, electrodes: int) -> "ChannelNoise":
        """Create a noise model with the same noise on every electrode.

        Args:
            noise: Noise of each electrode.
            electrodes: Number of electrodes.
        """
        gain = max(noise.gain, LEAST_GAIN)
        return cls(np.full(electrodes, noise.white), np.full(electrodes, gain), noise.name)

    def sigma(self, charge: Array) -> Array:
        """Return the standard deviation of the noise, pC, of each charge, pC. Both have the shape (n, n_electrode)."""
        return np.asarray(np.hypot(self.white, self.gain * charge))

    def add(self, charge: Array, rng: np.random.Generator) -> Array:
        """Add random noise to charges, pC. Charges and result have the shape (n, n_electrode)."""
        return np.asarray(charge + self.sigma(charge) * rng.standard_normal(charge.shape))

    def level(self, charge: Array) -> Array:
        """Convert charges Q, shape (n, n_electrode), pC, into the levels asinh(gain Q / white) / gain.

        The noise of every level has a standard deviation of about 1.
        """
        return np.asarray(np.arcsinh(charge * self.gain / self.white) / self.gain)

    def charge(self, level: Array) -> Array:
        """Convert levels into charges, pC. This method is the inverse of `level`."""
        exponent = np.clip(level * self.gain, -LARGEST_EXPONENT, LARGEST_EXPONENT)
        return np.asarray(np.sinh(exponent) * self.white / self.gain)

    def transition_charge(self, charge: Array) -> Array:
        """Return the transition charge of each channel, shape (n_electrode,), pC.

        The inputs of the network are asinh(Q / transition charge). They are nearly linear in charges Q below the
        transition charge, and nearly logarithmic above it. The transition charge is the charge above which the noise is
        mostly proportional to the charge. For a channel with charges of both signs, it also has a lower limit.

        Args:
            charge: Charges of presses, shape (n, n_electrode), pC.
        """
        positive_share = np.mean(charge > 0.0, axis=0)  # shape (n_electrode,)
        negative_share = np.mean(charge < 0.0, axis=0)
        has_both_signs = np.minimum(positive_share, negative_share) > BOTH_SIGNS
        # Without this lower limit, asinh would have a kink at the charge 0 for a channel with little noise.
        smallest_transition = np.where(has_both_signs, MIN_TRANSITION_RATIO * usual_size(charge), 0.0)
        # Below this charge, the noise is mostly white, and above it mostly proportional to the charge.
        noise_corner = self.white / self.gain
        return np.asarray(np.maximum(noise_corner, smallest_transition))

    def scaled(self, factor: float) -> "ChannelNoise":
        """Multiply all standard deviations by a factor, and return the new noise model."""
        return ChannelNoise(factor * self.white, factor * self.gain, self.name)

    def to_dict(self) -> dict[str, object]:
        """Return the noise model as it is stored in the metadata of a model."""
        return {
            "name": self.name,
            "white_pC": [float(f"{white:.4g}") for white in self.white],
            "gain": [float(f"{gain:.4g}") for gain in self.gain],
        }


@dataclass(frozen=True)
class LocalPlanes:
    """One plane for each press, which is fitted to the neighbours of the press but not to the press itself.

    Neighbours with the same contact are averaged.

    Attributes:
        value: Value of the plane at the press, shape (n, k).
        slope: Derivatives of the values with respect to the unit coordinates, shape (n, k, 3).
        residual: Difference between the values of the press and of the plane, shape (n, k). It is divided by sqrt(1 +
            v), where v is the variance of the plane if the values of the neighbours have the variance 1.
        reach: Distance of the farthest neighbours in unit coordinates, shape (n,).
    """

    value: Array
    slope: Array
    residual: Array
    reach: Array

    @classmethod
    def fit(cls, unit_contact: Array, values: Array) -> "LocalPlanes":
        """For each press, fit a plane to the values of its neighbours by least squares.

        The plane is a linear function from the unit coordinates of a contact to the k values. The press itself is not
        used in the fit, so that its residual is independent of the plane. The residuals are scaled so that their
        variance is equal to that of the noise of the values.

        Args:
            unit_contact: Contacts in unit coordinates, shape (n, 3).
            values: Values at the contacts, such as charges, shape (n, k).

        Returns:
            The planes, one for each press.
        """
        # Average the presses of each contact: a rig may repeat a contact more often than a plane has neighbours.
        _, contact_of_press, press_count = np.unique(
            np.round(unit_contact, SAME_CONTACT_DECIMALS), axis=0, return_inverse=True, return_counts=True
        )
        contact_sum, value_sum = (
            np.stack([np.bincount(contact_of_press, column) for column in table.T], axis=1)
            for table in (unit_contact, values)
        )
        distance, nearest = cKDTree(contact_sum / press_count[:, None]).query(
            unit_contact, min(NEIGHBOURS + 1, len(press_count))
        )  # both of shape (n, number of contacts of a plane)
        is_own = nearest == contact_of_press[:, None]
        count = press_count[nearest] - is_own  # the press itself is left out
        mean_divisor = np.maximum(count, 1)[..., None]
        own = is_own[..., None]
        offsets = (contact_sum[nearest] - own * unit_contact[:, None]) / mean_divisor - unit_contact[:, None]
        neighbour_values = (value_sum[nearest] - own * values[:, None]) / mean_divisor

        # Use as few contacts as have enough presses. A contact counts as often as it was pressed.
        presses_before, contacts_before = (np.cumsum(number, axis=1) - number for number in (count, count > 0))
        is_used = (count > 0) & ((presses_before < NEIGHBOURS) | (contacts_before < LEAST_CONTACTS))
        root_weight = np.sqrt(count * is_used)[..., None]
        # The constant and the offsets of the neighbours, shape (n, number of contacts, 1 + number of coordinates)
        columns = np.concatenate([np.ones_like(root_weight), offsets], axis=2)
        # The pseudoinverse contains the weights of the weighted neighbours in the least-squares solution.
        neighbour_weights = np.linalg.pinv(root_weight * columns)
        # The first coefficient is the value at the press, and the others are the slopes; shape (n, 4, k).
        coefficients = neighbour_weights @ (root_weight * neighbour_values)
        value = coefficients[:, 0]
        slope = coefficients[:, 1:].swapaxes(1, 2)  # shape (n, k, 3)

        # A residual contains the noise of the press and the noise of the plane. If the noise of each value has the
        # variance 1, so has the noise of each weighted mean, and the variance of the plane is the sum of the squares of
        # their weights.
        value_weights = neighbour_weights[:, :1]  # weights in the value of the plane, shape (n, 1, number of contacts)
        relative_residual_std = np.sqrt(1.0 + (value_weights**2).sum(axis=2))
        residual = (values - value) / relative_residual_std
        reach = np.max(distance * is_used, axis=1)
        return cls(value, slope, residual, reach)

    def residuals(self, values: Array) -> Array:
        """Compute the difference between each set of k values and the nearest point of all planes.

        A plane is a linear function from contacts to values. Its points are the values of the contacts around its
        press, up to the distance of the farthest neighbour of the press. Only the `CANDIDATES` planes whose values at
        their own press are nearest to the set are searched.

        Args:
            values: m sets of values, shape (m, k).

        Returns:
            Differences, shape (m, k).
        """
        _, candidate_planes = cKDTree(self.value).query(values, CANDIDATES)  # indices, shape (m, CANDIDATES)
        inverse_slope = np.linalg.pinv(self.slope)  # shape (n, 3, k)
        smallest_residual = np.full(values.shape, np.inf)
        for plane_index in candidate_planes.T:  # index of one plane for each set of values, shape (m,)
            # Find the point of the plane that is nearest to each set of values. The vector `step`, shape (m, 3), leads
            # from the press of the plane to the contact of this point, in unit coordinates. The matrices are
            # multiplied by column vectors, which have an additional last axis.
            difference = values - self.value[plane_index]  # from the values at the press, shape (m, k)
            step = (inverse_slope[plane_index] @ difference[..., None])[..., 0]

            # Shorten steps that end beyond the farthest neighbour.
            length = np.linalg.norm(step, axis=1)
            length_ratio = np.minimum(1.0, self.reach[plane_index] / np.maximum(length, TINY))
            limited_step = step * length_ratio[:, None]

            # Difference from the point at the end of the step, shape (m, k)
            residual = difference - (self.slope[plane_index] @ limited_step[..., None])[..., 0]

            # Keep the residual if this plane is nearer than all earlier planes.
            is_nearer = (residual**2).sum(axis=1) < (smallest_residual**2).sum(axis=1)
            smallest_residual[is_nearer] = residual[is_nearer]
        return smallest_residual


def _repeated_residuals(unit_contact: Array, charge: Array) -> tuple[Array, Array]:
    """Compute the residuals of presses whose contact is repeated: their differences from the mean of the contact.

    Args:
        unit_contact: Contacts in unit coordinates, shape (n, 3).
        charge: Measured charges, shape (n, n_electrode), pC.

    Returns:
        The mean charges of the contact, and the residuals, both of shape (m, n_electrode), pC, for the m presses whose
        contact is repeated. The residuals have the variance of the noise.
    """
    _, contact_of_press, press_count = np.unique(
        np.round(unit_contact, SAME_CONTACT_DECIMALS), axis=0, return_inverse=True, return_counts=True
    )
    sums = np.stack([np.bincount(contact_of_press, column) for column in charge.T], axis=1)
    mean = (sums / press_count[:, None])[contact_of_press]
    count = press_count[contact_of_press, None]
    is_repeated = count[:, 0] > 1
    residual = (charge - mean)[is_repeated] * np.sqrt(count / np.maximum(count - 1, 1))[is_repeated]
    return mean[is_repeated], residual


def usual_size(charge: Array) -> Array:
    """Return the median magnitude of the nonzero charges of each channel, shape (n_electrode,), pC.

    Args:
        charge: Charges, shape (n, n_electrode), pC. Every channel must have at least one charge that is not 0.
    """
    return np.array([np.median(np.abs(column[column != 0.0])) for column in charge.T])


def _fit_variances(charge: Array, residual: Array) -> tuple[float, float]:
    """Estimate the variances white^2 and gain^2 of one channel.

    The function white^2 + gain^2 Q^2 is fitted to the squared residuals by weighted least squares. Neither white^2 nor
    gain^2 can become negative. The squared residuals of large charges scatter more, so each squared residual is divided
    by its expected value. The expected values are not known at first. The fit is therefore repeated, and each round
    uses the expected values that follow from the variances of the previous round. Outliers are clipped.

    Args:
        charge: Charges Q without noise, shape (n,), pC.
        residual: Residuals, shape (n,), pC.

    Returns:
        white^2, pC^2, and gain^2, dimensionless.
    """
    # The expected values of the squared residuals are columns @ (white^2, gain^2).
    columns = np.stack([np.ones_like(charge), charge**2], axis=1)  # shape (n, 2)
    mean_square = np.mean(residual**2)
    smallest_variance = 1e-12 * mean_square + TINY  # avoids a division by zero
    # Both columns are scaled to the root mean square 1, because the squared charges may be very large or small.
    sum_of_squares = np.maximum((columns**2).sum(axis=0), TINY)
    column_scale = np.sqrt(sum_of_squares) / np.sqrt(len(charge))

    variances = np.array([mean_square, 0.0])  # white^2 and gain^2 before the first round
    for _ in range(ROUNDS):
        expected_square = np.maximum(columns @ variances, smallest_variance)
        clipped_square = np.minimum(residual**2, OUTLIER**2 * expected_square)  # limits the influence of outliers
        # Divide both sides of the equations by the expected values, and solve them without negative variances.
        weighted_columns = columns / column_scale / expected_square[:, None]
        weighted_square = clipped_square / expected_square
        scaled_variances, _ = nnls(weighted_columns, weighted_square)
        variances = scaled_variances / column_scale
    white_variance, gain_variance = variances.tolist()
    return white_variance, gain_variance


Noise = NoiseModel | ChannelNoise
"""Noise model with the same parameters for all channels, or with separate parameters for each channel."""
