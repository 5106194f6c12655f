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
"""Number of contacts to which a quadratic function is fitted, which has ten coefficients."""

MIN_REPEATED_CONTACTS = 10
"""Smallest number of repeated contacts with which the noise is estimated only from the presses at these contacts.

With three presses at each of them, the standard deviation of the noise of a channel is known to about 20 %. A single
reference contact would not show how the noise depends on the charge."""

SAME_CONTACT_DECIMALS = 3
"""Decimals of the unit coordinates in which two contacts agree if they count as the same contact."""

OUTLIER_STDS = 3.0
"""Number of standard deviations beyond which residuals count less, because they are not due to noise."""

SMALL_SHARE = 0.01
"""Smallest white noise of a channel, relative to the noise of its gain at a charge of the usual size.

The lower limit is needed because the presses do not determine the white noise if no charge is small. The quantiles of
the charges at `SMALL_SHARE` and at 1 - `SMALL_SHARE` show whether the charges of a channel vary, and whether they have
both signs.
"""

MIN_TRANSITION_RATIO = 0.5
"""Smallest `ChannelNoise.transition_charge` of a channel with both signs, relative to the usual size of its charges.

With a smaller value, the features of charges with little noise would have a kink where the charge changes its sign.
"""

LARGEST_LOGARITHM = 50.0
"""Largest magnitude of a logarithm of a charge, a force or a standard deviation.

Its exponential is finite in single precision, also for charges that are far from those of the training.
"""

