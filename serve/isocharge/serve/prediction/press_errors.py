"""Errors of a model on measured presses, and statistical tests of these errors.

The rig is the machine that sets the position and the force of each press. The expected variance of an error is the sum
of two variances. The first variance is caused by the noise of the charges, and is reported by the model. The second
variance is caused by the uncertainty of the position or of the force that the rig sets. The tests decide whether the
expected variances explain the errors. One test uses the sum of the squared errors, and the other test uses the mean
errors.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.serve.flags import MISFIT, OUTSIDE
from isocharge.serve.model.contact import Contacts
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.predictor import Predictor
from isocharge.serve.model.session import N_WITHOUT_CORRELATION
from isocharge.serve.model.validity import MISFIT_LIMIT, Validity, inside_polygon
from isocharge.serve.presses.measured_presses import MeasuredPresses

CHARGE_UNKNOWN = "a charge is unknown"
CONTACT_UNKNOWN = "neither place nor force is known"
NOT_TRAINED = "not trained for"
"""Reasons why a press is excluded from the comparison, as parts of a sentence."""

X = 0
Y = 1
FORCE = 2
"""Columns of the errors and standard deviations of `PressErrors`."""

VALUE_COLUMNS = slice(0, 3)
"""Columns of x, y and the force in an array of contacts with one column for each attribute of `Contact`."""

STD_COLUMNS = slice(3, 6)
"""Columns of the standard deviations of x, y and the force in an array of contacts."""

MISFIT_COLUMN = Contacts._fields.index("misfit")
"""Column of the misfit in an array of contacts."""


@dataclass(frozen=True)
class PressErrors:
    """Contacts that a model computed for n measured presses, and the errors of these contacts.

    Attributes:
        lines: Number of the line of each press in its file.
        row_noun: What `lines` counts: "line" of a CSV file, "row" of a Parquet file, or "press".
        predicted: Values of the attributes of `Contact` for each press, shape (n, 10); NaN if a charge is unknown.
        error: Predicted minus measured values of x (mm), y (mm) and the force (relative to the measured force), shape
            (n, 3). The error is NaN if the measured value is unknown.
        noise_std: Standard deviations that the noise of the charges causes, as reported by the model, in the units of
            `error`, shape (n, 3).
        rig_std: Standard deviations of the measured values, in the units of `error`, shape (n, 3).
        flags: Flags of each press. The flag `outside` has the same condition as in `Validity`. The flag `misfit` means
            that the misfit is above `misfit_limit`, which 1 % of good presses exceed.
        exclusion_reasons: Reason why each press is excluded from the comparison; empty for a press that is compared.
    """

    lines: tuple[int, ...]
    row_noun: str
    predicted: Array
    error: Array
    noise_std: Array
    rig_std: Array
    flags: tuple[tuple[str, ...], ...]
    exclusion_reasons: tuple[str, ...]

    @property
    def is_compared(self) -> Booleans:
        """Whether each press is compared, shape (n,)."""
        return np.array([not reason for reason in self.exclusion_reasons], dtype=np.bool_)

    @property
    def variance(self) -> Array:
        """Expected variances of the errors, shape (n, 3)."""
        return self.noise_std**2 + self.rig_std**2

    @property
    def squared_ratio(self) -> Array:
        """Squared errors divided by their expected variances, shape (n, 3)."""
        return self.error**2 / self.variance

    @property
    def position_error_mm(self) -> Array:
        """Distances between predicted and measured positions, shape (n,), mm; NaN if a position is unknown."""
        return np.hypot(self.error[:, X], self.error[:, Y])

    def row(self, press_index: int) -> dict[str, Any]:
        """Return the contact, the errors and the flags of one press as a dictionary whose keys contain the units.

        The correlations of the contact are not included.

        Args:
            press_index: Index of the press; the first press has the index 0.
        """
        error = self.error[press_index]  # x and y in mm, and the force relative to the measured force
        noise_std = self.noise_std[press_index]
        rig_std = self.rig_std[press_index]
        contact_names = Contacts._fields[:N_WITHOUT_CORRELATION]
        contact_values = self.predicted[press_index, :N_WITHOUT_CORRELATION].tolist()
        return {
            "line": self.lines[press_index],
            **dict(zip(contact_names, contact_values, strict=True)),
            "x_error_mm": error[X],
            "y_error_mm": error[Y],
            "position_error_mm": self.position_error_mm[press_index],
            "force_error_percent": 100.0 * error[FORCE],
            "noise_std_percent": 100.0 * noise_std[FORCE],
            "position_std_mm": rig_std[X],
            "force_std_percent": 100.0 * rig_std[FORCE],
            "flags": list(self.flags[press_index]),
            "left_out": self.exclusion_reasons[press_index] or None,  # None if the press is compared
        }


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
    predicted = _predicted_contacts(predictor, model_presses.charge_pC)

    # Differences of x and y are errors in mm. Differences of the force are divided by the measured force.
    divisor = np.ones((len(model_presses), 3))
    divisor[:, FORCE] = measured[:, FORCE]

    # Standard deviations of the measured values. The standard deviation of the force is already relative.
    position_std_mm = model_presses.position_std_mm
    rig_std = np.column_stack([position_std_mm, position_std_mm, model_presses.force_std])
    is_unknown = np.isnan(measured)
    return PressErrors(
        lines=model_presses.lines,
        row_noun=model_presses.row_noun,
        predicted=predicted,
        error=(predicted[:, VALUE_COLUMNS] - measured) / divisor,
        noise_std=np.where(is_unknown, np.nan, predicted[:, STD_COLUMNS] / divisor),
        rig_std=np.where(is_unknown, np.nan, rig_std),
        flags=_flags_of_presses(metadata, predicted),
        exclusion_reasons=_exclusion_reasons(metadata, model_presses),
    )


def misfit_limit(metadata: ModelMetadata) -> float:
    """Return the misfit that 1 % of good presses exceed.

    Args:
        metadata: Metadata of the model. If they do not contain this limit, the result is `MISFIT_LIMIT`.
    """
    return float(metadata.errors.get("misfit_p99", MISFIT_LIMIT))


def _predicted_contacts(predictor: Predictor, charge_pC: Array) -> Array:
    """Predict contacts from the charges of presses. Some charges may be unknown.

    Args:
        predictor: The model.
        charge_pC: Charges, shape (n, electrodes), pC; NaN where unknown.

    Returns:
        Values of the attributes of `Contact` for each press, shape (n, 10). If a charge is unknown, the row is NaN.
    """
    predicted = np.full((len(charge_pC), len(Contacts._fields)), np.nan)
    is_complete = ~np.isnan(charge_pC).any(axis=1)
    predicted[is_complete] = np.column_stack(predictor.predict_batch(charge_pC[is_complete]))
    return predicted


def _flags_of_presses(metadata: ModelMetadata, predicted: Array) -> tuple[tuple[str, ...], ...]:
    """Return which of the flags `outside` and `misfit` each predicted contact has.

    The limit for the flag `misfit` is the misfit that 1 % of good presses exceed. This limit is lower than the limit in
    `Validity`, which only 0.1 % of good presses exceed.

    Args:
        metadata: Metadata of the model.
        predicted: Values of the attributes of `Contact` for each press, shape (n, 10); NaN if a charge is unknown.

    Returns:
        The flags of each press.
    """
    contacts = Contacts(*predicted.astype(np.float32).T)
    validity_flags_of_presses = Validity.of(metadata).batch_flags(contacts)
    has_contact = np.asarray(~np.isnan(predicted).all(axis=1))  # a press with an unknown charge has no contact
    has_misfit = np.asarray(predicted[:, MISFIT_COLUMN] > misfit_limit(metadata))
    flags_of_presses = []
    for press_index, validity_flags in enumerate(validity_flags_of_presses):
        flags = []
        # A position of NaN counts as outside, so the flag of a press without a contact has no meaning.
        if OUTSIDE in validity_flags and has_contact[press_index]:
            flags.append(OUTSIDE)
        if has_misfit[press_index]:
            flags.append(MISFIT)
        flags_of_presses.append(tuple(flags))
    return tuple(flags_of_presses)


def _exclusion_reasons(metadata: ModelMetadata, presses: MeasuredPresses) -> tuple[str, ...]:
    """For each press, return why the press is excluded from the comparison, or an empty text if it is compared.

    The model is compared with presses in its domain, which consists of the working area and the range of forces. The
    measured position and the measured force determine whether a press lies in this domain.

    Args:
        metadata: Metadata of the model, which contain the working area and the range of forces.
        presses: The measured presses, with the charges of the model's electrodes.
    """
    x_mm, y_mm, force_N = presses.contact.T
    min_force_N, max_force_N = metadata.force_range_N
    corners_mm = np.array(metadata.working_area_mm)
    is_outside_area = ~np.isnan(x_mm) & ~inside_polygon(x_mm, y_mm, corners_mm)
    is_outside_forces = (force_N < min_force_N) | (force_N > max_force_N)
    is_contact_unknown = np.isnan(presses.contact).all(axis=1)
    is_charge_unknown = np.isnan(presses.charge_pC).any(axis=1)
    # If several conditions are true, the first condition in the list determines the reason.
    conditions = [is_charge_unknown, is_contact_unknown, is_outside_area | is_outside_forces]
    reasons = np.select(conditions, [CHARGE_UNKNOWN, CONTACT_UNKNOWN, NOT_TRAINED], default="")
    return tuple(reasons.tolist())


SIGNIFICANCE = 0.01
"""Probability that a model that fits is rejected. Each of the two tests has half of this probability."""

MAX_ACCEPTED_CHI_SQUARED = 1.1
"""Chi-squared per degree of freedom up to which the scatter is always accepted, dimensionless.

