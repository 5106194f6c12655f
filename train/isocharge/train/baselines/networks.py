"""Networks of several sizes, trained by the usual pipeline, and what carries them: torch, ONNX Runtime, NumPy.

The other methods give a contact and nothing else, so the contact network runs alone, without deviations and misfit; the
released model, `ReleasedModel`, gives all seven numbers.
"""

import io
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import onnx.utils
import onnxruntime as ort
import torch

from isocharge.common.arrays import Array
from isocharge.serve import Predictor
from isocharge.serve.model.session import open_session
from isocharge.simulate.dataset.shards import Dataset
from isocharge.train.baselines.estimator import Fitted, FittingTask
from isocharge.train.data.domain import HIGHEST_PC, LOWEST_PC
from isocharge.train.release.export import GraphBuilder, add_layers, make_model
from isocharge.train.release.folding import FoldedLayers, contact_alone
from isocharge.train.training.config import FitConfig, NetworkConfig, TrainingConfig
from isocharge.train.training.fit import fit_network
from isocharge.train.training.network import InverseNetwork


@dataclass(frozen=True)
class Network:
    """A network of one size.

    Attributes:
        dataset: What it learns from; split by position with the task's seed and share.
        hidden: Widths.
        steps: Optimiser steps.
        hold_out: Share of the positions that the task holds back.
    """

    dataset: Dataset
    hidden: tuple[int, ...] = (64, 64, 64)
    steps: int = 4_000
    hold_out: float = 0.1

    @property
    def name(self) -> str:
        """With its widths."""
        return f"network {'-'.join(map(str, self.hidden))}"

    def fit(self, task: FittingTask) -> tuple[Fitted, ...]:
        """Train, and give the contact network in torch, ONNX Runtime (session.run, iobinding) and NumPy."""
        training = TrainingConfig(
            steps=self.steps,
            misfit_steps=1,
            misfit_charges=1000,
            hold_out=self.hold_out,
            seed=task.seed,
            noise=task.noise.name,
        )
        sizes = NetworkConfig(hidden=self.hidden, misfit_hidden=(8,) * len(self.hidden))
        network = fit_network(self.dataset, FitConfig(sizes, training), warn=lambda _: None).network
        choice, layers = f"{self.steps} steps", contact_alone(network)
        graph = contact_graph(layers)
        return (
            TorchNetwork(network, choice, self.name),
            SessionNetwork(graph, choice, self.name),
            BoundNetwork(graph, choice, self.name),
            NumpyNetwork(layers, choice, self.name),
        )


def contact_graph(layers: FoldedLayers) -> bytes:
    """An ONNX graph with the input `charge_pC` [n, n_electrode] and the output `contact` [n, 3], float32."""
    build = GraphBuilder()
    within = build.add("Clip", "charge_pC", build.constant(LOWEST_PC), build.constant(HIGHEST_PC))
    value = add_layers(build, build.add("Log", within), layers)
    plane, log_force = build.split(value, ("plane", "log_force"), (2, 1), axis=1)
    build.add("Concat", plane, build.add("Exp", log_force), to="contact", axis=1)
    return bytes(make_model(build, "contact", len(layers.skip), {"contact": 3}).SerializeToString())


@dataclass(frozen=True)
class TorchNetwork(Fitted):
    """In torch, as it was trained."""

    network: InverseNetwork
    choice: str
    name: str
    form: str = "torch"

    def predict(self, charge_pC: Array) -> Array:
        """See `Fitted.predict`."""
        return self._contacts(torch.tensor(charge_pC).float()).double().numpy()

    def _contacts(self, charge_pC: torch.Tensor) -> torch.Tensor:
        with torch.inference_mode():
            value = self.network.posterior(charge_pC)[0] * self.network.scale + self.network.centre
            return torch.cat([value[:, :2], torch.exp(value[:, 2:])], dim=1)

    def one(self, charge_pC: Array) -> Callable[[], object]:
        """See `Fitted.one`."""
        row = torch.tensor(charge_pC).float()[None]
        return lambda: self._contacts(row)

    @property
    def memory(self) -> int:
        """See `Fitted.memory`: the contact network and its normalisation."""
        buffer = io.BytesIO()
        names = ("typical", "logs_mean", "whitening", "scale", "centre")
        parts = {name: getattr(self.network, name) for name in names}
        torch.save({**self.network.contact.state_dict(), **parts}, buffer)
        return buffer.tell()


