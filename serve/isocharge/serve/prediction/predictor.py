"""Prediction of contacts from charges in the same process.

A single press uses memory that is bound to the session once. The prediction of a single press therefore allocates no
arrays and is faster than `session.run`. Batches use `session.run`.

`predict` checks the charges and returns a named tuple. `predict_into` is for fast loops: it writes the contact into an
existing array and does not check the charges.
"""

import logging
from collections.abc import Mapping, Sequence
from copy import copy
from pathlib import Path

import numpy as np
import onnxruntime as ort
from numpy.typing import ArrayLike

from isocharge.common.arrays import Array, Singles
from isocharge.common.errors import ChargeError, ModelError, shown
from isocharge.serve.model.model_folder import Model, find_model, load_model
from isocharge.serve.model.session import (
    N_WITHOUT_CORRELATION,
    BoundPress,
    as_batch,
    as_press,
    open_session,
    run,
    write_finite,
)
from isocharge.serve.prediction.contact import Contact, Contacts, Validity

log = logging.getLogger(__name__)


class Predictor:
    """A loaded model that computes contacts from charges.

    `predict` and `predict_into` write into memory that the predictor allocates once. Each thread therefore needs its
    own Predictor. `predict_batch` does not use this memory and may be called from any thread.

    Attributes:
        folder: Version folder of the model.
        metadata: Metadata of the model: sensor, electrodes, working area, measured errors.
        validity: Domain in which the model is valid. `validity.batch_flags` returns the flags of a batch.

    Example:
        >>> from isocharge.serve import Predictor
        >>> touch = Predictor("three-25um-biaxial")
        >>> contact = touch.predict([593.9, 573.5, 435.2])
        >>> contact
        Contact(x_mm=2.989 +- 0.054, y_mm=-1.991 +- 0.036, force_N=0.5014 +- 0.0012, misfit=0.023)
        >>> touch.flags(contact)  # empty: the contact is valid
        ()
    """

    def __init__(self, model: str | Path, *, models: Path | None = None) -> None:
        """Load a model.

        Args:
            model: Name or path of the model, as `find_model` takes it.
            models: Repository in which a name is looked up first.

        Raises:
            ModelError: If the model is missing or damaged, or has an unsupported format.
        """
        loaded = load_model(find_model(model, models))
        self.folder = loaded.folder
        self.metadata = loaded.metadata
        self.validity = Validity.of(loaded.metadata)
        self._graph = loaded.graph
        self._session = loaded.session
        self._press = BoundPress(loaded.session, len(loaded.metadata.electrodes))
        # The limits are looked up once, because they are compared with every contact.
        self._centre_x_mm, self._centre_y_mm = self.validity.centre_mm
        self._limit_mm2, self._limit_N = self.validity.implausible_limits
        self._has_warned = False
        self._constants: Mapping[str, Singles] = {}
        _check_bound_memory(self._press, loaded)

    def with_constants(self, constants: Mapping[str, Singles]) -> "Predictor":
        """Return a predictor with the same graph, but other values of some of its constants.

        The call takes about a millisecond.

        Args:
            constants: New values by the names of the graph's constants.

        Raises:
            ModelError: If the graph has no constant with one of the names, or a shape differs.
        """
        other = copy(self)
        other._constants = constants  # keeps the arrays alive, because onnxruntime uses their memory
        other._session = open_session(self._graph, self.metadata.label, constants)
        other._press = BoundPress(other._session, len(self.metadata.electrodes))
        return other

    def predict(self, charge_pC: Sequence[float] | Array | Singles) -> Contact:
        """Compute the contact of one press. Call `flags` to learn whether the contact is valid.

        The first contact that is too far away or too hard to be a measurement is logged as a warning.

        Args:
            charge_pC: Touch charges, shape (electrodes,), pC, in the order of `metadata.electrodes`.

        Raises:
            ChargeError: If the number of charges is wrong, or a charge is not finite.
        """
        values = charge_pC.tolist() if isinstance(charge_pC, np.ndarray) else charge_pC
        # `write_finite` writes the charges, and returns False if it cannot convert them or a charge is not finite.
        if not write_finite(self._press.write, values):
            # The slow conversion accepts other number types. It raises an error that names the electrode.
            self._press.write(*as_press(charge_pC, self.metadata.electrodes))
        self._press.run()
        contact = Contact(*self._press.read())

        # The distance is compared with its square, which is faster.
        x_mm = contact.x_mm - self._centre_x_mm
        y_mm = contact.y_mm - self._centre_y_mm
        is_implausible = contact.force_N > self._limit_N or x_mm * x_mm + y_mm * y_mm > self._limit_mm2
        if is_implausible:
            self._warn_once(charge_pC, contact)
        return contact

    def flags(self, contact: Contact) -> tuple[str, ...]:
        """Return the reasons why a contact of this model may be wrong: `outside`, `beyond`, `misfit`, `stress`.

        With three electrodes, there are as many charges as unknowns, so the charges contain no redundancy. A wrong
        charge then usually gives the charges of another press. The wrong charge is detected only if the contact of this
        press lies outside the working area or the range of forces.
        """
        return self.validity.flags(contact)

    def predict_into(self, charge_pC: Singles, out: Singles) -> None:
        """Compute the contact of one press, and write it into an existing array. The charges are not checked.

        Args:
            charge_pC: Touch charges, shape (electrodes,), float32, pC, in the order of `metadata.electrodes`. If a
                charge is NaN, the result is NaN.
            out: Array of float32 that receives the values of a Contact in their order, shape (10,), or only the first
                seven values, shape (7,). A model without correlations computes only seven values.

        Raises:
            ChargeError: If an array is not float32 or has another shape. Nothing is written in this case.

        Example:
            >>> charges, contact = np.zeros(3, np.float32), np.zeros(7, np.float32)
            >>> touch.predict_into(charges, contact)  # doctest: +SKIP
        """
        try:
            self._press.run_into(charge_pC, out)
        except (AttributeError, NotImplementedError, TypeError, ValueError) as error:
            raise ChargeError(
                f"expected charges {self.metadata.electrodes} and a writable `out` of the {self._press.size} numbers "
                f"of a Contact that the model gives, or of the first {N_WITHOUT_CORRELATION}, both float32 arrays, got "
                f"{_describe(charge_pC)} and {_describe(out)} ({error})"
            ) from error

    def predict_batch(self, charge_pC: ArrayLike) -> Contacts:
        """Compute the contacts of n presses.

        Args:
            charge_pC: Touch charges, shape (n, electrodes), pC; n may be 0.

        Raises:
            ChargeError: If the shape is wrong, or a charge is not finite. The message names the electrode and the row.
        """
        columns_of_output = self._press.columns
        charges = as_batch(charge_pC, self.metadata.electrodes)
        outputs = run(self._session, charges, tuple(columns_of_output))
        # One row for each press and one column for each attribute of Contact. Correlations are NaN if the model does
        # not compute them.
        contacts = np.full((len(charges), len(Contact._fields)), np.nan, np.float32)
        for name, columns in columns_of_output.items():
            contacts[:, columns] = outputs[name]
        return Contacts(*contacts.T)

    def __repr__(self) -> str:
        """Return the label of the model, its sensor and electrodes, and the domain in which it is valid."""
        metadata = self.metadata
        low_N, high_N = self.validity.force_range_N
        return (
            f"Predictor({metadata.label}: sensor {metadata.frame_id}, charges {' '.join(metadata.electrodes)} (pC), "
            f"positions {self.validity.area_text}, forces {low_N:.3g} to {high_N:.3g} N)"
        )

    def _warn_once(self, charge_pC: object, contact: Contact) -> None:
        """Log a warning for the first contact that cannot be a measurement."""
        if self._has_warned:
            return
        self._has_warned = True
        log.warning(
            "%s: the charges %s pC are far from those of any press in the training, and the contact (%.2f, %.2f) mm, "
            "%.6g N cannot be a measurement; check unit, gain and tare. Further contacts of this kind are not logged; "
            "Predictor.flags reports each of them",
            self.metadata.label,
            shown(charge_pC),
            contact.x_mm,
            contact.y_mm,
            contact.force_N,
        )


def _describe(value: object) -> str:
    """Return the number type and shape of an array, or the type of another object, for an error message."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype} of shape {value.shape}"
    return type(value).__name__


def _check_bound_memory(press: BoundPress, model: Model) -> None:
    """Check that this version of onnxruntime reads and writes the bound memory itself, not a copy.

    A press is computed both in the bound memory and with `session.run`, which copies the arrays. A small difference is
    allowed.

    Args:
        press: Bound memory for one press of the model.
        model: The model. Its golden vectors contain charges, of which the first press is computed.

    Raises:
        ModelError: If the bound press and `session.run` give different results.
    """
    charges = model.golden.charge_pC[:1]  # shape (1, electrodes)
    press.write(*charges[0])
    press.run()
    # `press.read` returns the outputs in the order of `press.columns`.
    outputs = run(model.session, charges, tuple(press.columns))
    expected = np.concatenate([rows[0] for rows in outputs.values()])
    actual = press.read()
    if not np.allclose(actual, expected, rtol=1e-4, atol=1e-4):
        raise ModelError(
            f"{model.folder}: onnxruntime {ort.__version__} computes {actual} in bound memory and "
            f"{tuple(expected.tolist())} without it; report this with the version and the machine"
        )