The limit is above 1, because the standard deviations are known to 5 % at best.
"""

COMMON_RATIO = 0.2
"""Error of the rig that may be equal in all presses, relative to the standard deviation of the rig, dimensionless.

For example, the positions of a stage may have a common offset, and the forces of a load cell a common scale error.
"""


@dataclass(frozen=True)
class ErrorSummary:
    """Summary of the errors of the positions in mm, or of the forces in %.

    Attributes:
        presses: Number of presses.
        rms: Root mean square of the errors.
        median: Median of the absolute errors.
        max: Largest absolute error.
        noise: Expected root mean square of the errors that the noise of the charges causes.
        rig: Expected root mean square of the errors that the uncertainty of the rig causes.
        explained: Expected root mean square of the errors that noise and rig cause together.
        beyond: Square root of rms^2 - explained^2, which is the part that noise and rig do not explain; 0 if this
            difference is negative.
    """

    presses: int
    rms: float
    median: float
    max: float
    noise: float
    rig: float
    explained: float
    beyond: float

    @classmethod
    def from_errors(cls, absolute_error: Array, noise_variance: Array, rig_variance: Array) -> "ErrorSummary | None":
        """Summarise errors, and compare the mean square error with the variances that noise and rig cause.

        The rig is the machine that sets the position and the force of each press.

        Args:
            absolute_error: Absolute error of each press, shape (n,).
            noise_variance: Variance of the error of each press that the noise of the charges causes, shape (n,).
            rig_variance: Variance of the error of each press that the uncertainty of the rig causes, shape (n,).

        Returns:
            The summary; None if there are no presses.
        """
        if absolute_error.size == 0:
            return None
        mean_square = float(np.mean(absolute_error**2))
        mean_noise_variance = float(np.mean(noise_variance))
        mean_rig_variance = float(np.mean(rig_variance))
        explained_variance = mean_noise_variance + mean_rig_variance
        # The errors may happen to be smaller than expected. Nothing is unexplained in this case.
        unexplained_variance = max(mean_square - mean_noise_variance - mean_rig_variance, 0.0)
        return cls(
            presses=absolute_error.size,
            rms=math.sqrt(mean_square),
            median=float(np.median(absolute_error)),
            max=float(absolute_error.max()),
            noise=math.sqrt(mean_noise_variance),
            rig=math.sqrt(mean_rig_variance),
            explained=math.sqrt(explained_variance),
            beyond=math.sqrt(unexplained_variance),
        )


@dataclass(frozen=True)
class CommonError:
    """Estimate of an error that is common to all presses, such as a shift of all positions.

    Attributes:
        mean: Weighted mean of the errors, mm, or relative to the force; NaN if no error is known.
        std: Standard error of the mean. It is larger if the errors scatter more than noise and rig explain.
        significance: Mean divided by a standard error that includes a constant error of the rig; 0 if no error is
            known.
    """

    mean: float
    std: float
    significance: float

    @classmethod
    def from_errors(cls, error: Array, variance: Array, rig_std: Array) -> "CommonError":
        """Estimate the error that is common to all presses, such as a shift of all positions.

        The estimate is the mean of the errors, weighted with the inverse of their expected variances. The significance
        is the mean divided by a standard error. The rig, which is the machine that makes the presses, may have an error
        that is equal in all presses. The standard error includes this error.

        Args:
            error: Error of each press, shape (n,); NaN where unknown.
            variance: Expected variance of each error, shape (n,); NaN where unknown.
            rig_std: Part of the standard deviation of each error that the rig causes, shape (n,); NaN where unknown.
        """
        is_known = ~np.isnan(error)
        count = int(np.count_nonzero(is_known))
        if count == 0:
            return cls(np.nan, np.nan, 0.0)
        known_error = error[is_known]
        weight = 1.0 / variance[is_known]
        total_weight = float(weight.sum())
        mean = float(weight @ known_error) / total_weight
        mean_variance = 1.0 / total_weight

        # If the errors scatter more than their expected variances, the standard error of the mean is increased. One
        # degree of freedom is used for the mean.
        chi_squared = float(weight @ (known_error - mean) ** 2)
        chi_squared_per_degree = chi_squared / max(count - 1, 1)
        std = math.sqrt(mean_variance * max(chi_squared_per_degree, 1.0))

        # For the significance, the standard error also includes an error of the rig that is equal in all presses, so
        # that averaging does not reduce it. Its standard deviation is `COMMON_RATIO` times that of the rig.
        common_rig_std = COMMON_RATIO * float(weight @ rig_std[is_known]) / total_weight
        return cls(mean, std, significance=mean / math.hypot(std, common_rig_std))


@dataclass(frozen=True)
class Agreement:
    """Results of two statistical tests of whether noise and rig explain the errors of the selected presses.

    Attributes:
        chi_squared: Sum of the squared errors divided by their expected variances.
        degrees: Number of degrees of freedom of the sum, which is the number of known errors.
        p_value: Probability that noise and rig alone cause a larger sum; NaN without presses.
        shift_x: Common error of x, mm.
        shift_y: Common error of y, mm.
        force: Common error of the force, relative to the force.
        common_p_value: Probability that noise and rig alone cause larger common errors; NaN without presses.
    """

    chi_squared: float
    degrees: int
    p_value: float
    shift_x: CommonError
    shift_y: CommonError
    force: CommonError
    common_p_value: float

    @classmethod
    def from_errors(cls, errors: PressErrors, is_selected: Booleans) -> "Agreement":
        """Test whether noise and rig explain the errors of the selected presses.

        The rig is the machine that makes the presses. The statistic of the first test is the sum of all squared errors
        divided by their expected variances. The second test uses the errors of x, y and the force that are common to
        all presses. The statistic of this test is the sum of their squared significances. Both statistics have a
        chi-squared distribution if noise and rig explain the errors.

        Args:
            errors: Errors of all presses; NaN where a measured value is unknown.
            is_selected: Whether each press is selected, shape (n,).
        """
        # The columns are x, y and the force.
        error = errors.error[is_selected]
        variance = errors.variance[is_selected]
        rig_std = errors.rig_std[is_selected]
        chi_squared = float(np.nansum(errors.squared_ratio[is_selected]))
        degrees = int(np.count_nonzero(~np.isnan(error)))
        shift_x = CommonError.from_errors(error[:, X], variance[:, X], rig_std[:, X])
        shift_y = CommonError.from_errors(error[:, Y], variance[:, Y], rig_std[:, Y])
        force = CommonError.from_errors(error[:, FORCE], variance[:, FORCE], rig_std[:, FORCE])
        known_common_errors = [common for common in (shift_x, shift_y, force) if not math.isnan(common.mean)]
        squared_significance = sum(common.significance**2 for common in known_common_errors)
        return cls(
            chi_squared=chi_squared,
            degrees=degrees,
            p_value=_p_value(chi_squared, degrees),
            shift_x=shift_x,
            shift_y=shift_y,
            force=force,
            common_p_value=_p_value(squared_significance, len(known_common_errors)),
        )

    @property
    def acceptable(self) -> bool:
        """Whether the noise of the charges and the uncertainty of the rig explain the errors.

        The first test rejects a large scatter of the errors, and the second test rejects large common errors. Each test
        rejects good presses with a probability of `SIGNIFICANCE` / 2. The probability that one of the tests rejects
        good presses is therefore at most `SIGNIFICANCE`.

        The expected variances are not known exactly, and for many presses even a small error of these variances would
        be significant. The scatter is therefore also accepted if `chi_squared` exceeds its expected value `degrees` by
        only a few percent.
        """
        max_p_value = 0.5 * SIGNIFICANCE
        max_accepted_chi_squared = MAX_ACCEPTED_CHI_SQUARED * self.degrees
        is_scatter_large = self.p_value < max_p_value and self.chi_squared > max_accepted_chi_squared
        is_common_error_large = self.common_p_value < max_p_value
        return not is_scatter_large and not is_common_error_large


def _p_value(chi_squared: float, degrees: int) -> float:
    """Return the probability that a variable with a chi-squared distribution exceeds a given value.

    If the distribution has no degrees of freedom, the result is NaN.

    Args:
        chi_squared: The value, not negative.
        degrees: Degrees of freedom of the variable, 0 or more.
    """
    return chi_squared_survival(chi_squared, degrees) if degrees else math.nan


def chi_squared_survival(statistic: float, degrees: int) -> float:
    """Compute the probability that a chi-squared variable exceeds a value.

    The probability is computed as a finite sum (Abramowitz and Stegun 1964, 26.4.4 and 26.4.5).

    Args:
        statistic: The value, not negative. If it is infinite, the probability is 0.
        degrees: Degrees of freedom of the variable, 1 or more.
    """
    half_statistic = 0.5 * statistic
    if half_statistic == 0.0:
        return 1.0
    if math.isinf(half_statistic):
        return 0.0

    # With x = statistic / 2, the probability is the sum of x^s exp(-x) / Gamma(s + 1) over the exponents
    # s = degrees / 2 - 1, degrees / 2 - 2, ... down to 0 or 1/2, plus erfc(sqrt(x)) if the number of degrees is odd.
    # The term with the smallest exponent is computed first: exp(-x) for s = 0, and sqrt(4 x / pi) exp(-x) for s = 1/2.
    is_odd = degrees % 2 == 1
    smallest_exponent = 0.5 if is_odd else 0.0
    smallest_log_term = -half_statistic
    if is_odd:
        smallest_log_term += 0.5 * math.log(4.0 * half_statistic / math.pi)

    # Each term is the previous term times x / s. Logarithms are added, because products of the factors may overflow.
    # For one degree of freedom, there are no terms, and the slice [:0] removes the leading 0.
    term_count = degrees // 2
    later_exponents = smallest_exponent + np.arange(1, term_count)
    log_ratio_to_smallest = np.concatenate([[0.0], np.cumsum(np.log(half_statistic / later_exponents))])
    log_terms = smallest_log_term + log_ratio_to_smallest[:term_count]
    probability = float(np.exp(log_terms).sum())
    if is_odd:
        probability += math.erfc(math.sqrt(half_statistic))
    return min(1.0, probability)
