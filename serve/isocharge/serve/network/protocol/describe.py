"""Descriptions of the server and its models as JSON objects. The gRPC service has messages with the same fields."""

from typing import Any

from isocharge.common.versions import package_version
from isocharge.serve.model.session import INPUT, OUTPUTS
from isocharge.serve.network.address import ServerLimits
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
    """Return the name, the version and the extensions of the server."""
    return {"name": "isocharge", "version": package_version(), "extensions": list(EXTENSIONS)}


def model_metadata(loaded: LoadedVersion, store: ModelStore) -> dict[str, Any]:
    """Return the tensors of a model. The key `properties` contains the metadata of its file as JSON texts."""
    metadata = loaded.metadata
    return {
        "name": metadata.name,
        "versions": [other.version for other in store.versions_of(metadata.name)],
        "platform": PLATFORM,
        "inputs": [_tensor(INPUT, len(metadata.electrodes))],
        "outputs": [_tensor(name, OUTPUTS[name]) for name in loaded.outputs],
        "properties": metadata.to_props(),
    }


def _tensor(name: str, width: int) -> dict[str, Any]:
    """Return the description of a tensor with any number of rows and `width` columns."""
    return {"name": name, "datatype": "FP32", "shape": [-1, width]}


def model_config(loaded: LoadedVersion, limits: ServerLimits) -> dict[str, Any]:
    """Return the configuration of a model in the form of Triton. All versions of the model are available."""
    return {
        "name": loaded.metadata.name,
        "platform": PLATFORM,
        "backend": "onnxruntime",
        "version_policy": {"all": {}},
        "max_batch_size": limits.batch,
        "input": [{"name": INPUT, "data_type": "TYPE_FP32", "dims": [len(loaded.metadata.electrodes)]}],
        "output": [{"name": name, "data_type": "TYPE_FP32", "dims": [OUTPUTS[name]]} for name in loaded.outputs],
    }


def statistics_of(store: ModelStore, name: str = "", version: str = "") -> dict[str, Any]:
    """Return the counters of one version of a model, of all versions of a model, or of all models.

    Args:
        store: The models.
        name: Name of the model; empty for all models.
        version: Version of the model; empty for all versions.

    Raises:
        ModelNotFound: If the model or the version is not loaded.
    """
    if version:
        models = [store.get(name, version)]
    elif name:
        models = store.versions_of(name)
    else:
        models = store.loaded_versions()
    return {
        "model_stats": [
            {"name": loaded.metadata.name, "version": loaded.version, **loaded.statistics.to_json()}
            for loaded in models
        ]
    }


def repository_index(store: ModelStore, *, ready: bool) -> list[dict[str, str]]:
    """Return one row for each version in the repository, or only for each loaded version if `ready` is true."""
    return [row for row in store.index() if row["state"] == "READY" or not ready]
