"""Fixtures of the service: a linear film, whose contacts follow from its charges in closed form, and its model.

On the linear film, a contact with the force F at the position p gives an electrode in the direction u the charge
Q = 800 pC/N * F * (1 + u.p / 20 mm). The sum of the charges gives the force exactly, and their weighted mean gives the
position exactly. A small ONNX graph computes both. The contacts that the service computes can therefore be compared
with the contacts that were pressed.
"""

import errno
import os
import re
import shutil
import ssl
from dataclasses import dataclass
from threading import Thread

import numpy as np
import onnx.parser
import pytest
import trustme
from onnx import helper, numpy_helper

from boards import TcpBoard, taps
from isocharge.serve import ModelMetadata, PredictionRecord, Predictor, write_model
from isocharge.serve.model.metadata import ModelNoise
from isocharge.serve.network.address import Address
from isocharge.serve.network.http.server import HttpServer
from isocharge.serve.network.model_store import ModelStore
from isocharge.serve.network.protocol.handler import Handler
from isocharge.serve.record.record import record_fields

NAMES = ("A", "B", "C", "D")
"""Names of the electrodes."""

PC_PER_N = 800.0
"""Charge of an electrode for a force of 1 N at the centre, pC/N."""

LEVER_MM = 20.0
"""Distance from the centre at which the charge of an electrode vanishes or doubles, mm."""

RADIUS_MM = 8.0
"""Radius of the working area, mm."""


GRAPH = """
<ir_version: 9, opset_import: ["": 17]>
linear_film (float[BATCH, ELECTRODES] charge_pC) => (
    float[BATCH, 3] contact, float[BATCH, 3] contact_std, float[BATCH, 3] contact_correlation, float[BATCH, 1] misfit
)
<
    int64[1] axes = {1},
    float[ELECTRODES, 2] lever = {LEVER},
    float[1, 1] pC_per_N = {PC_PER_N},
    float[1, 3] std_scale = {50.0, 50.0, 0.0},
    float[1, 3] std_floor = {0.0, 0.0, 0.0007},
    float[1, 3] no_correlation = {0.0, 0.0, 0.0}
>
{
    sum = ReduceSum <keepdims = 1> (charge_pC, axes)
    moment = MatMul (charge_pC, lever)
    position = Div (moment, sum)
    force = Div (sum, pC_per_N)
    contact = Concat <axis = 1> (position, force)
    std_position = Div (std_scale, sum)
    contact_std = Add (std_position, std_floor)
    contact_correlation = Mul (contact_std, no_correlation)
    negated = Neg (charge_pC)
    negative = Relu (negated)
    misfit = ReduceSum <keepdims = 1> (negative, axes)
}
"""
"""Graph of the model in the text format of ONNX. Words in capitals stand for numbers."""


@dataclass(frozen=True)
class LinearFilm:
    """A linear film, its forward map and its model.

    Attributes:
        directions: Direction of each electrode from the centre, unit vectors, shape (n_electrode, 2).
    """

    directions: np.ndarray

    @classmethod
    def with_electrodes(cls, n):
        """Return the film with n electrodes, which are evenly distributed on a circle."""
        angle = 2 * np.pi * np.arange(n) / n - np.pi / 2
        return cls(np.column_stack([np.cos(angle), np.sin(angle)]))

    @property
    def electrodes(self):
        """Names of the electrodes."""
        return NAMES[: len(self.directions)]

    def charge_pC(self, x_mm, y_mm, force_N):
        """Compute the charges of n contacts, shape (n, n_electrode), pC, from arrays of shape (n,)."""
        relative_change = np.column_stack([x_mm, y_mm]) @ self.directions.T / LEVER_MM
        return PC_PER_N * np.asarray(force_N)[:, None] * (1.0 + relative_change)

    def charges(self, contact):
        """Compute the charges of contacts (x, y, F), shape (n, 3)."""
        return self.charge_pC(*contact.T)

    def metadata(self, **changes):
        """Return the metadata of the model with some changed values."""
        angle = 2 * np.pi * np.arange(64) / 64
        values = {
            "name": "linear",
            "version": 1,
            "sensor": {"name": "linear-film", "film": {"radius_mm": 45.0}, "piezo": {"d31": 8.0, "d32": 8.0}},
            "electrodes": self.electrodes,
            "working_area_mm": tuple((RADIUS_MM * np.cos(a), RADIUS_MM * np.sin(a)) for a in angle.tolist()),
            "probes": ("circle:1.0",),
            "force_range_N": (0.05, 2.0),
            "noise": ModelNoise(name="reference", white_pC=1.0, gain=0.002),
            "dataset_sha256": "0" * 64,
            "errors": {"position_median_mm": 0.0},
            "made_with": {"command": "pytest"},
        }
        return ModelMetadata(**(values | changes))

    def onnx(self, props, *, renamed=None, batch="n"):
        """Return the ONNX graph of the model.

        Args:
            props: Metadata that are stored in the graph.
            renamed: Wrong names of inputs and outputs by their right names, for tests of wrong interfaces.
            batch: Size of the batch. A number makes the interface wrong.
        """
        lever = (2.0 * LEVER_MM * self.directions).ravel()
        values = {"BATCH": batch, "ELECTRODES": len(self.directions), "LEVER": ", ".join(map(str, lever.tolist()))}
        text = GRAPH
        for name, value in (values | {"PC_PER_N": PC_PER_N * len(self.directions)} | (renamed or {})).items():
            text = re.sub(rf"\b{name}\b", str(value), text)
        model = onnx.parser.parse_model(text)
        for tensor in model.graph.initializer:
            tensor.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(tensor), tensor.name))
        helper.set_model_props(model, props)
        return model.SerializeToString()

    def golden_pC(self):
        """Return the charges of the golden vectors, shape (8, n_electrode), pC."""
        rng = np.random.default_rng(0)
        return self.charge_pC(rng.uniform(-5, 5, 8), rng.uniform(-5, 5, 8), rng.uniform(0.1, 2, 8)).astype(np.float32)

    def write(self, models, **changes):
        """Write the model into a repository, and return the version folder.

        Args:
            models: Folder of the repository.
            changes: Changed values of the metadata.
        """
        metadata = self.metadata(**changes)
        graph = self.onnx(metadata.to_props())
        return write_model(models / metadata.name, graph, metadata, self.golden_pC(), "# The linear film\n")


