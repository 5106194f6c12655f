"""Errors of a model on measured presses.

The rig is the machine that sets the position and the force of each press. The expected variance of an error is the sum
of two variances. The first variance is caused by the noise of the charges, and is reported by the model. The second
variance is caused by the uncertainty of the position or of the force that the rig sets.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.common.arrays import Array, Booleans
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

FORCE = 2
"""Column of the force in the errors and standard deviations of `PressErrors`. The columns before it are x and y."""

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
        flags: Flags of each press; empty if a charge is unknown.
        has_misfit: Whether the misfit is above `misfit_limit`, which 1 % of good presses exceed, shape (n,).
        exclusion_reasons: Reason why each press is excluded from the comparison; empty for a press that is compared.
    """

    lines: tuple[int, ...]
    row_noun: str
    predicted: Array
    error: Array
    noise_std: Array
    rig_std: Array
    flags: tuple[tuple[str, ...], ...]
    has_misfit: Booleans
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
        return np.asarray(np.linalg.norm(self.error[:, :FORCE], axis=1))

    def row(self, press_index: int) -> dict[str, Any]:
        """Return the contact, the errors and the flags of one press as a dictionary whose keys contain the units.

        The correlations of the contact are not included.

        Args:
            press_index: Index of the press; the first press has the index 0.
        """
        x_error_mm, y_error_mm, force_error = self.error[press_index]  # the force is relative to the measured force
        noise_std = self.noise_std[press_index]
        rig_std = self.rig_std[press_index]
        contact_names = Contacts._fields[:N_WITHOUT_CORRELATION]
        contact_values = self.predicted[press_index, :N_WITHOUT_CORRELATION].tolist()
        return {
            "line": self.lines[press_index],
            **dict(zip(contact_names, contact_values, strict=True)),
            "x_error_mm": x_error_mm,
            "y_error_mm": y_error_mm,
            "position_error_mm": self.position_error_mm[press_index],
            "force_error_percent": 100.0 * force_error,
            "noise_std_percent": 100.0 * noise_std[FORCE],
            "position_std_mm": rig_std[0],
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
    is_complete = np.asarray(np.isfinite(predicted[:, VALUE_COLUMNS]).all(axis=1))
    flags = Validity.of(metadata).batch_flags(Contacts(*predicted.astype(np.float32).T))
    return PressErrors(
        lines=model_presses.lines,
        row_noun=model_presses.row_noun,
        predicted=predicted,
        error=(predicted[:, VALUE_COLUMNS] - measured) / divisor,
        noise_std=np.where(is_unknown, np.nan, predicted[:, STD_COLUMNS] / divisor),
        rig_std=np.where(is_unknown, np.nan, rig_std),
        flags=tuple(words if is_known else () for words, is_known in zip(flags, is_complete, strict=True)),
        has_misfit=np.asarray(predicted[:, MISFIT_COLUMN] > misfit_limit(metadata)),
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
