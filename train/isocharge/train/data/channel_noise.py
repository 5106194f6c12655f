"""Estimation of the noise in measured presses from the presses themselves.

For each press, a quadratic function is fitted to the charges of its neighbours, which are the presses with the most
similar positions and forces. The function predicts the charges of the press. The residuals of the prediction are
attributed to the noise of the channels, although they also contain the errors of the measured positions and forces.
The variance of the noise of a channel is modelled as white^2 + (gain * Q)^2, with the charge Q and two parameters,
white and gain.
"""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from isocharge.common.arrays import Array, Integers
from isocharge.simulate import NoiseModel, noise_model
from isocharge.simulate.noise import GaussianNoise
from isocharge.train.data.contact_errors import rms, rounded

N_NEIGHBOURS = 16
"""Number of contacts to which a quadratic function with ten coefficients is fitted."""

MIN_REPEATED_CONTACTS = 10
"""Smallest number of repeated contacts for which the noise is estimated from presses at repeated contacts alone.

With three presses at each repeated contact, the standard deviation of the noise of a channel is known to about 20 %. A
single reference contact would not show how the noise depends on the charge."""

SAME_CONTACT_DECIMALS = 3
"""Two contacts count as the same contact if their unit coordinates agree to this number of decimals."""

OUTLIER_STDS = 3.0
"""Number of standard deviations beyond which residuals count less, because they are not due to noise."""

MIN_WHITE_RATIO = 0.01
"""Smallest white noise of a channel, relative to the noise of its gain at a charge of the median magnitude.

The lower limit is needed because the presses do not determine the white noise if no charge is small.
"""

EXTREME_SHARE = 0.01
"""This share of the charges of a channel counts as exceptionally small, and the same share as exceptionally large.

The other charges show whether the charges of a channel vary, and whether they have both signs.
"""

MIN_TRANSITION_RATIO = 0.5
"""Smallest `ChannelNoise.transition_charge` for charges of both signs, relative to their `median_magnitude`.

With a smaller value, the features of a channel with little noise would have a kink at the charge 0.
"""

LARGEST_LOGARITHM = 50.0
"""Largest magnitude of a logarithm of a charge, a force or a standard deviation.

The limit keeps the exponential finite in single precision, even for charges that are far from those of the training.
"""

MIN_GAIN_NOISE = 1e-4
"""Smallest relative noise of the gain, which is the value for a good amplifier.

With a smaller value, the level asinh(gain Q / white) / gain would be practically equal to Q / white.
"""

N_CANDIDATE_PLANES = 8
"""Number of planes that are compared in the search for the nearest point of all planes."""


