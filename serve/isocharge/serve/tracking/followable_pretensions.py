"""Functions that read and check the network weights of a model for other pretensions of its film.

The module checks that the weights belong to the model.
"""

import numpy as np

from isocharge.common.errors import ModelError
from isocharge.serve.model.pretensions import Pretensions, read_pretensions
from isocharge.serve.prediction.predictor import Predictor


def followable_pretensions(predictor: Predictor) -> Pretensions:
    """Read the file of pretensions of a model, and check that changes of the film can be estimated with the model.

    Args:
        predictor: Model of the calibrated film.

    Returns:
        The weights of the network at any pretension.

    Raises:
        ModelError: If the model has fewer than four electrodes, or has no file of pretensions, or the file of
            pretensions belongs to another model.
    """
    electrodes = predictor.metadata.electrodes
    if len(electrodes) <= 3:  # three charges have no misfit
        raise ModelError(
            f"model {predictor.metadata.label}: its film cannot be followed: {len(electrodes)} charges "
            f"{electrodes} only determine x, y and force; expected a model with four electrodes or more, whose misfit "
            "shows a change of the film"
        )
    pretensions = read_pretensions(predictor.folder)
    _check_same_model(predictor, pretensions)
    return pretensions


def _check_same_model(predictor: Predictor, pretensions: Pretensions) -> None:
    """Check that the weights in a file of pretensions belong to a model.

    With the weights for the calibrated pretension, the graph of the model must compute the same contacts as with the
    weights of the model itself. With the weights for another pretension, the graph must compute different contacts.

    Args:
        predictor: Model of the calibrated film, with its own weights.
        pretensions: Weights of the network at any pretension, from the file.

    Raises:
        ModelError: If the weights belong to another model.
    """
    # The other pretension is an end of the range that differs from the calibrated pretension.
    lowest_MPa, highest_MPa = pretensions.range_MPa
    other_MPa = highest_MPa if pretensions.calibrated_MPa == lowest_MPa else lowest_MPa
    charges_pC = np.outer([0.5, 1.0, 2.0], pretensions.typical_pC)  # a weak, a typical and a strong press
    calibrated_model = predictor.with_constants(pretensions.constants(pretensions.calibrated_MPa))
    other_model = predictor.with_constants(pretensions.constants(other_MPa))
    expected_contacts = np.asarray(predictor.predict_batch(charges_pC))
    calibrated_contacts = np.asarray(calibrated_model.predict_batch(charges_pC))
    other_contacts = np.asarray(other_model.predict_batch(charges_pC))

    # The tolerance covers the rounding errors of the interpolated weights. Correlations that the model does not compute
    # are NaN in both arrays.
    is_equal_at_calibration = np.allclose(calibrated_contacts, expected_contacts, rtol=1e-5, atol=1e-5, equal_nan=True)
    depends_on_pretension = not np.array_equal(other_contacts, expected_contacts)
    if not (is_equal_at_calibration and depends_on_pretension):
        raise ModelError(
            f"{predictor.folder}: pretensions.npz is not of this model.onnx; copy the model's folder again, or "
            "calibrate again"
        )