@dataclass(frozen=True)
class SessionNetwork(Fitted):
    """In ONNX Runtime, one `session.run` per call."""

    graph: bytes
    choice: str
    name: str
    form: str = "ONNX Runtime"

    @cached_property
    def session(self) -> ort.InferenceSession:
        """One thread, no spinning."""
        return open_session(self.graph, self.name)

    def predict(self, charge_pC: Array) -> Array:
        """See `Fitted.predict`."""
        contact: Array = self.session.run(None, {"charge_pC": charge_pC.astype(np.float32)})[0].astype(float)
        return contact

    def one(self, charge_pC: Array) -> Callable[[], object]:
        """See `Fitted.one`."""
        feed = {"charge_pC": charge_pC.astype(np.float32)[None]}
        return partial(self.session.run, None, feed)

    @property
    def memory(self) -> int:
        """See `Fitted.memory`: the file."""
        return len(self.graph)


@dataclass(frozen=True)
class BoundNetwork(SessionNetwork):
    """In ONNX Runtime, buffers bound once."""

    form: str = "ONNX Runtime, bound"

    @cached_property
    def _bound(self) -> "_Bound":
        return _Bound(self.session, self.session.get_inputs()[0].shape[1])

    def one(self, charge_pC: Array) -> Callable[[], object]:
        """See `Fitted.one`: charges into the bound input, run, answers out of the bound output."""
        bound, charge, out = self._bound, charge_pC.astype(np.float32), np.zeros(3, np.float32)

        def compute() -> object:
            bound.charges[:] = charge
            bound.run()
            out[:] = bound.answers
            return out

        return compute


class _Bound:
    """Input and output memory of one press."""

    def __init__(self, session: ort.InferenceSession, electrodes: int) -> None:
        charges, answers = np.zeros((1, electrodes), np.float32), np.zeros((1, 3), np.float32)
        binding = session.io_binding()
        binding.bind_input("charge_pC", "cpu", 0, np.float32, charges.shape, charges.ctypes.data)
        binding.bind_output("contact", "cpu", 0, np.float32, answers.shape, answers.ctypes.data)
        self.charges, self.answers = charges[0], answers[0]
        self.run: Callable[[], None] = partial(session.run_with_iobinding, binding)


@dataclass(frozen=True)
class NumpyNetwork(Fitted):
    """In NumPy, float64."""

    layers: FoldedLayers
    choice: str
    name: str
    form: str = "NumPy"

    def predict(self, charge_pC: Array) -> Array:
        """See `Fitted.predict`."""
        value = logs = np.log(np.minimum(np.maximum(charge_pC, LOWEST_PC), HIGHEST_PC))
        for weight, bias in self.layers.hidden:
            value = np.tanh(value @ weight + bias)
        contact: Array = value @ self.layers.last[0] + logs @ self.layers.skip + self.layers.last[1]
        contact[..., 2] = np.exp(contact[..., 2])
        return contact

    def one(self, charge_pC: Array) -> Callable[[], object]:
        """See `Fitted.one`."""
        return partial(self.predict, np.array(charge_pC, dtype=float))

    @property
    def memory(self) -> int:
        """See `Fitted.memory`."""
        return len(pickle.dumps(self.layers))


RELEASED = "released network"
"""Name of the released model among the methods."""


def contact_of(model: bytes) -> bytes:
    """The part of a released model's graph that gives the contact, without standard deviations and misfit."""
    graph = onnx.load_model_from_string(model)
    return bytes(onnx.utils.Extractor(graph).extract_model(["charge_pC"], ["contact"]).SerializeToString())


@dataclass(frozen=True)
class ReleasedModel(Fitted):
    """A model folder through `Predictor`: contact, standard deviations and misfit."""

    folder: Path
    name: str = RELEASED
    choice: str = "as released"
    form: str = "Predictor"

    @cached_property
    def predictor(self) -> Predictor:
        """The loaded model."""
        return Predictor(self.folder)

    def predict(self, charge_pC: Array) -> Array:
        """See `Fitted.predict`."""
        return self.answer(charge_pC)[0]

    def contact_only(self) -> BoundNetwork:
        """Its contact alone, which is all that the other methods give."""
        graph = contact_of((self.folder / "model.onnx").read_bytes())
        return BoundNetwork(graph, "as released, its contact alone", f"{self.name}, contact only")

    def answer(self, charge_pC: Array) -> tuple[Array, Array, Array]:
        """Contact (n, 3), standard deviations (n, 3) and misfit (n, 1)."""
        columns = np.stack(self.predictor.predict_batch(charge_pC), axis=1).astype(float)
        return columns[:, :3], columns[:, 3:6], columns[:, 6:]

    def one(self, charge_pC: Array) -> Callable[[], object]:
        """See `Fitted.one`: `Predictor.predict_into`."""
        return partial(self.predictor.predict_into, charge_pC.astype(np.float32), np.zeros(7, np.float32))

    @property
    def memory(self) -> int:
        """See `Fitted.memory`: the file."""
        return (self.folder / "model.onnx").stat().st_size
