"""OpenAPI document that describes the routes of the HTTP server."""

from importlib.resources import files
from typing import Any

import orjson

from isocharge.serve.network.model_store import ModelStore
from isocharge.serve.network.protocol.describe import server_metadata


def openapi_document(store: ModelStore) -> dict[str, Any]:
    """Return the OpenAPI document of the file `openapi.json`, with the names and versions of the loaded models.

    A parameter without a loaded model has the value "none", because OpenAPI requires at least one.
    """
    document: dict[str, Any] = orjson.loads(files(__package__).joinpath("openapi.json").read_bytes())
    document["info"]["version"] = server_metadata()["version"]
    loaded_versions = store.loaded_versions()
    parameters = document["components"]["parameters"]
    parameters["model"]["schema"]["enum"] = sorted({loaded.metadata.name for loaded in loaded_versions}) or ["none"]
    parameters["version"]["schema"]["enum"] = sorted({loaded.version for loaded in loaded_versions}) or ["none"]
    return document