@dataclass(frozen=True)
class ChannelNoise(GaussianNoise):
    """A noise model with separate parameters for each channel.

    Attributes:
        white: Constant part of the standard deviation, shape (n_electrode,) or (), pC.
        gain: Part of the standard deviation that is proportional to the charge, shape (n_electrode,) or (),
            dimensionless.
        name: Name of the noise model.
    """

    white: Array
    gain: Array
    name: str = "measured"

    @classmethod
    def estimate(cls, charge: Array, unit_contact: Array) -> "ChannelNoise":
        """Estimate the noise of each channel from measured presses.

        The noise of a channel is fitted to residuals, which are differences between measured charges and estimates of
        the charges without noise. If enough contacts were pressed repeatedly, the estimates are the mean charges of
        these contacts. Otherwise, the estimates are the values of quadratic functions, which are fitted to the
        neighbours of each contact. The residuals then also contain the error of the quadratic approximation. Presses
        that are copies of other presses are left out, because they contain no further noise.

        Args:
            charge: Measured charges, shape (n, n_electrode), pC.
            unit_contact: Contacts in unit coordinates, shape (n, 3).

        Returns:
            Noise model with the white noise and the noise of the gain of each channel. Both have lower limits.
        """
        # Leave out copies of presses.
        different_rows = np.unique(np.column_stack([unit_contact, charge]), axis=0)
        contact = different_rows[:, :3]
        noisy_charge = different_rows[:, 3:]

        # Estimate the charges without noise at repeated contacts, shape (m, n_electrode).
        # Each of the m presses at a repeated contact has one row. The rows of a contact contain the same mean charges.
        estimated_charge, residual = _repeated_residuals(contact, noisy_charge)
        # Count the repeated contacts that show the noise of a channel. A contact at which the channel is silent does
        # not show its noise.
        charges_of_contacts = np.unique(estimated_charge, axis=0)  # one row for each repeated contact
        contact_counts = np.count_nonzero(charges_of_contacts, axis=0)  # shape (n_electrode,)
        if contact_counts.min() < MIN_REPEATED_CONTACTS:  # estimate the charges at all contacts by quadratic functions
            planes = LocalPlanes.fit(contact, noisy_charge)  # tangents of quadratic functions
            estimated_charge = planes.value
            residual = planes.residual

        # Fit the noise of each channel.
        white_std, gain_std = np.transpose(
            [_fit_noise(charges, residuals) for charges, residuals in zip(estimated_charge.T, residual.T, strict=True)]
        )
        gain_noise = np.maximum(gain_std, MIN_GAIN_NOISE)
        min_white_noise = MIN_WHITE_RATIO * gain_noise * median_magnitude(noisy_charge)
        return cls(np.maximum(white_std, min_white_noise), gain_noise)

    @classmethod
    def alike(cls, noise: NoiseModel) -> "ChannelNoise":
        """Create a noise model with the same noise on every electrode. Its parameters have the shape ()."""
        return cls(np.array(noise.white), np.array(max(noise.gain, MIN_GAIN_NOISE)), noise.name)

    def level(self, charge: Array) -> Array:
        """Convert charges Q, shape (n, n_electrode), pC, into the levels asinh(gain Q / white) / gain.

        The noise of every level has a standard deviation of about 1.
        """
        return np.arcsinh(charge * self.gain / self.white) / self.gain

    def charge(self, level: Array) -> Array:
        """Convert levels into charges, pC. This method is the inverse of `level`."""
        exponent = np.clip(level * self.gain, -LARGEST_LOGARITHM, LARGEST_LOGARITHM)
        return np.sinh(exponent) * self.white / self.gain

    def transition_charge(self, charge: Array) -> Array:
        """Return the charge of each channel above which the inputs of a network become logarithmic.

        The inputs of the network are asinh(Q / transition charge). The inputs are nearly linear in charges Q below the
        transition charge, and nearly logarithmic above it. The transition charge is the charge above which the noise is
        mostly proportional to the charge. If a channel has charges of both signs, the transition charge also has a
        lower limit, because asinh would otherwise have a kink at the charge 0 for a channel with little noise.

        Args:
            charge: Charges of presses, shape (n, n_electrode), pC.

        Returns:
            Transition charges, shape (n_electrode,), pC.
        """
        low_charge, high_charge = np.quantile(charge, (EXTREME_SHARE, 1.0 - EXTREME_SHARE), axis=0)
        has_both_signs = (low_charge < 0.0) & (high_charge > 0.0)  # shape (n_electrode,)
        lower_limit = np.where(has_both_signs, MIN_TRANSITION_RATIO * median_magnitude(charge), 0.0)
        return np.maximum(self.white / self.gain, lower_limit)

    def scaled(self, factor: float) -> "ChannelNoise":
        """Multiply all standard deviations by a factor, and return the new noise model."""
        return ChannelNoise(factor * self.white, factor * self.gain, self.name)

    def to_dict(self) -> dict[str, object]:
        """Return the noise model as it is stored in the metadata of a model."""
        return {
            "name": self.name,
            "white_pC": [rounded(white) for white in self.white],
            "gain": [rounded(gain) for gain in self.gain],
        }


