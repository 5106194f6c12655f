"""What the server says about itself and its models, as JSON objects; gRPC has messages of the same fields."""

from functools import lru_cache
from importlib.metadata import version
from typing import Any

from isocharge.serve.model.session import INPUT, OUTPUTS
from isocharge.serve.network.limits import ServerLimits
from isocharge.serve.network.model_store import LoadedVersion, ModelStore

EXTENSIONS = (
    "binary_tensor_data",
    "model_configuration",
    "model_repository",
    "model_repository(unload_dependents)",
    "parameters",
    "statistics",
)

PLATFORM = "onnxruntime_onnx"
"""Triton's name for ONNX models."""

NO_LOAD_PARAMETERS = "load: parameters are not supported; put the files into the model's folder and load it again"


def server_metadata() -> dict[str, Any]:
    """Name, version and extensions."""
    return {"name": "isocharge", "version": _version(), "extensions": list(EXTENSIONS)}


@lru_cache(1)
def _version() -> str:
    """The package's version; to read it opens files, which a server with many connections may not have left."""
    return version("isocharge")


def model_metadata(loaded: LoadedVersion, store: ModelStore) -> dict[str, Any]:
    """Tensors of a model, and under `properties` everything that its file says about itself, as JSON texts."""
    metadata = loaded.metadata
    widths = {INPUT: len(metadata.electrodes)}
    return {
        "name": metadata.name,
        "versions": [other.version for other in store.named(metadata.name)],
        "platform": PLATFORM,
        "inputs": [_tensor(name, width) for name, width in widths.items()],
        "outputs": [_tensor(name, width) for name, width in OUTPUTS.items()],
        "properties": metadata.to_props(),
    }


def _tensor(name: str, width: int) -> dict[str, Any]:
    return {"name": name, "datatype": "FP32", "shape": [-1, width]}


def model_config(loaded: LoadedVersion, limits: ServerLimits) -> dict[str, Any]:
    """A model's configuration as Triton would have it; unlike Triton by default, every version serves."""
    return {
        "name": loaded.metadata.name,
        "platform": PLATFORM,
        "backend": "onnxruntime",
        "version_policy": {"all": {}},
        "max_batch_size": limits.batch,
        "input": [{"name": INPUT, "data_type": "TYPE_FP32", "dims": [len(loaded.metadata.electrodes)]}],
        "output": [{"name": name, "data_type": "TYPE_FP32", "dims": [width]} for name, width in OUTPUTS.items()],
    }


def statistics_of(store: ModelStore, name: str = "", version: str = "") -> dict[str, Any]:
    """Counters of a version of a model, of all its versions, or of all models.

    Raises:
        ModelNotFound: If it does not serve.
    """
    models = [store.get(name, version)] if version else store.named(name) if name else store.all()
    return {
        "model_stats": [
            {"name": loaded.metadata.name, "version": loaded.version, **loaded.statistics.to_json()}
            for loaded in models
        ]
    }


def repository_index(store: ModelStore, *, ready: bool) -> list[dict[str, str]]:
    """Every version in the repository; with `ready`, only what serves."""
    return [row for row in store.index() if row["state"] == "READY" or not ready]
