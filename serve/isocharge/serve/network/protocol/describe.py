"""Descriptions of the server and its models as JSON objects, and the OpenAPI document of the HTTP server.

The messages of the gRPC service have the same fields as these objects.
"""

from importlib.resources import files
from typing import Any

import orjson

from isocharge.common.extras import package_version
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
    """Return the name and the version of the server, and the extensions of the protocol that it supports."""
    return {"name": "isocharge", "version": package_version(), "extensions": list(EXTENSIONS)}


def model_metadata(loaded: LoadedVersion, store: ModelStore) -> dict[str, Any]:
    """Return the metadata of a model, and the names, number types and shapes of its tensors.

    The metadata are under the key `properties`. Each value of the metadata is a JSON text, as in the model file.
    """
    metadata = loaded.metadata
    return {
        "name": metadata.name,
        "versions": [other.version for other in store.versions_of(metadata.name)],
        "platform": PLATFORM,
        "inputs": [_tensor(INPUT, len(metadata.electrodes))],
        "outputs": [_tensor(name, width) for name, width in OUTPUTS.items()],
        "properties": metadata.to_props(),
    }


def _tensor(name: str, width: int) -> dict[str, Any]:
    """Return the description of a tensor that has any number of rows and `width` columns."""
    return {"name": name, "datatype": "FP32", "shape": [-1, width]}


def model_config(loaded: LoadedVersion, limits: ServerLimits) -> dict[str, Any]:
    """Return the configuration of a model in the form that Triton uses."""
    return {
        "name": loaded.metadata.name,
        "platform": PLATFORM,
        "backend": "onnxruntime",
        "version_policy": {"all": {}},
        "max_batch_size": limits.batch,
        "input": [{"name": INPUT, "data_type": "TYPE_FP32", "dims": [len(loaded.metadata.electrodes)]}],
        "output": [{"name": name, "data_type": "TYPE_FP32", "dims": [OUTPUTS[name]]} for name in OUTPUTS],
    }


def statistics_of(store: ModelStore, name: str = "", version: str = "") -> dict[str, Any]:
    """Return the counters of one version of a model, of all its versions, or of all versions of all models.

    Args:
        store: Store of the models that the server uses.
        name: Name of the model. An empty text selects all models.
        version: Number of the version as a text. An empty text selects all versions.

    Raises:
        ModelNotFound: If the selected model or version is not loaded.
    """
    if name:
        store.get(name, version)  # raises ModelNotFound
    selected = store.versions_of(name, version) if name else store.loaded_versions()
    return {
        "model_stats": [
            {"name": loaded.metadata.name, "version": loaded.version, **loaded.statistics.to_json()}
            for loaded in selected
        ]
    }


def openapi_document() -> dict[str, Any]:
    """Return the OpenAPI document of the file `openapi.json` with the version of this package."""
    document: dict[str, Any] = orjson.loads(files(__package__).joinpath("openapi.json").read_bytes())
    document["info"]["version"] = package_version()
    return document
