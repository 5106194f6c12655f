"""Errors of a model on measured presses, and tests of whether noise and rig explain these errors.

The rig is the machine that sets the position and the force of each press. The expected variance of an error is the sum
of two variances. The first variance is caused by the noise of the charges and, for a calibrated model, by the uncertain
properties of its film. The model reports this variance. The second variance is caused by the uncertainty of the
position or of the force that the rig sets. One statistical test uses the sum of the squared errors, and the other test
uses the mean errors. Both tests take into account that all presses share the error of the film.
"""

import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from isocharge.common.arrays import Array, Booleans
from isocharge.serve.model.contact import (
    CORRELATION_COLUMNS,
    MISFIT_LIMIT,
    Contacts,
    Validity,
    correlation_matrices,
    inside_polygon,
)
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.predictor import Predictor
from isocharge.serve.model.session import COLUMNS
from isocharge.serve.presses.measured_presses import MeasuredPresses

CHARGE_UNKNOWN = "a charge is unknown"
CONTACT_UNKNOWN = "neither place nor force is known"
NOT_TRAINED = "not trained for"
"""Reasons why a press is excluded from the comparison, as parts of a sentence."""

FORCE = 2
"""Column of the force in the errors and standard deviations of `PressErrors`. Columns 0 and 1 are x and y."""


@dataclass(frozen=True)
class PressErrors:
    """Contacts that a model computed for n measured presses, and the errors of these contacts.

    Attributes:
        presses: The measured presses, with the charges of the model's electrodes.
        predicted: Values of the attributes of `Contact` for each press, shape (n, 10); NaN if a charge is unknown.
        error: Predicted minus measured values of x (mm), y (mm) and the force (relative to the measured force), shape
            (n, 3). The error is NaN if the measured value is unknown.
        noise_std: Standard deviations that the noise of the charges and the uncertain film cause, as reported by the
            model, in the units of `error`, shape (n, 3).
        film_std: Standard deviations that the uncertain film alone causes, in the units of `error`, shape (n, 3). They
            are a part of `noise_std`. All presses share the properties of the film, so these errors are not
            independent.
        rig_std: Standard deviations of the measured values, in the units of `error`, shape (n, 3).
        flags: Flags of each press; empty if a charge is unknown.
        exclusion_reasons: Reason why each press is excluded from the comparison; empty for a press that is compared;
            shape (n,).
    """

    presses: MeasuredPresses
    predicted: Array
    error: Array
    noise_std: Array
    film_std: Array
    rig_std: Array
    flags: tuple[tuple[str, ...], ...]
    exclusion_reasons: NDArray[np.str_]

    @property
    def is_compared(self) -> Booleans:
        """Whether each press is compared, shape (n,)."""
        return np.asarray(self.exclusion_reasons == "")

    @property
    def variance(self) -> Array:
        """Variances with which the errors are treated as independent, shape (n, 3).

        Presses at one place share the error of their position. The variance of this error is therefore multiplied by
        the number of presses at the place.
        """
        rig_variance = self.rig_std**2
        rig_variance[:, :FORCE] *= self.presses.same_place_count[:, np.newaxis]
        return self.noise_std**2 + rig_variance

    @property
    def chi_squared(self) -> Array:
        """Squared Mahalanobis distance between each error (x, y, force) and zero, shape (n,).

        The covariance of the errors is the sum of two covariances. The covariance of the noise contains the
        correlations that the model states. The covariance of the rig is diagonal, because the errors of the rig are
        independent. Unknown errors do not count.
        """
        # The errors are divided by their standard deviations, so that their covariance becomes a correlation matrix.
        # Only the noise is correlated. In the correlation of two errors, the correlation of the noise is therefore
        # multiplied by the share of noise in the standard deviation of each error. The diagonal elements are 1.
        std = np.sqrt(self.variance)
        noise_share = self.noise_std / std  # shape (n, 3)
        noise_correlation = correlation_matrices(self.predicted) * noise_share[:, :, None] * noise_share[:, None, :]
        correlation = np.nan_to_num(noise_correlation)  # an unknown error has no correlations
        correlation[:, range(3), range(3)] = 1.0

        # The result is d^T C^-1 d with the divided errors d and the matrix C = `correlation`, shape (n, 3, 3). An
        # unknown error becomes 0, and therefore adds nothing.
        deviation = np.nan_to_num(self.error / std)[:, :, None]  # shape (n, 3, 1)
        return np.asarray((deviation * np.linalg.solve(correlation, deviation)).sum(axis=(1, 2)))

    @property
    def position_error_mm(self) -> Array:
        """Distances between predicted and measured positions, shape (n,), mm; NaN if a position is unknown."""
        return np.asarray(np.linalg.norm(self.error[:, :FORCE], axis=1))

    def rows(self) -> list[dict[str, Any]]:
        """Return the contact, the errors and the flags of each press as a dictionary whose keys contain the units.

        The correlations of the contact are not included.
        """
        x_error_mm, y_error_mm, force_error = self.error.T  # the force is relative to the measured force
        contact_names = Contacts._fields[: CORRELATION_COLUMNS.start]
        columns: dict[str, Any] = {
            "line": self.presses.lines,
            **dict(zip(contact_names, self.predicted.T, strict=False)),  # the last columns are the correlations
            "x_error_mm": x_error_mm,
            "y_error_mm": y_error_mm,
            "position_error_mm": self.position_error_mm,
            "force_error_percent": 100.0 * force_error,
            "noise_std_percent": 100.0 * self.noise_std[:, FORCE],
            "position_std_mm": self.rig_std[:, 0],
            "force_std_percent": 100.0 * self.rig_std[:, FORCE],
            "flags": self.flags,
            "left_out": [reason or None for reason in self.exclusion_reasons],  # None if the press is compared
        }
        return [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]


