"""Networks for the comparison of methods: the evaluated model, and newly trained networks of several sizes.

The other methods of the comparison only estimate the contact. The networks are therefore also compared without their
outputs for standard deviations and misfit.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Self

import numpy as np
import onnx
import onnxruntime as ort
from onnx.utils import Extractor

from isocharge.common.arrays import Array
from isocharge.serve import Predictor
from isocharge.serve.model.session import INPUT, N_WITHOUT_CORRELATION, BoundPress, open_session
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.train.baselines.compared_methods import GivenMethod
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.model_release.onnx_graph import write_contact_graph
from isocharge.train.training.config import FitConfig, NetworkConfig, TrainingConfig
from isocharge.train.training.fit import train_network
from isocharge.train.training.network import fold_contact_mean
from isocharge.train.training.source import TrainingData

EVALUATED_MODEL = "evaluated model"
"""Name of the evaluated model in the comparison."""

SMALL_MISFIT_WIDTH = 8
"""Width of the hidden layers of a misfit perceptron whose output is not used."""


class OnnxContact(GivenMethod):
    """ONNX graph that computes `contact` from `charge_pC`, with the same options of ONNX Runtime as in `Predictor`.

    Args:
        graph: The ONNX file.
    """

    def __init__(self, graph: bytes) -> None:
        self.graph = graph

    def predict(self, charge: Array) -> Array:
        """Estimate contacts, shape (n, 3), mm and N, from charges of shape (n, n_electrode), pC."""
        (contact,) = self._session.run(["contact"], {INPUT: charge.astype(np.float32)})
        return np.asarray(contact, dtype=float)

    def single_press_function(self, charge: Array) -> Callable[[], object]:
        """Return a function without arguments that computes the contact of one press, for measuring its duration.

        Memory for the charges and the contact is bound to the session before the first call, as in `Predictor`. The
        function returns the same array in every call.

        Args:
            charge: Charges of the press, shape (n_electrode,), pC.
        """
        bound_press = BoundPress(self._session, charge.size)
        float32_charge = charge.astype(np.float32)  # the type of the input of the graph
        contact = np.zeros(3, np.float32)  # overwritten by every call

        def compute_contact() -> object:
            """Return the contact (x, y, F) of the press, shape (3,), float32, mm and N."""
            bound_press.run_into(float32_charge, contact)
            return contact

        return compute_contact

    def __getstate__(self) -> dict[str, Any]:
        return {"graph": self.graph}

    @cached_property
    def _session(self) -> ort.InferenceSession:
        """Session of ONNX Runtime, which is opened at the first use."""
        return open_session(self.graph, "the contact's graph")


class TrainedNetwork(OnnxContact):
    """Perceptron that is trained for the comparison, and that estimates only the contact.

    Args:
        data: Sensor and domain. The presses in these data are replaced by the presses of `fit`.
        hidden: Widths of the hidden layers.
        steps: Number of optimiser steps.
        noise: Noise that is added to the charges in every step.
        seed: Seed of weights, batches and noise.
    """

    def __init__(self, data: TrainingData, hidden: tuple[int, ...], steps: int, noise: NoiseModel, seed: int) -> None:
        """Store the settings of the training.

        Args:
            data: Presses of the sensor.
            hidden: Widths of the hidden layers.
            steps: Number of optimiser steps.
            noise: Noise that is added to the charges.
            seed: Seed of weights, batches and noise.
        """
        self.data = data
        self.hidden = hidden
        self.steps = steps
        self.noise = noise
        self.seed = seed

    def fit(self, charge: Array, contact: Array) -> Self:
        """Train the network on presses, and store the ONNX graph that computes its contacts.

        A training always includes the misfit perceptron, whose output is not used here. This perceptron is therefore
        small and trained for one step only.

        Args:
            charge: Charges without noise, shape (n, n_electrode), pC.
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            This estimator.
        """
        misfit_hidden = tuple(SMALL_MISFIT_WIDTH for _ in self.hidden)  # both perceptrons need equally many layers
        network_config = NetworkConfig(hidden=self.hidden, misfit_hidden=misfit_hidden)
        training_config = TrainingConfig(
            steps=self.steps, misfit_steps=1, misfit_charges=1000, hold_out=0.05, seed=self.seed, noise=self.noise
        )
        presses = LabelledPresses(contact, charge, self.data.presses.measured)
        data = replace(self.data, presses=presses)
        training_result = train_network(data, FitConfig(network_config, training_config))

        network_without_stds = fold_contact_mean(training_result.network)
        self.graph = write_contact_graph(network_without_stds)
        return self


class StoredModel(GivenMethod):
    """Model in a folder, which `Predictor` evaluates.

    Args:
        folder: Version folder of the model.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def predict(self, charge: Array) -> Array:
        """Estimate contacts, shape (n, 3), mm and N, from charges of shape (n, n_electrode), pC."""
        contact, _, _ = self.answer(charge)
        return contact

    def answer(self, charge: Array) -> tuple[Array, Array, Array]:
        """From charges, estimate contacts and their standard deviations, and compute misfits.

        The misfit is the distance of the charges from the nearest single contact that the model covers, in standard
        deviations of the noise.

        Args:
            charge: Charges, shape (n, n_electrode), pC.

        Returns:
            Contacts (x, y, F), shape (n, 3), mm and N. Standard deviations of the contacts, shape (n, 3), mm and N.
            Misfits, shape (n, 1), dimensionless. All are float64.
        """
        answers = self.predictor.predict_batch(charge)
        contact = np.stack([answers.x_mm, answers.y_mm, answers.force_N], axis=1)
        std = np.stack([answers.x_std_mm, answers.y_std_mm, answers.force_std_N], axis=1)
        misfit = np.reshape(answers.misfit, (-1, 1))  # one column
        return contact.astype(float), std.astype(float), misfit.astype(float)

    def single_press_function(self, charge: Array) -> Callable[[], object]:
        """Return a function without arguments that computes the answer to one press with `Predictor.predict_into`.

        Args:
            charge: Charges of the press, shape (n_electrode,), pC.
        """
        float32_charge = charge.astype(np.float32)
        answer = np.zeros(N_WITHOUT_CORRELATION, np.float32)  # overwritten by every call
        return partial(self.predictor.predict_into, float32_charge, answer)

    @cached_property
    def predictor(self) -> Predictor:
        """The loaded model."""
        return Predictor(self.folder)

    @property
    def graph(self) -> bytes:
        """The ONNX file."""
        return (self.folder / "model.onnx").read_bytes()

    def contact_only(self) -> OnnxContact:
        """Return the part of the graph that computes the contact.

        The part is compared with other methods, which estimate only the contact.
        """
        extractor = Extractor(onnx.load_model_from_string(self.graph))
        part = extractor.extract_model([INPUT], ["contact"])
        return OnnxContact(part.SerializeToString())