@dataclass(frozen=True)
class LocalPlanes:
    """One plane for each contact: the tangent of a quadratic function that is fitted to the nearest other contacts.

    Presses with the same contact are averaged.

    Attributes:
        value: Value of the plane at its contact, shape (n, k).
        slope: Derivatives of the values with respect to the unit coordinates, shape (n, k, 3).
        residual: Difference between the mean values of the presses at a contact and the value of its plane, shape (n,
            k). The difference is scaled so that its variance is equal to that of the noise of a single press.
        reach: Distance from each contact to its farthest neighbour in unit coordinates, shape (n,).
    """

    value: Array
    slope: Array
    residual: Array
    reach: Array

    @classmethod
    def fit(cls, unit_contact: Array, values: Array) -> "LocalPlanes":
        """Fit a quadratic function to the neighbours of each contact by least squares, and return its tangent plane.

        The function maps the unit coordinates of a contact to the k values. Unit coordinates are x, y and ln F, scaled
        such that each of them ranges from -1 to 1. The plane is the tangent of the function at the contact. The values
        at the contact itself are not used in the fit, so that the plane is independent of their noise. The residuals
        are scaled so that their variance is equal to that of the noise of a single press.

        Args:
            unit_contact: Contacts of the presses in unit coordinates, shape (n_press, 3).
            values: Values of the presses, such as charges, shape (n_press, k).

        Returns:
            The planes, one for each of the n different contacts.
        """
        # Find the neighbours of each contact. The nearest contact is the contact itself.
        contact, mean_value, press_count, _ = _average_repeated(unit_contact, values)
        distance, nearest = cKDTree(contact).query(contact, min(N_NEIGHBOURS + 1, len(contact)))
        neighbours = nearest[:, 1:]

        # The terms of the function are a constant, the 3 offsets of a neighbour, and the 6 products of two offsets.
        offsets = contact[neighbours] - contact[:, None]  # shape (n, number of neighbours, 3)
        first, second = np.triu_indices(3)
        products = offsets[:, :, first] * offsets[:, :, second]
        constant = np.ones((*neighbours.shape, 1))
        terms = np.concatenate([constant, offsets, products], axis=2)

        # Each coefficient of the least-squares solution is a weighted sum of the values of the neighbours. The weights
        # are the rows of the pseudoinverse. The first coefficient is the value at the contact, and the next three are
        # the slopes.
        weights = np.linalg.pinv(terms)  # shape (n, 10, number of neighbours)
        coefficients = weights @ mean_value[neighbours]  # shape (n, 10, k)
        value = coefficients[:, 0]
        slope = coefficients[:, 1:4].swapaxes(1, 2)  # shape (n, k, 3)

        # The difference between the mean value at a contact and the plane contains the noise of both. If the noise of a
        # single press has the variance 1, the mean of several presses has the variance 1 / press_count. The variance of
        # the plane follows from the weights of the neighbours.
        value_weights = weights[:, 0]
        plane_variance = (value_weights**2 / press_count[neighbours]).sum(axis=1)
        difference_std = np.sqrt(1.0 / press_count + plane_variance)
        residual = (mean_value - value) / difference_std[:, None]
        farthest_distance = distance[:, -1]
        return cls(value, slope, residual, farthest_distance)

    def residuals(self, values: Array) -> Array:
        """Compute the difference between each set of k values and the nearest point of all planes.

        A plane is a linear function from contacts to values. The plane of a press describes the values at contacts that
        are not farther from the press than its farthest neighbour. Each set of values is compared with
        `N_CANDIDATE_PLANES` planes: those whose values at their own press are nearest to the set.

        Args:
            values: m sets of values, shape (m, k).

        Returns:
            Differences, shape (m, k).
        """
        # The n planes have the values `self.value`, shape (n, k), the slopes `self.slope`, shape (n, k, 3), and the
        # distances `self.reach` to their farthest neighbours, shape (n,).
        # Indices of the candidates, shape (m, N_CANDIDATE_PLANES)
        _, candidate_planes = cKDTree(self.value).query(values, N_CANDIDATE_PLANES)
        inverse_slope = np.linalg.pinv(self.slope)  # shape (n, 3, k)
        smallest_residual = np.full(values.shape, np.inf)
        for plane_index in candidate_planes.T:  # index of one plane for each set of values, shape (m,)
            # Find the step from the press of the plane to the contact whose values are nearest to the set.
            difference = values - self.value[plane_index]  # from the values at the press, shape (m, k)
            step = np.einsum("mik,mk->mi", inverse_slope[plane_index], difference)  # in unit coordinates, shape (m, 3)

            # Shorten steps that end beyond the farthest neighbour.
            reach = self.reach[plane_index]
            length_ratio = reach / np.maximum(np.linalg.norm(step, axis=1), reach)
            limited_step = step * length_ratio[:, None]

            # Difference from the values at the end of the step, shape (m, k)
            residual = difference - np.einsum("mki,mi->mk", self.slope[plane_index], limited_step)

            # Keep the residual if this plane is nearer than all earlier planes.
            is_nearer = (residual**2).sum(axis=1) < (smallest_residual**2).sum(axis=1)
            smallest_residual[is_nearer] = residual[is_nearer]
        return smallest_residual


def _average_repeated(unit_contact: Array, values: Array) -> tuple[Array, Array, Integers, Integers]:
    """Average the values of presses with the same contact.

    Args:
        unit_contact: Contacts of n presses in unit coordinates, shape (n, 3).
        values: Values of the presses, shape (n, k).

    Returns:
        The m different contacts, shape (m, 3). Mean values of the presses at each contact, shape (m, k). Number of
        presses at each contact, shape (m,). Index of the contact of each press, shape (n,).
    """
    # Number the different contacts, and count their presses.
    rounded_contact = np.round(unit_contact, SAME_CONTACT_DECIMALS)
    _, contact_of_press, press_count = np.unique(rounded_contact, axis=0, return_inverse=True, return_counts=True)
    contact_of_press = contact_of_press.ravel()  # some versions of NumPy return two axes

    # Compute the mean of each coordinate and of each value over the presses of each contact. The first three columns
    # of the table are the coordinates.
    table = np.column_stack([unit_contact, values])
    sums = np.column_stack([np.bincount(contact_of_press, column) for column in table.T])
    contact, mean_value = np.split(sums / press_count[:, None], [3], axis=1)
    return contact, mean_value, press_count, contact_of_press


