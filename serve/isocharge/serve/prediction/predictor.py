"""From charges to contacts in process.

A single press uses buffers that are bound to the session once: to write three numbers, run and read seven back
allocates no array and is faster than a plain `session.run`. Batches go through `session.run`.

The loop of a host program uses `predict_into` with its two arrays; people use `predict`, which checks and explains.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import onnxruntime as ort
from numpy.typing import ArrayLike

from isocharge.arrays import Array, Singles
from isocharge.errors import ChargeError, ModelError
from isocharge.serve.model.charges import as_batch, as_press, write_finite
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.model_folder import Model, load_model
from isocharge.serve.model.repository import find_model
from isocharge.serve.model.session import OUTPUTS, run
from isocharge.serve.prediction.bound_press import BoundPress


class Contact(NamedTuple):
    """Where and how hard one press is, and how sure that is.

    Attributes:
        x_mm, y_mm: Position in the sensor's frame, mm.
        force_N: Force, N, positive when pushing.
        x_std_mm, y_std_mm, force_std_N: Standard deviations.
        misfit: Distance of the charges from the nearest single contact the model knows, in standard deviations.
    """

    x_mm: float
    y_mm: float
    force_N: float
    x_std_mm: float
    y_std_mm: float
    force_std_N: float
    misfit: float


class Contacts(NamedTuple):
    """Contacts of n presses: the fields of `Contact`, each an array of shape (n,), float32."""

    x_mm: Singles
    y_mm: Singles
    force_N: Singles
    x_std_mm: Singles
    y_std_mm: Singles
    force_std_N: Singles
    misfit: Singles


class Predictor:
    """A loaded model. Its buffers serve one press at a time: use one Predictor per thread.

    `predict` and `predict_into` use the buffers; `predict_batch` does not and may be called from any thread.

    Example:
        >>> from isocharge.serve import Predictor
        >>> touch = Predictor("three-25um-biaxial")
        >>> touch.predict([812.0, 790.0, 801.0])  # doctest: +SKIP
        Contact(x_mm=0.1, ...)
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
        self._metadata = loaded.metadata
        self._session = loaded.session
        self._press = BoundPress(loaded.session, len(loaded.metadata.electrodes))
        _check_shared(self._press, loaded)

    @property
    def metadata(self) -> ModelMetadata:
        """What the model says about itself: sensor, electrodes, working area, measured errors."""
        return self._metadata

    def predict(self, charge_pC: Sequence[float] | Array | Singles) -> Contact:
        """The contact of one press.

        Args:
            charge_pC: Touch charges, shape (electrodes,), pC, in the order of `metadata.electrodes`.

        Raises:
            ChargeError: If the number of charges is another, or one is not finite.
        """
        values = charge_pC.tolist() if isinstance(charge_pC, np.ndarray) else charge_pC
        if not write_finite(self._press.write, values):  # raises what is wrong, or converts
            self._press.write(*as_press(charge_pC, self._metadata.electrodes))
        self._press.run()
        return Contact(*self._press.read())

    def predict_into(self, charge_pC: Singles, out: Singles) -> None:
        """The contact of one press, for the hot loop: from an array into an array, and nothing else.

        Args:
            charge_pC: Touch charges, shape (electrodes,), float32, pC, in the order of `metadata.electrodes`. They
                are not checked: NaN in, NaN out.
            out: Receives the numbers of a Contact in their order, shape (7,), float32.

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
                f"expected charges {self._metadata.electrodes} and a writable `out` of the {len(Contact._fields)} "
                f"numbers of a Contact, both float32 arrays, got {_kind(charge_pC)} and {_kind(out)} ({error})"
            ) from error

    def predict_batch(self, charge_pC: ArrayLike) -> Contacts:
        """The contacts of n presses.

        Args:
            charge_pC: Touch charges, shape (n, electrodes), pC; n may be 0.

        Raises:
            ChargeError: If the shape is another, or a charge is not finite; its electrode and row are named.
        """
        outputs = run(self._session, as_batch(charge_pC, self._metadata.electrodes))
        return Contacts(*np.concatenate([outputs[name] for name in OUTPUTS], axis=1).T)


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
    plain = np.concatenate([rows[0] for rows in run(model.session, charges).values()])
    if not np.allclose(press.read(), plain, rtol=1e-4, atol=1e-4):
        raise ModelError(
            f"{model.folder}: onnxruntime {ort.__version__} answers {press.read()} through bound memory and "
            f"{tuple(plain.tolist())} without; report this with the version and the machine"
        )
