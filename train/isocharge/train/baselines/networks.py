"""Networks of several sizes, trained by the usual pipeline, and the released model.

The other methods give a contact and nothing else, so these networks run without deviations and misfit as well.
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
from isocharge.serve.model.session import INPUT, BoundPress, open_session
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.train.baselines.rivals import GivenMethod
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.model_release.onnx_graph import write_contact_graph
from isocharge.train.training.config import FitConfig, NetworkConfig, TrainingConfig
from isocharge.train.training.fit import train_network
from isocharge.train.training.network import fold_contact_mean
from isocharge.train.training.source import TrainingData

RELEASED = "released network"
"""Name of the released model among the methods."""


class OnnxContact(GivenMethod):
    """A graph with the input `charge_pC` and the output `contact` in ONNX Runtime, as `Predictor` runs it.

    Attributes:
        graph: The ONNX file.
    """

    def __init__(self, graph: bytes) -> None:
        self.graph = graph

    def predict(self, charge: Array) -> Array:
        """Contacts, shape (n, 3)."""
        return np.asarray(self._session.run(["contact"], {INPUT: charge.astype(np.float32)})[0], dtype=float)

    def single(self, charge: Array) -> Callable[[], object]:
        """One press, shape (n_electrode,), ready to be computed: through bound memory, as `Predictor` does it."""
        press, row, out = BoundPress(self._session, charge.size), charge.astype(np.float32), np.zeros(3, np.float32)

        def compute() -> object:
            press.run_into(row, out)
            return out

        return compute

    def __getstate__(self) -> dict[str, Any]:
        return {"graph": self.graph}

    @cached_property
    def _session(self) -> ort.InferenceSession:
        return open_session(self.graph, "the contact's graph")


class TrainedNetwork(OnnxContact):
    """The contact network alone, of one size.

    Attributes:
        data: For sensor and domain; the presses are those of `fit`.
        hidden: Widths.
        steps: Optimiser steps.
        noise: On the charges while it trains.
        seed: Of weights, batches and noise.
    """

    def __init__(self, data: TrainingData, hidden: tuple[int, ...], steps: int, noise: NoiseModel, seed: int) -> None:
        self.data, self.hidden, self.steps, self.noise, self.seed = data, hidden, steps, noise, seed

    def fit(self, charge: Array, contact: Array) -> Self:
        """Train on clean presses."""
        training = TrainingConfig(
            steps=self.steps, misfit_steps=1, misfit_charges=1000, hold_out=0.05, seed=self.seed, noise=self.noise
        )
        sizes = NetworkConfig(hidden=self.hidden, misfit_hidden=(8,) * len(self.hidden))
        data = replace(self.data, presses=LabelledPresses(contact, charge, self.data.presses.measured))
        self.graph = write_contact_graph(fold_contact_mean(train_network(data, FitConfig(sizes, training)).network))
        return self


class ReleasedModel(GivenMethod):
    """A model folder through `Predictor`: contact, standard deviations and misfit.

    Attributes:
        folder: The version folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def predict(self, charge: Array) -> Array:
        """Contacts, shape (n, 3)."""
        return self.answer(charge)[0]

    def answer(self, charge: Array) -> tuple[Array, Array, Array]:
        """Contact (n, 3), standard deviations (n, 3) and misfit (n, 1)."""
        columns = np.stack(self.predictor.predict_batch(charge), axis=1).astype(float)
        return columns[:, :3], columns[:, 3:6], columns[:, 6:7]

    def single(self, charge: Array) -> Callable[[], object]:
        """One press, ready to be computed: `Predictor.predict_into`."""
        return partial(self.predictor.predict_into, charge.astype(np.float32), np.zeros(7, np.float32))

    @cached_property
    def predictor(self) -> Predictor:
        """The loaded model."""
        return Predictor(self.folder)

    @property
    def graph(self) -> bytes:
        """The ONNX file."""
        return (self.folder / "model.onnx").read_bytes()

    def contact_only(self) -> OnnxContact:
        """Its contact alone, which is all that the other methods give."""
        part = Extractor(onnx.load_model_from_string(self.graph)).extract_model([INPUT], ["contact"])
        return OnnxContact(part.SerializeToString())