def _repeated_residuals(unit_contact: Array, charge: Array) -> tuple[Array, Array]:
    """Compute the differences between the charges of presses at repeated contacts and the mean charges of each contact.

    The differences are scaled so that they have the variance of the noise, and are returned as residuals.

    Args:
        unit_contact: Contacts in unit coordinates, shape (n, 3).
        charge: Measured charges, shape (n, n_electrode), pC.

    Returns:
        For each of the m presses at repeated contacts, the mean charges of its contact, and its residuals. Both have
        the shape (m, n_electrode) and the unit pC.
    """
    _, mean_charge, press_count, contact_of_press = _average_repeated(unit_contact, charge)
    is_repeated = press_count[contact_of_press] > 1
    repeated_contact = contact_of_press[is_repeated]
    mean = mean_charge[repeated_contact]
    count = press_count[repeated_contact, None]  # number of presses at the contact of each press, shape (m, 1)
    # The variance of a difference from the mean of k charges is (k - 1) / k times that of the noise.
    difference = charge[is_repeated] - mean
    return mean, difference * np.sqrt(count / (count - 1))


def median_magnitude(charge: Array) -> Array:
    """Return the median magnitude of the nonzero charges of each channel, shape (n_electrode,), pC.

    Args:
        charge: Charges, shape (n, n_electrode), pC. Every channel must have at least one charge that is not 0.
    """
    return np.array([np.median(np.abs(column[column != 0.0])) for column in charge.T])


def _fit_noise(charge: Array, residual: Array) -> Array:
    """Estimate the white noise and the noise of the gain of one channel from residuals.

    The variance of a residual is white^2 + gain^2 Q^2, where Q is the charge. The function searches for the white noise
    and the noise of the gain that maximise the likelihood of the residuals. Residuals of up to `OUTLIER_STDS` standard
    deviations have the density of a normal distribution. For larger residuals, the density decreases more slowly, so
    that outliers have little effect on the result (Huber 1964, proposal 2).

    A channel that is silent below a threshold does not show its noise there. Charges of zero with a residual of zero
    are therefore left out. If they were used, the likelihood would be infinite for a white noise of zero.

    Args:
        charge: Estimates of the charges Q without noise, shape (n,), pC.
        residual: Residuals, shape (n,), pC.

    Returns:
        The standard deviation of the white noise, pC, and the relative standard deviation of the gain.
    """
    is_silent = (charge == 0.0) & (residual == 0.0)
    square_limit = OUTLIER_STDS**2
    smallest_positive = np.finfo(float).tiny  # keeps the units and the variances above zero
    # White noise of the size rms(residual) would explain the residuals without noise of the gain. Noise of the gain of
    # the size rms(residual) / rms(charge) would explain them without white noise. White and gain are searched in these
    # units, because charges may be very large or small, and as logarithms, because they are positive. The first unit is
    # that of white, pC, and the second unit is that of gain, dimensionless.
    units = smallest_positive + rms(residual) / np.array([1.0, rms(charge)])

    def loss(log_std: Array) -> float:
        """Return the mean over the residuals of -2 times the logarithm of their density, up to a constant.

        The arrays `charge` and `residual` contain estimated charges without noise and the residuals of one channel.
        Residuals that `is_silent` marks do not count, because the silent channel does not show its noise there.

        Args:
            log_std: Logarithms of (white noise / first unit) and (gain noise / second unit), shape (2,). The array
                `units` contains both units.
        """
        white, gain = units * np.exp(log_std)
        variance = np.maximum(white**2 + (gain * charge) ** 2, smallest_positive)
        # For a normal distribution, the term of a residual is its squared deviation. Beyond `square_limit`, a residual
        # is an outlier, and the term only increases with the logarithm of the squared deviation.
        squared_deviation = residual**2 / variance
        normal_term = np.minimum(squared_deviation, square_limit)
        tail_term = square_limit * np.log(np.maximum(squared_deviation / square_limit, 1.0))  # 0 up to the limit
        terms = np.log(variance) + normal_term + tail_term
        return float(np.mean(np.where(is_silent, 0.0, terms)))

    start = [-0.5, -0.5]  # both kinds of noise contribute
    solution = minimize(loss, start, method="Nelder-Mead").x
    return np.asarray(units * np.exp(solution))


Noise = NoiseModel | ChannelNoise
"""Noise model with the same parameters for all channels, or with separate parameters for each channel."""


AnyNoise = TypeVar("AnyNoise", bound=Noise)


def misfit_noise(noise: AnyNoise) -> AnyNoise | NoiseModel:
    """Return the noise whose standard deviation is the unit of the misfit.

    The result is the noise of the training or, if the training has no noise, the noise `reference`.
    """
    has_noise = np.any(noise.white)
    return noise if has_noise else noise_model("reference")
