"""A sensor whose physics has a closed-form inverse, and a real model file of it.

On the linear film, an electrode in the direction u has the charge Q = 800 pC/N * F * (1 + u.p / 20 mm). The sum of the
charges then gives the force and their weighted mean the position, exactly, and an ONNX graph of seven nodes is its
perfect model: what the serving path answers can be compared with what was pressed.
"""

import errno
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from threading import Thread

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from boards import TcpBoard, taps
from isocharge.serve import ModelMetadata, PredictionRecord, Predictor, write_model
from isocharge.serve.model.metadata import ModelNoise
from isocharge.serve.network.address import Address
from isocharge.serve.network.http import HttpServer
from isocharge.serve.network.model_store import open_model_store
from isocharge.serve.network.protocol import Handler

NAMES = ("A", "B", "C", "D")
PC_PER_N, LEVER_MM, RADIUS_MM = 800.0, 20.0, 8.0


@dataclass(frozen=True)
class LinearFilm:
    """The sensor, its forward map and its model."""

    directions: np.ndarray

    @classmethod
    def with_electrodes(cls, n: int) -> "LinearFilm":
        angle = 2 * np.pi * np.arange(n) / n - np.pi / 2
        return cls(np.column_stack([np.cos(angle), np.sin(angle)]))

    @property
    def electrodes(self) -> tuple[str, ...]:
        return NAMES[: len(self.directions)]

    def charge_pC(self, x_mm: np.ndarray, y_mm: np.ndarray, force_N: np.ndarray) -> np.ndarray:
        lever = np.column_stack([x_mm, y_mm]) @ self.directions.T / LEVER_MM
        return PC_PER_N * np.asarray(force_N)[:, None] * (1.0 + lever)

    def charges(self, contact: np.ndarray) -> np.ndarray:
        return self.charge_pC(*contact.T)

    def metadata(self, **changes: object) -> ModelMetadata:
        angle = 2 * np.pi * np.arange(64) / 64
        values = {
            "name": "linear",
            "version": 1,
            "sensor": {"name": "linear-film", "film": {"radius_mm": 45.0}},
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

    def onnx(self, props: dict[str, str], *, renamed: dict[str, str] | None = None, batch: int | str = "n") -> bytes:
        """The model; `renamed` and `batch` spoil its interface."""
        n = len(self.directions)
        constants = {
            "lever": 2.0 * LEVER_MM * self.directions,
            "pC_per_N": [[PC_PER_N * n]],
            "std_scale": [[50.0, 50.0, 0.0]],
            "std_floor": [[0.0, 0.0, 7e-4]],
        }
        node, names = helper.make_node, {name: name for name in ("charge_pC", "contact", "contact_std", "misfit")}
        names |= renamed or {}
        nodes = [
            node("ReduceSum", [names["charge_pC"], "axes"], ["sum"], keepdims=1),
            node("MatMul", [names["charge_pC"], "lever"], ["moment"]),
            node("Div", ["moment", "sum"], ["position"]),
            node("Div", ["sum", "pC_per_N"], ["force"]),
            node("Concat", ["position", "force"], [names["contact"]], axis=1),
            node("Div", ["std_scale", "sum"], ["std_position"]),
            node("Add", ["std_position", "std_floor"], [names["contact_std"]]),
            node("Neg", [names["charge_pC"]], ["negated"]),
            node("Relu", ["negated"], ["negative"]),
            node("ReduceSum", ["negative", "axes"], [names["misfit"]], keepdims=1),
        ]
        value = helper.make_tensor_value_info
        graph = helper.make_graph(
            nodes,
            "linear film",
            [value(names["charge_pC"], TensorProto.FLOAT, [batch, n])],
            [
                value(names[k], TensorProto.FLOAT, [batch, w])
                for k, w in (("contact", 3), ("contact_std", 3), ("misfit", 1))
            ],
            [
                numpy_helper.from_array(np.array([1], dtype=np.int64), "axes"),
                *(numpy_helper.from_array(np.array(c, dtype=np.float32), name) for name, c in constants.items()),
            ],
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
        helper.set_model_props(model, props)
        return model.SerializeToString()

    def golden_pC(self) -> np.ndarray:
        rng = np.random.default_rng(0)
        return self.charge_pC(rng.uniform(-5, 5, 8), rng.uniform(-5, 5, 8), rng.uniform(0.1, 2, 8)).astype(np.float32)

    def write(self, models: Path, **changes: object) -> Path:
        """Write the model into a repository; the version folder."""
        metadata = self.metadata(**changes)
        return write_model(
            models / metadata.name, self.onnx(metadata.to_props()), metadata, self.golden_pC(), "# The linear film\n"
        )


@pytest.fixture(scope="session")
def film() -> LinearFilm:
    """The linear film with three electrodes."""
    return LinearFilm.with_electrodes(3)


@pytest.fixture(scope="session")
def make_film() -> Callable[[int], LinearFilm]:
    """Linear films with another number of electrodes."""
    return LinearFilm.with_electrodes


@pytest.fixture(scope="session")
def models(film: LinearFilm, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model repository that holds `linear/1`; not to be written to."""
    root = tmp_path_factory.mktemp("models")
    film.write(root)
    return root


@pytest.fixture(scope="session")
def predictor(models: Path) -> Predictor:
    """The model of the linear film with three electrodes."""
    return Predictor("linear", models=models)


@pytest.fixture
def store(film, tmp_path):
    """The linear model in two versions, in a folder of the test's own."""
    film.write(tmp_path / "models")
    film.write(tmp_path / "models", version=2)
    return open_model_store(tmp_path / "models")


@pytest.fixture
def handler(store):
    """A handler for these models."""
    return Handler(store)


@pytest.fixture(scope="session")
def stopping():
    """Servers that were stopped, with their threads; at the end of the session all threads must have ended."""
    stopped = []
    yield stopped
    for server, thread in stopped:
        thread.join(timeout=30)
        server.close()
        assert not thread.is_alive()


@pytest.fixture
def start_http(stopping):
    """Start servers on loopback, in threads, each on a free port; they are stopped when the test ends."""
    started = []

    def start(handler, *, tls=None, uds=None):
        server = HttpServer(handler, Address(uds=uds), tls=tls)
        thread = Thread(target=server.run)
        thread.start()
        started.append((server, thread))
        return server

    yield start
    for server, _ in started:
        server.stop()
    stopping.extend(started)


@pytest.fixture
def board(film):
    """A board that is pressed at (3, -2) mm with 1 N for 0.1 s, each 0.25 s."""
    with TcpBoard(taps(film)) as board:
        yield board


@pytest.fixture
def fill_disk(monkeypatch):
    """Let files take so many bytes until the disk is full."""

    def fill(room):
        write, remaining = os.write, [room]

        def write_until_full(descriptor, data):
            if not remaining[0]:
                raise OSError(errno.ENOSPC, "No space left on device")
            taken = write(descriptor, bytes(data)[: remaining[0]])
            remaining[0] -= taken
            return taken

        monkeypatch.setattr("os.write", write_until_full)

    return fill


@pytest.fixture
def contract():
    """The fields of a prediction record, in their order."""
    return [
        *(
            "timestamp",
            "t_device_us",
            "seq",
            "x_mm",
            "y_mm",
            "force_N",
            "x_std_mm",
            "y_std_mm",
            "force_std_N",
            "misfit",
            "xy_correlation",
            "xF_correlation",
            "yF_correlation",
        ),
        *("contact", "charge_pC", "charge_raw_pC", "tare_pC", "flags", "latency_us", "model", "frame_id"),
    ]


@pytest.fixture
def record(contract):
    """Make a prediction record; fields that are not given are as in an ordinary press, or None."""

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