@pytest.fixture(scope="session")
def film():
    """The linear film with three electrodes."""
    return LinearFilm.with_electrodes(3)


@pytest.fixture(scope="session")
def models(film, tmp_path_factory):
    """A model repository that contains `linear/1`. Tests must not write to it."""
    root = tmp_path_factory.mktemp("models")
    film.write(root)
    return root


@pytest.fixture(scope="session")
def predictor(models):
    """The model of the linear film with three electrodes."""
    return Predictor("linear", models=models)


@pytest.fixture(scope="session")
def authority():
    return trustme.CA()


@pytest.fixture
def trusted(authority):
    """Return the TLS context of a client that trusts the authority of the tests."""
    context = ssl.create_default_context()
    authority.configure_trust(context)
    return context


@pytest.fixture(scope="session")
def two_versions(film, tmp_path_factory):
    """A model repository that contains two versions of the linear model. Tests must not write to it."""
    root = tmp_path_factory.mktemp("two_versions")
    film.write(root)
    film.write(root, version=2)
    return root


@pytest.fixture
def store(two_versions, tmp_path):
    """A store with two versions of the linear model, in a folder that only this test uses."""
    return ModelStore(shutil.copytree(two_versions, tmp_path / "models"))


@pytest.fixture
def handler(store):
    """A handler for the models of `store`."""
    return Handler(store)


@pytest.fixture(scope="session")
def stopping():
    """A list of stopped servers with their threads. At the end of the session, all threads must have ended."""
    stopped = []
    yield stopped
    for server, thread in stopped:
        thread.join(timeout=30)
        server.close()
        assert not thread.is_alive()


@pytest.fixture
def start_http(stopping):
    """Return a function that starts a server in a thread, on a free port of the loopback address.

    The servers are stopped when the test ends.
    """
    started = []

    def start(app, *, tls=None, uds=None, beside=None):
        server = HttpServer(app, Address(uds=uds), tls)
        thread = Thread(target=server.run, args=[beside])
        thread.start()
        started.append((server, thread))
        return server

    yield start
    for server, _ in started:
        server.stop()
    stopping.extend(started)


@pytest.fixture
def board(film):
    """A board whose film is pressed at (3, -2) mm with 1 N for 0.1 s, every 0.25 s."""
    with TcpBoard(taps(film)) as board:
        yield board


@pytest.fixture
def fill_disk(monkeypatch):
    """Return a function after which files accept only a given number of further bytes, as on a full disk."""

    def fill(free_bytes):
        original_write = os.write
        remaining_bytes = free_bytes

        def write_until_full(descriptor, data):
            nonlocal remaining_bytes
            if remaining_bytes == 0:
                raise OSError(errno.ENOSPC, "No space left on device")
            written_bytes = original_write(descriptor, bytes(data)[:remaining_bytes])
            remaining_bytes -= written_bytes
            return written_bytes

        monkeypatch.setattr("os.write", write_until_full)

    return fill


@pytest.fixture
def contract():
    """Names of the fields of a prediction record, in their order."""
    return [field.name for field in record_fields()]


@pytest.fixture
def record(contract):
    """Return a function that makes a prediction record of a press with some changed fields."""

    def make(**changes):
        values = dict.fromkeys(contract) | {
            "contact": True,
            "flags": ("gap",),
            "model": "linear/1",
            "frame_id": "linear-film",
            "x_mm": 1.23456789,
            "charge_pC": {"A": 800.0625, "B": None},
            "timestamp": 1763600000.1234567,
        }
        return PredictionRecord(**(values | changes))

    return make