def press_errors(predictor: Predictor, presses: MeasuredPresses) -> PressErrors:
    """Predict contacts from the charges of measured presses, and compute the errors of the predicted contacts.

    Args:
        predictor: The model.
        presses: The presses, with at least the electrodes of the model.

    Raises:
        PressError: If the presses contain no charges of one of the model's electrodes.
    """
    metadata = predictor.metadata
    model_presses = presses.of_electrodes(metadata.electrodes, metadata.label)  # charges in the order of the model
    measured = model_presses.contact  # x, y and force, shape (n, 3)

    # A press with an unknown charge is predicted with the charge 0. The result is discarded.
    charge_pC = model_presses.charge_pC
    is_unknown_charge = np.isnan(charge_pC)
    is_complete = np.asarray(~is_unknown_charge.any(axis=1))
    known_charge_pC = np.where(is_unknown_charge, 0.0, charge_pC)
    contacts = predictor.predict_batch(known_charge_pC)
    predicted = np.where(is_complete[:, np.newaxis], contacts, np.nan)
    flags_of_presses = predictor.validity.batch_flags(contacts)

    # The uncertain film causes the part of the reported variance that the noise of the charges does not cause.
    charge_std_pC = np.sqrt(predictor.noise.variance(known_charge_pC))
    _, effects = predictor.noise_effects(known_charge_pC, charge_std_pC)  # by the noise of each charge
    reported_std = predicted[:, COLUMNS["contact_std"]]
    film_std = np.sqrt(np.maximum(reported_std**2 - (effects**2).sum(axis=0), 0.0))

    # Differences of x and y are errors in mm, and are divided by 1. Differences of the force are divided by the
    # measured force.
    divisor = np.ones_like(measured)
    divisor[:, FORCE] = measured[:, FORCE]

    # Standard deviations of the measured values. The standard deviation of the force is already relative.
    position_std_mm = model_presses.position_std_mm
    rig_std = np.column_stack([position_std_mm, position_std_mm, model_presses.force_std])
    # Where a measured value is unknown (NaN), the error and both standard deviations are NaN.
    is_unknown = np.isnan(measured)
    return PressErrors(
        presses=model_presses,
        predicted=predicted,
        error=(predicted[:, COLUMNS["contact"]] - measured) / divisor,
        noise_std=np.where(is_unknown, np.nan, reported_std / divisor),
        film_std=np.where(is_unknown, np.nan, film_std / divisor),
        rig_std=np.where(is_unknown, np.nan, rig_std),
        flags=tuple(flags if known else () for flags, known in zip(flags_of_presses, is_complete, strict=True)),
        exclusion_reasons=_exclusion_reasons(predictor.validity, model_presses),
    )


NOISE_ALLOWANCE = 1.5
"""Largest accepted ratio of the real noise to the noise of a model, dimensionless.

A calibration with eight presses determines the noise to about 30 %, and a calibration with 20 presses determines the
noise to about 10 %.
"""


def misfit_limit(metadata: ModelMetadata) -> float:
    """Return the misfit that at most 1 % of good presses exceed, even if the noise is `NOISE_ALLOWANCE` times as large.

    Args:
        metadata: Metadata of the model. If they contain no limit for 1 % of good presses, the result is `MISFIT_LIMIT`.
    """
    if "misfit_p99" not in metadata.errors:
        return MISFIT_LIMIT
    return NOISE_ALLOWANCE * metadata.errors["misfit_p99"]


