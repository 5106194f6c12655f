"""From charges to contacts in process.

A single press uses buffers that are bound to the session once: to write three numbers, run and read the answer back
allocates no array and is faster than a plain `session.run`. Batches go through `session.run`.

The loop of a host program uses `predict_into` with its two arrays; people use `predict`, which checks and explains.
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
    """A loaded model. Its buffers serve one press at a time: use one Predictor per thread.

    `predict` and `predict_into` use the buffers; `predict_batch` does not and may be called from any thread.

    Attributes:
        folder: Its version folder.
        metadata: What the model says about itself: sensor, electrodes, working area, measured errors.
        validity: Where the model may be trusted; its `batch_flags` are those of `predict_batch`.

    Example:
        >>> from isocharge.serve import Predictor
        >>> touch = Predictor("three-25um-biaxial")
        >>> contact = touch.predict([593.9, 573.5, 435.2])
        >>> contact
        Contact(x_mm=2.989 +- 0.054, y_mm=-1.991 +- 0.036, force_N=0.5014 +- 0.0012, misfit=0.023)
        >>> touch.flags(contact)  # a reason for each doubt
        ()
    """

    def __init__(self, model: str | Path, *, models: Path | None = None) -> None:
        """Load a model.

        Args:
            model: Name or path, as `find_model` takes it.
            models: Repository in which a name is looked up first.

        Raises:
            ModelError: If it is missing, damaged or of another format.
        """
        loaded = load_model(find_model(model, models))
        self.folder, self.metadata, self._graph = loaded.folder, loaded.metadata, loaded.graph
        self._session = loaded.session
        self.validity = Validity.of(loaded.metadata)
        self._press = BoundPress(loaded.session, len(loaded.metadata.electrodes))
        self._middle_x_mm, self._middle_y_mm = self.validity.middle_mm
        self._far_mm2, self._far_N = self.validity.far
        self._warned = False
        self._constants: Mapping[str, Singles] = {}
        _check_shared(self._press, loaded)

    def with_constants(self, constants: Mapping[str, Singles]) -> "Predictor":
        """The same model with other numbers in the place of its graph's constants, by name; takes a millisecond.

        Raises:
            ModelError: If the graph has not these constants, or not of these shapes.
        """
        other = copy(self)
        other._constants = constants  # onnxruntime computes in their memory
        other._session = open_session(self._graph, self.metadata.label, constants)
        other._press = BoundPress(other._session, len(self.metadata.electrodes))
        return other

    def predict(self, charge_pC: Sequence[float] | Array | Singles) -> Contact:
        """The contact of one press; `flags` says whether to trust it.

        The first answer that is no measurement at all is logged as a warning.

        Args:
            charge_pC: Touch charges, shape (electrodes,), pC, in the order of `metadata.electrodes`.

        Raises:
            ChargeError: If the number of charges is another, or one is not finite.
        """
        values = charge_pC.tolist() if isinstance(charge_pC, np.ndarray) else charge_pC
        if not write_finite(self._press.write, values):  # raises what is wrong, or converts
            self._press.write(*as_press(charge_pC, self.metadata.electrodes))
        self._press.run()
        contact = Contact(*self._press.read())
        x_mm = contact.x_mm - self._middle_x_mm
        y_mm = contact.y_mm - self._middle_y_mm
        if contact.force_N > self._far_N or x_mm * x_mm + y_mm * y_mm > self._far_mm2:
            self._warn(charge_pC, contact)
        return contact

    def flags(self, contact: Contact) -> tuple[str, ...]:
        """The reasons not to trust a contact of this model: `outside`, `beyond`, `misfit`; none if empty.

        Three charges and three unknowns: with three electrodes, a wrong charge mostly looks like another press, and
        only one that leads out of the working area or the forces is seen.
        """
        return self.validity.flags(contact)

    def predict_into(self, charge_pC: Singles, out: Singles) -> None:
        """The contact of one press, for the hot loop: from an array into an array, and nothing else.

        Args:
            charge_pC: Touch charges, shape (electrodes,), float32, pC, in the order of `metadata.electrodes`. They
                are not checked: NaN in, NaN out.
            out: Receives the numbers of a Contact in their order, shape (10,), float32, or the first seven of them,
                which are all that a model without correlations gives.

        Raises:
            ChargeError: If an array is not float32 or of another shape; nothing is written then.

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
                f"{_kind(charge_pC)} and {_kind(out)} ({error})"
            ) from error

    def predict_batch(self, charge_pC: ArrayLike) -> Contacts:
        """The contacts of n presses.

        Args:
            charge_pC: Touch charges, shape (n, electrodes), pC; n may be 0.

        Raises:
            ChargeError: If the shape is another, or a charge is not finite; its electrode and row are named.
        """
        columns = self._press.columns
        outputs = run(self._session, as_batch(charge_pC, self.metadata.electrodes), tuple(columns))
        contacts = np.full((len(outputs["misfit"]), len(Contact._fields)), np.nan, np.float32)
        for name, part in columns.items():
            contacts[:, part] = outputs[name]
        return Contacts(*contacts.T)

    def __repr__(self) -> str:
        """Model, electrodes and domain."""
        metadata = self.metadata
        low, high = self.validity.force_range_N
        return (
            f"Predictor({metadata.label}: sensor {metadata.frame_id}, charges {' '.join(metadata.electrodes)} (pC), "
            f"positions {self.validity.places}, forces {low:.3g} to {high:.3g} N)"
        )

    def _warn(self, charge_pC: object, contact: Contact) -> None:
        """Log, once, that an answer is no measurement."""
        if not self._warned:
            self._warned = True
            log.warning(
                "%s: %s pC are far from any press that the model knows, and (%.2f, %.2f) mm, %.6g N is no measurement; "
                "check unit, gain and tare. Predictor.flags says so of each contact, this line only once",
                self.metadata.label,
                shown(charge_pC),
                *contact[:3],
            )


def _kind(value: object) -> str:
    """What an argument is that is no float32 array of the right shape, for messages."""
    return f"{value.dtype} of shape {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__


def _check_shared(press: BoundPress, model: Model) -> None:
    """Make sure that this onnxruntime computes in the bound memory and not in copies of it.

    Raises:
        ModelError: If the bound press and a plain run disagree.
    """
    charges = model.golden.charge_pC[:1]
    press.write(*charges[0])
    press.run()
    plain = np.concatenate([rows[0] for rows in run(model.session, charges, tuple(press.columns)).values()])
    if not np.allclose(press.read(), plain, rtol=1e-4, atol=1e-4):
        raise ModelError(
            f"{model.folder}: onnxruntime {ort.__version__} answers {press.read()} through bound memory and "
            f"{tuple(plain.tolist())} without; report this with the version and the machine"
        )
