"""Prediction of contacts from charges in the process of the caller, without a server.

The charges and the contact of a single press are stored in memory that is bound to the onnxruntime session once. The
prediction of a single press therefore allocates no arrays and is faster than `session.run`. Batches are predicted with
`session.run`.

`Predictor.predict` checks the charges and returns a named tuple. `Predictor.predict_into` does not check the charges
and writes the contact into an existing array, which is faster in a loop.
"""

import logging
import threading
from dataclasses import replace
from typing import Any

import numpy as np
from msgspec import structs
from numpy.typing import ArrayLike

from isocharge.common.arrays import Array, Singles
from isocharge.common.errors import ChargeError, shown
from isocharge.common.files import StrPath
from isocharge.common.structs import WrongKey, convert
from isocharge.serve.flags import BEYOND
from isocharge.serve.model.contact import Contact, Contacts, Validity, add_covariance, as_charges, write_finite
from isocharge.serve.model.metadata import ModelNoise
from isocharge.serve.model.model_folder import find_model, load_checked_model
from isocharge.serve.model.session import COLUMNS, BoundPress, run

log = logging.getLogger(__name__)


class Predictor:
    """A loaded model that computes contacts from charges.

    All methods may be called from any thread. `predict` and `predict_into` use memory that the predictor allocates
    once, so only one thread at a time can execute these two methods. Threads that must not wait for each other need
    their own predictors. `predict_batch` does not use this memory. A predictor that is copied or unpickled is loaded
    again from its folder.

    Attributes:
        folder: Version folder of the model.
        metadata: Metadata of the model, such as the sensor, the electrodes, the working area and the measured errors.
        validity: Domain in which the model is valid. `validity.batch_flags` returns the flags of a batch.
        noise: Noise of the charges for which the standard deviations are stated: the noise of the training, or the
            noise that was given to `with_noise`.

    Example:
        >>> from isocharge.serve import Predictor
        >>> touch = Predictor("three-25um-biaxial")
        >>> contact = touch.predict([593.9, 573.5, 435.2])
        >>> contact
        Contact(x_mm=2.992 +- 0.053, y_mm=-1.991 +- 0.035, force_N=0.5013 +- 0.0012, misfit=0.021)
        >>> touch.flags(contact)  # empty: the contact is valid
        ()
    """

    def __init__(self, model: StrPath, *, models: StrPath | None = None) -> None:
        """Load a model.

        Args:
            model: Name or path of the model, as `find_model` accepts it.
            models: Repository that is searched first for a model with this name.

        Raises:
            ModelError: If the model is missing, or `load_checked_model` refuses it.
        """
        loaded = load_checked_model(find_model(model, models))
        self.folder = loaded.folder.absolute()
        self.metadata = loaded.metadata
        self.validity = Validity.of(loaded.metadata)
        self._session = loaded.session
        # Inference of one press: memory for its charges and its contact, which is bound to the session
        self._single_inference = BoundPress(loaded.session, len(loaded.metadata.electrodes))
        self._single_inference_lock = threading.Lock()  # held while a method uses this memory
        # Set when the first warning is logged. The predictors that `with_noise` returns share this event.
        self._has_warned = threading.Event()
        self.noise = loaded.metadata.noise

    def with_noise(self, white_pC: ArrayLike, gain: ArrayLike) -> "Predictor":
        """Return a predictor of the same model for charges whose noise differs from the noise of the training.

        The predicted positions and forces are the same. If the given noise is larger than the noise of the training,
        the standard deviations of the contacts increase. The misfit is then stated in units of the given noise. If the
        given noise is smaller, the standard deviations and the misfit do not change. The method `predict_into` ignores
        the given noise.

        Args:
            white_pC: Standard deviation of the part of the noise that does not depend on the charge, pC. The argument
                is one number for all electrodes, or a list or an array with one number for each electrode.
            gain: Standard deviation of the part that is proportional to the charge, relative to the charge, as one
                number or as one number for each electrode.

        Raises:
            ChargeError: If a standard deviation is not a finite number of at least 0, or if a list does not have one
                number for each electrode.
        """
        # The noise of a charge has the variance white_pC^2 + (gain * charge)^2. "stated" is only a name.
        content = {"name": "stated", "white_pC": np.asarray(white_pC).tolist(), "gain": np.asarray(gain).tolist()}
        noise = convert(content, ModelNoise, "noise", ChargeError)  # checks the types and the signs
        try:
            structs.replace(self.metadata, noise=noise)  # creates new metadata, only to check the lengths of the lists
        except WrongKey as error:
            raise ChargeError(f"{error.key}: {error}") from error

        # The charges of a touch must exceed the stated noise, too.
        validity = replace(self.validity, white_pC=noise.white_pC)
        # Copy the attributes of this predictor. A call of `__init__` would load the model again.
        new_predictor = object.__new__(type(self))
        new_predictor.__dict__.update(self.__dict__, noise=noise, validity=validity)
        return new_predictor

    def for_measured_noise(self, noise_pC: Array) -> "Predictor":
        """Return a predictor for a measured noise if it is much larger than the stated noise, and otherwise self.

        A noise up to 1.5 times the stated noise has no effect, because a tare measures the noise inaccurately.

        Args:
            noise_pC: Measured noise that does not depend on the charge, as a standard deviation, shape (n_electrode,),
                pC.
        """
        white_pC = np.asarray(self.noise.white_pC)
        if (noise_pC > 1.5 * white_pC).any():
            return self.with_noise(np.maximum(noise_pC, white_pC), self.noise.gain)
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how `copy` and `pickle` create the predictor again, because an onnxruntime session cannot be copied.

        The predictor is loaded again from its folder. If the noise was stated with `with_noise`, this noise and its
        limits for touches are restored.
        """
        is_stated = self.noise is not self.metadata.noise
        state = {"noise": self.noise, "validity": self.validity} if is_stated else None
        return type(self), (self.folder,), state

    def predict(self, charge_pC: ArrayLike) -> Contact:
        """Compute the contact of one press. Call `flags` to find out whether the contact is valid.

        If the position or the force is too large to be a measurement, a warning is logged. Only the first warning of a
        predictor is logged.

        Args:
            charge_pC: Touch charges, shape (electrodes,), pC, in the order of `metadata.electrodes`.

        Raises:
            ChargeError: If the number of charges is wrong, or a charge is not finite.
        """
        contact, _flags = self.predict_with_flags(charge_pC)
        return contact

    def predict_with_flags(self, charge_pC: ArrayLike) -> tuple[Contact, tuple[str, ...]]:
        """Compute the contact of one press as `predict` does, and the flags of the contact as `flags` does.

        If the flags contain `BEYOND`, the contact cannot be a measurement. Only the first time, a warning is logged.

        Args:
            charge_pC: Touch charges, shape (electrodes,), pC.

        Raises:
            ChargeError: If the number of charges is wrong, or a charge is not finite.
        """
        if self.noise is self.metadata.noise:  # `with_noise` has not changed the noise: run the model once
            values = charge_pC.tolist() if isinstance(charge_pC, np.ndarray) else charge_pC
            # Memory of one press: `write` stores the charges, `run` runs the model, and `read` returns the contact.
            inference = self._single_inference
            with self._single_inference_lock:
                # `write_finite` is fast. It returns False if it cannot convert the values, or if one is not finite.
                if not write_finite(inference.write, values):
                    # `as_charges` is slower, accepts more number types, and raises errors that name the electrode.
                    (checked_pC,) = as_charges(charge_pC, self.metadata.electrodes, is_batch=False)
                    inference.write(*checked_pC)
                inference.run()
                contact = Contact(*inference.read())
        else:  # run the model several times, to find how the additional noise changes the contact
            contacts = self._predict_with_noise(as_charges(charge_pC, self.metadata.electrodes, is_batch=False))
            contact = Contact(*np.asarray(contacts, float)[0].tolist())

        flags = self.validity.flags(contact)
        if BEYOND in flags and not self._has_warned.is_set():
            self._has_warned.set()  # the warning is logged only once
            log.warning(
                "%s: the charges %s pC on %s are far from those of any press in the training, and %s cannot be a "
                "measurement; check the unit, the gain and the tare, and with `isocharge serve doctor "
                "--check-electrodes` whether wires are swapped. Further contacts of this kind are not logged; "
                "Predictor.flags reports each of them",
                self.metadata.label,
                charge_pC,
                " ".join(self.metadata.electrodes),
                contact,
            )
        return contact, flags

    def flags(self, contact: Contact) -> tuple[str, ...]:
        """Return the reasons why a contact may be wrong: `outside`, `beyond`, `misfit` and `stress`.

        A film with three electrodes has as many charges as unknowns, so the misfit cannot reveal a wrong charge. On
        such a film, a contact that is computed from a wrong charge usually has no flag. The wrong charge is noticed
        only if the computed contact lies outside the working area or the range of forces.

        Args:
            contact: Contact that this model computed.

        Returns:
            The reasons; empty if the contact is valid.
        """
        return self.validity.flags(contact)

    def predict_into(self, charge_pC: Singles, out: Singles) -> None:
        """Compute the contact of one press, and write the contact into an existing array.

        The values of the charges are not checked, so that the call is fast.

        Args:
            charge_pC: Touch charges, shape (electrodes,), float32, pC, in the order of `metadata.electrodes`. If a
                charge is NaN, the result is NaN.
            out: Array to which the ten values of the contact are written, float32, shape (10,). The values have the
                order of the attributes of `Contact`.

        Raises:
            ChargeError: If an array is not float32 or has another shape. Nothing is written in this case.

        Example:
            >>> charges, contact = np.zeros(3, np.float32), np.zeros(10, np.float32)
            >>> touch.predict_into(charges, contact)  # doctest: +SKIP
        """
        try:
            with self._single_inference_lock:
                self._single_inference.run_into(charge_pC, out)
        except (AttributeError, NotImplementedError, TypeError, ValueError) as error:
            raise ChargeError(
                f"expected charges {self.metadata.electrodes} and a writable `out` for the {len(Contact._fields)} "
                f"numbers of a Contact, both float32 arrays, got {shown(charge_pC)} and {shown(out)} ({error})"
            ) from error

    def predict_batch(self, charge_pC: ArrayLike) -> Contacts:
        """Compute the contacts of n presses.

        Args:
            charge_pC: Touch charges, shape (n, electrodes), pC, in the order of `metadata.electrodes`; n may be 0.

        Raises:
            ChargeError: If the shape is wrong, or a charge is not finite. The message names the electrode and the row.
        """
        charges = as_charges(charge_pC, self.metadata.electrodes, is_batch=True)
        if self.noise is not self.metadata.noise:
            return self._predict_with_noise(charges)
        return Contacts(*self.predict_rows(charges).T)

    def _predict_with_noise(self, charge_pC: Singles) -> Contacts:
        """Compute the contacts of n presses whose charges have more noise than the charges in the training.

        The additional noise is the part of the present noise that exceeds the noise of the training. Its effect is the
        change of the contact when one charge changes by one standard deviation of its additional noise. The squared
        effects of all charges are added to the covariance of the contact. The misfit is divided by the ratio of the
        present noise to the noise of the training (root mean square over the electrodes).

        Args:
            charge_pC: Touch charges, shape (n, electrodes), pC.
        """
        charges = charge_pC.astype(float)
        model_variance = self.metadata.noise.variance(charges)
        extra_variance = np.maximum(self.noise.variance(charges) - model_variance, 0.0)
        relative_extra = extra_variance / np.maximum(model_variance, np.finfo(float).tiny)  # a model may have no noise
        noise_ratio = np.sqrt(1.0 + relative_extra.mean(axis=1))

        extra_std_pC = np.sqrt(extra_variance)
        # `contacts` contains the ten numbers of each contact, shape (n, 10). `effects` contains the changes of x, y and
        # the force by the noise of each electrode, shape (electrodes, n, 3).
        contacts, effects = self.noise_effects(charge_pC, extra_std_pC)
        covariance = np.einsum("kni,knj->nij", effects, effects)  # sum over the electrodes (index k)
        result = Contacts(*add_covariance(contacts, covariance).T)
        return result._replace(misfit=(result.misfit / noise_ratio).astype(np.float32))

    def noise_effects(self, charge_pC: Array | Singles, noise_std_pC: Array) -> tuple[Singles, Array]:
        """Compute contacts, and the change of each contact by the noise of each charge.

        Each charge is raised and lowered by the standard deviation of its noise. Half of the difference between the two
        contacts is the effect of the noise of this charge (central difference).

        Args:
            charge_pC: Touch charges, shape (n, electrodes), pC. They are not checked.
            noise_std_pC: Standard deviations of the noise, shape (n, electrodes), pC.

        Returns:
            The ten numbers of each contact, shape (n, 10). Changes of x (mm), y (mm) and the force (N) by the noise of
            each electrode, shape (electrodes, n, 3).
        """
        # One electrode at a time, so that many presses do not need much memory. `COLUMNS` selects x, y and the force.
        effects = []
        for is_electrode in np.eye(charge_pC.shape[1]):
            step_pC = noise_std_pC * is_electrode
            raised = self.predict_rows((charge_pC + step_pC).astype(np.float32))
            lowered = self.predict_rows((charge_pC - step_pC).astype(np.float32))
            effects.append(0.5 * (raised - lowered)[:, COLUMNS["contact"]])
        return self.predict_rows(charge_pC.astype(np.float32)), np.array(effects, float)

    def predict_rows(self, charges: Singles) -> Singles:
        """Compute the contacts of n presses, with the standard deviations for the noise of the training.

        The charges are not checked.

        Args:
            charges: Touch charges, shape (n, electrodes), pC.

        Returns:
            The ten numbers of each contact in the order of the attributes of `Contact`, shape (n, 10).
        """
        if len(charges) == 1:
            contact = np.empty((1, len(Contact._fields)), np.float32)
            self.predict_into(charges[0], contact[0])  # is faster than `run`
            return contact
        outputs = run(self._session, charges)
        return np.concatenate([outputs[name] for name in COLUMNS], axis=1)

    def __repr__(self) -> str:
        """Return a text with the label, the sensor, the electrodes and the valid domain of the model."""
        metadata = self.metadata
        low_N, high_N = self.validity.force_range_N
        return (
            f"Predictor({metadata.label}: sensor {metadata.frame_id}, charges {' '.join(metadata.electrodes)} (pC), "
            f"positions {self.validity.area_text}, forces {low_N:.3g} to {high_N:.3g} N)"
        )