def _exclusion_reasons(validity: Validity, presses: MeasuredPresses) -> NDArray[np.str_]:
    """Return the reason why each press is excluded from the comparison. The reason is empty for a compared press.

    The model is compared with presses in its domain, which consists of the working area and the range of forces. The
    measured position and the measured force determine whether a press lies in this domain.

    Args:
        validity: The working area and the range of forces of the model.
        presses: The measured presses, with the charges of the model's electrodes.
    """
    x_mm, y_mm, force_N = presses.contact.T
    min_force_N, max_force_N = validity.force_range_N
    is_outside_area = ~np.isnan(x_mm) & ~inside_polygon(x_mm, y_mm, validity.corners_mm)
    is_outside_forces = (force_N < min_force_N) | (force_N > max_force_N)
    is_contact_unknown = np.isnan(presses.contact).all(axis=1)
    is_charge_unknown = np.isnan(presses.charge_pC).any(axis=1)
    # If several conditions are true, the first condition in the list determines the reason.
    conditions = [is_charge_unknown, is_contact_unknown, is_outside_area | is_outside_forces]
    return np.select(conditions, [CHARGE_UNKNOWN, CONTACT_UNKNOWN, NOT_TRAINED], default="")


TEST_SIGNIFICANCE = 0.01 / 3.0
"""Probability that a single test rejects a model that fits.

There are three tests: of the scatter, of the common errors and of the misfits. The probability that the three tests
together reject a model that fits is 1 %.
"""

MAX_ACCEPTED_CHI_SQUARED = 1.1
"""Chi-squared per degree of freedom up to which the scatter is always accepted, dimensionless.

The limit is above 1, because the standard deviations are known to 5 % at best.
"""

COMMON_RATIO = 0.2
"""Error of the rig that may be equal in all presses, relative to the standard deviation of the rig, dimensionless.

For example, the positions of a stage may have a common offset, and the forces of a load cell a common scale error.
"""

FILM_ERRORS = 3.0
"""Number of independent errors to which the uncertain properties of a film contribute in a set of presses.

These errors are mainly a common shift of x, a common shift of y, and a common scale of the forces.
"""


class CommonError(NamedTuple):
    """Estimates of the errors of x, y and the force that are common to all presses, such as a shift of all positions.

    Attributes:
        mean: Weighted means of the errors of x (mm), y (mm) and the force (relative), shape (3,); NaN if no error is
            known.
        std: Standard errors of the means, shape (3,). The standard errors are increased if the errors scatter more than
            noise and rig explain.
        significance: Means divided by standard errors that include the constant errors of film and rig, shape (3,).
    """

    mean: Array
    std: Array
    significance: Array


@np.errstate(divide="ignore", invalid="ignore")
def common_error(error: Array, variance: Array, shared_std: Array) -> CommonError:
    """Estimate the errors that are common to all presses, such as a shift of all positions.

    The estimates are the means of the errors, weighted with the inverse of their expected variances. If the errors
    scatter more than their expected variances, the standard errors are increased. The significance is the ratio of a
    mean to a standard error that also contains the part of the errors that is equal in all presses.

    Args:
        error: Errors of x, y and the force, shape (n, 3); NaN where unknown.
        variance: Expected variance of each error, shape (n, 3).
        shared_std: Standard deviation of the part of each error that is equal in all presses, shape (n, 3).
    """
    # Weighted means of the known errors of x, y and the force, each of shape (3,)
    is_known = ~np.isnan(error)
    weight = np.where(is_known, 1.0 / variance, 0.0)
    total_weight = weight.sum(axis=0)
    mean = np.nansum(weight * error, axis=0) / total_weight

    # Standard errors of the means, which are increased if the errors scatter more than expected
    chi_squared = np.nansum(weight * (error - mean) ** 2, axis=0)
    # The estimated mean uses one degree of freedom.
    chi_squared_per_degree = chi_squared / np.maximum(is_known.sum(axis=0) - 1, 1)
    std = np.sqrt(np.maximum(chi_squared_per_degree, 1.0) / total_weight)

    # Significance of the means in view of the part of the errors that is equal in all presses
    common_std = np.nansum(weight * shared_std, axis=0) / total_weight
    significance = mean / np.hypot(std, common_std)
    return CommonError(mean, std, significance)