MIN_GAIN_NOISE = 1e-4
"""Smallest relative noise of the gain, which is that of a good amplifier.

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

        Presses that are copies of other presses are left out, because they contain no further noise. If every channel
        has charges at `MIN_REPEATED_CONTACTS` or more repeated contacts, the residuals are the differences between the
        repeated charges and their means. Otherwise, the residuals are the differences between the charges of a press
        and a quadratic function, which is fitted to the neighbours of the press. These differences also contain the
        error of the quadratic approximation. The white noise and the noise of the gain are fitted to the residuals.
        Both kinds of noise have lower limits.

        Args:
            charge: Measured charges, shape (n, n_electrode), pC.
            unit_contact: Contacts in unit coordinates, shape (n, 3).

        Returns:
            Noise model with the white noise and the noise of the gain of each channel.
        """
        # Leave out copies of presses.
        different_rows = np.unique(np.column_stack([unit_contact, charge]), axis=0)
        contact = different_rows[:, :3]
        noisy_charge = different_rows[:, 3:]

        # Compute the charges without noise and the residuals, each of shape (m, n_electrode). A channel that is silent
        # at repeated contacts does not show its noise there, so only contacts with a charge count.
        exact_charge, residual = _repeated_residuals(contact, noisy_charge)
        repeated_charges = np.unique(exact_charge, axis=0)  # one row for each repeated contact
        if np.count_nonzero(repeated_charges, axis=0).min() < MIN_REPEATED_CONTACTS:
            planes = LocalPlanes.fit(contact, noisy_charge)
            exact_charge = planes.value
            residual = planes.residual

        # Fit the noise of each channel.
        white_std, gain_std = np.transpose(list(map(_fit_noise, exact_charge.T, residual.T)))
        gain = np.maximum(gain_std, MIN_GAIN_NOISE)
        # The presses do not determine the white noise if all charges are large. The lower limit of the white noise is a
        # small fraction of the noise of the gain at the usual charge.
        smallest_white = SMALL_SHARE * gain * usual_size(noisy_charge)
        return cls(np.maximum(white_std, smallest_white), gain)

    @classmethod
    def alike(cls, noise: NoiseModel) -> "ChannelNoise":
        """Create a noise model with the same noise on every electrode, whose parameters have the shape ()."""
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
        low_charge, high_charge = np.quantile(charge, (SMALL_SHARE, 1.0 - SMALL_SHARE), axis=0)
        has_both_signs = (low_charge < 0.0) & (high_charge > 0.0)  # shape (n_electrode,)
        lower_limit = np.where(has_both_signs, MIN_TRANSITION_RATIO * usual_size(charge), 0.0)
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
        residual: Difference between the mean values of the presses and the value of the plane, shape (n, k). It is
            divided by its standard deviation for values of presses with the variance 1.
        reach: Distance of the farthest neighbour in unit coordinates, shape (n,).
    """

    value: Array
    slope: Array
    residual: Array
    reach: Array

    @classmethod
    def fit(cls, unit_contact: Array, values: Array) -> "LocalPlanes":
        """For each contact, fit a quadratic function to the values of its neighbours by least squares.

        The function maps the unit coordinates of a contact to the k values. Unit coordinates are x, y and ln F, scaled
        such that each of them ranges from -1 to 1. The plane is the tangent of the function at the contact. The values
        at the contact itself are not used in the fit, so that its residual is independent of the plane. The residuals
        are scaled so that their variance is equal to that of the noise of the values.

        Args:
            unit_contact: Contacts in unit coordinates, shape (n, 3).
            values: Values at the contacts, such as charges, shape (n, k).

        Returns:
            The planes, one for each different contact.
        """
        # Find the neighbours of each contact. The nearest contact is the contact itself.
        contact, mean_value, press_count, _ = _average_repeated(unit_contact, values)
        distance, nearest = cKDTree(contact).query(contact, min(N_NEIGHBOURS + 1, len(contact)))
        neighbours = nearest[:, 1:]

        # The terms of the function are a constant, the offsets of the neighbours, and the products of two offsets.
        offsets = contact[neighbours] - contact[:, None]  # shape (n, number of neighbours, 3)
        first, second = np.triu_indices(3)
        products = offsets[:, :, first] * offsets[:, :, second]
        terms = np.concatenate([np.ones_like(offsets[:, :, :1]), offsets, products], axis=2)

        # The pseudoinverse contains the weights of the neighbours in the least-squares solution. The first coefficient
        # is the value at the contact, and the next three are the slopes.
        weights = np.linalg.pinv(terms)  # shape (n, 10, number of neighbours)
        coefficients = weights @ mean_value[neighbours]  # shape (n, 10, k)
        value = coefficients[:, 0]
        slope = coefficients[:, 1:4].swapaxes(1, 2)  # shape (n, k, 3)

        # A residual contains the noise of the mean value and the noise of the plane. The value of the plane is the sum
        # of the mean values of the neighbours with the weights in the first row.
        plane_variance = (weights[:, 0] ** 2 / press_count[neighbours]).sum(
            axis=1
        )  # relative to that of a single press
        relative_std = np.sqrt(1.0 / press_count + plane_variance)
        residual = (mean_value - value) / relative_std[:, None]
        farthest_distance = distance[:, -1]
        return cls(value, slope, residual, farthest_distance)

    def residuals(self, values: Array) -> Array:
        """Compute the difference between each set of k values and the nearest point of all planes.

        A plane is a linear function from contacts to values. It describes the values of the contacts near one press, up
        to the distance of the farthest neighbour of the press. Each set of values is compared with `N_CANDIDATE_PLANES`
        planes: those whose values at their own press are nearest to the set.

        Args:
            values: m sets of values, shape (m, k).

        Returns:
            Differences, shape (m, k).
        """
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

    # Compute the mean of each coordinate and of each value over the presses of each contact.
    table = np.column_stack([unit_contact, values])
    sums = np.stack([np.bincount(contact_of_press, column) for column in table.T], axis=1)
    contact, mean_value = np.split(sums / press_count[:, None], [3], axis=1)
    return contact, mean_value, press_count, contact_of_press


def _repeated_residuals(unit_contact: Array, charge: Array) -> tuple[Array, Array]:
    """Compute the residuals of presses whose contact is repeated: the differences from the mean charges of the contact.

    Args:
        unit_contact: Contacts in unit coordinates, shape (n, 3).
        charge: Measured charges, shape (n, n_electrode), pC.

    Returns:
        The mean charges of the contact, and the residuals, both of shape (m, n_electrode), pC, for the m presses whose
        contact is repeated. The residuals have the variance of the noise.
    """
    _, mean_charge, press_count, contact_of_press = _average_repeated(unit_contact, charge)
    is_repeated = press_count[contact_of_press] > 1
    repeated_contact = contact_of_press[is_repeated]
    mean = mean_charge[repeated_contact]
    count = press_count[repeated_contact, None]
    # The variance of a difference from the mean of k charges is (k - 1) / k times that of the noise.
    difference = charge[is_repeated] - mean
    return mean, difference * np.sqrt(count / (count - 1))


def usual_size(charge: Array) -> Array:
    """Return the median magnitude of the nonzero charges of each channel, shape (n_electrode,), pC.

    Args:
        charge: Charges, shape (n, n_electrode), pC. Every channel must have at least one charge that is not 0.
    """
    return np.array([np.median(np.abs(column[column != 0.0])) for column in charge.T])


def _fit_noise(charge: Array, residual: Array) -> Array:
    """Estimate the white noise and the noise of the gain of one channel from residuals.

    The variance of a residual is white^2 + gain^2 Q^2, where Q is the charge. The likelihood of the residuals is
    maximised. It is that of a normal distribution with longer tails beyond `OUTLIER_STDS` standard deviations (Huber
    1964, proposal 2).

    A channel that is silent below a threshold does not show its noise there. Charges that are zero and have no residual
    are therefore left out. Otherwise, the likelihood would be infinite without white noise.

    Args:
        charge: Charges Q without noise, shape (n,), pC.
        residual: Residuals, shape (n,), pC.

    Returns:
        The standard deviation of the white noise, pC, and the relative standard deviation of the gain.
    """
    # The unknowns are the logarithms of white and gain, in units of the values with which each of them alone explains
    # the residuals. The units are needed because charges may be very large or small.
    is_silent = (charge == 0.0) & (residual == 0.0)
    smallest_number = np.finfo(float).tiny
    units = smallest_number + rms(residual) / np.array([1.0, rms(charge)])

    def loss(log_std: Array) -> float:
        """Return the mean negative logarithm of the likelihood, without a constant."""
        white, gain = units * np.exp(log_std)
        variance = np.maximum(white**2 + (gain * charge) ** 2, smallest_number)
        # The squared deviation counts up to `OUTLIER_STDS` squared, and only its logarithm beyond.
        square = residual**2 / variance
        tail = OUTLIER_STDS**2 * np.log(np.maximum(square / OUTLIER_STDS**2, 1.0))
        terms = np.log(variance) + np.minimum(square, OUTLIER_STDS**2) + tail
        return float(np.mean(np.where(is_silent, 0.0, terms)))

    solution = minimize(loss, [-0.5, -0.5], method="Nelder-Mead").x
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