@dataclass(frozen=True)
class Agreement:
    """Results of two statistical tests of whether noise and rig explain the errors of the selected presses.

    Attributes:
        chi_squared: Sum of `PressErrors.chi_squared`.
        degrees: Number of degrees of freedom of the sum, equal to the number of known errors.
        p_value: Probability that noise and rig alone cause a larger sum; NaN without presses.
        common: Errors that are common to all presses.
        common_p_value: Probability that noise and rig alone cause larger common errors; NaN without presses.
    """

    chi_squared: float
    degrees: int
    p_value: float
    common: CommonError
    common_p_value: float

    @classmethod
    def from_errors(cls, errors: PressErrors, is_selected: Booleans) -> "Agreement":
        """Test whether noise and rig explain the errors of the selected presses.

        The first test examines the scatter of the errors. Its statistic is the sum of `PressErrors.chi_squared`. The
        second test examines the common errors, which are the mean errors of x, y and the force over all presses. Its
        statistic is the sum of the squared significances of the common errors. If noise, film and rig explain the
        errors, each statistic has nearly a chi-squared distribution. The number of degrees of freedom is the number of
        known errors in the first test, and the number of known common errors in the second test.

        Args:
            errors: Errors of all presses; NaN where a measured value is unknown.
            is_selected: Whether each press is selected, shape (n,).
        """
        error = errors.error[is_selected]
        # Standard deviations of the part of the errors that is equal in all presses
        shared_std = np.hypot(errors.film_std, COMMON_RATIO * errors.rig_std)
        common = common_error(error, errors.variance[is_selected], shared_std[is_selected])
        chi_squared = float(errors.chi_squared[is_selected].sum())
        degrees = int(np.count_nonzero(~np.isnan(error)))

        # The errors of the film are not independent, which multiplies the variance of the sum by `variance_factor`.
        # Divided by this factor, the sum has the mean and the variance of a chi-squared variable with fewer degrees of
        # freedom (Satterthwaite 1946).
        film_share = errors.film_std**2 / errors.variance
        film_sum = np.nansum(film_share[is_selected])  # part of the expected sum that the film causes
        variance_factor = 1.0 + film_sum**2 / (FILM_ERRORS * max(degrees, 1))
        common_chi_squared = np.nansum(common.significance**2)
        common_degrees = int(np.count_nonzero(~np.isnan(common.mean)))
        return cls(
            chi_squared=chi_squared,
            degrees=degrees,
            p_value=chi_squared_survival(chi_squared / variance_factor, degrees / variance_factor),
            common=common,
            common_p_value=chi_squared_survival(common_chi_squared, common_degrees),
        )

    @property
    def acceptable(self) -> bool:
        """Whether the noise of the charges and the uncertainty of the rig explain the errors.

        The first test rejects a large scatter of the errors, and the second test rejects large common errors. Each test
        rejects good presses with a probability of `TEST_SIGNIFICANCE`.

        The expected variances are not known exactly, and for many presses even a small error of these variances would
        be significant. The scatter is therefore also accepted if `chi_squared` exceeds its expected value `degrees` by
        only a few percent.
        """
        max_accepted_chi_squared = MAX_ACCEPTED_CHI_SQUARED * self.degrees
        is_scatter_large = self.p_value < TEST_SIGNIFICANCE and self.chi_squared > max_accepted_chi_squared
        is_common_error_large = self.common_p_value < TEST_SIGNIFICANCE
        return not is_scatter_large and not is_common_error_large


def chi_squared_deviate(statistic: ArrayLike, degrees: ArrayLike) -> Array:
    """Convert chi-squared variables to variables with a standard normal distribution, shape (n,).

    Each variable is divided by its degrees of freedom k. The cube root of the quotient is approximately normal with the
    mean 1 - 2 / (9 k) and the variance 2 / (9 k) (Wilson and Hilferty 1931).

    Args:
        statistic: The chi-squared variables, shape (n,), not negative.
        degrees: Degrees of freedom of the variables, shape (n,), 1 or more.
    """
    variance = 2.0 / np.multiply(9.0, degrees)
    cube_root = np.cbrt(np.divide(statistic, degrees))
    return (cube_root - (1.0 - variance)) / np.sqrt(variance)


def chi_squared_survival(statistic: float, degrees: float) -> float:
    """Compute the probability that a chi-squared variable exceeds a value.

    The error of the probability is below 0.05 for one degree of freedom, and below 0.013 for more degrees. For
    probabilities from 0.001 to 0.02, the relative error is below 20 %. Smaller probabilities are overestimated, by a
    factor of up to 2.5 at 1e-5.

    Args:
        statistic: The value, not negative.
        degrees: Degrees of freedom of the variable. Without a degree of freedom, the result is NaN.
    """
    if degrees == 0:
        return math.nan
    return NormalDist().cdf(-float(chi_squared_deviate(statistic, degrees)))
