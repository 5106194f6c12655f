"""The OpenAPI document of a server, with the names of the models that it serves at the moment."""

from typing import Any

import msgspec

from isocharge.serve.model.session import OUTPUTS
from isocharge.serve.network.model_store import ModelStore
from isocharge.serve.network.protocol.describe import server_metadata
from isocharge.serve.network.protocol.request import InferBody

Json = dict[str, Any]

EXAMPLE = {"inputs": [{"name": "charge_pC", "datatype": "FP32", "shape": [1, 3], "data": [942.9, 910.4, 690.8]}]}

BODIES: Json = {
    "index": {"type": "object", "properties": {"ready": {"type": "boolean"}}},
    "load": {"type": "object", "properties": {"parameters": {"type": "object", "maxProperties": 0}}},
    "unload": {"type": "object"},
}
"""Schemas of the bodies that may be missing."""

PATHS = {
    "/v2/health/live": ("Whether the server runs", "any"),
    "/v2/health/ready": ("Whether a model is loaded", "any"),
    "/metrics": ("Counters of all models and requests, in the text format of Prometheus", "text"),
    "/v2": ("Name, version and extensions of the server", "server"),
    "/v2/models/stats": ("Counters of all models", "stats"),
    "/v2/repository/index": ("Every version in the repository", "rows"),
    "/v2/repository/models/{model}/load": ("Read a model's files again and swap it in", "any"),
    "/v2/repository/models/{model}/unload": ("Take a model off", "any"),
}
"""Path to what it is for and the schema of its answer."""

PATHS_OF_MODEL = {
    "": ("Tensors of a model and what its file says about itself", "model"),
    "/ready": ("Whether a model serves", "any"),
    "/config": ("A model's configuration, as Triton words it", "any"),
    "/stats": ("A model's counters", "stats"),
    "/infer": ("Charges to contacts", "answer"),
}
"""The same behind the name of a model, or behind its version."""


def openapi(store: ModelStore) -> Json:
    """The document, OpenAPI 3.1."""
    models = {loaded.metadata.name for loaded in store.all()}
    versions = {loaded.version for loaded in store.all()}
    bases = "/v2/models/{model}", "/v2/models/{model}/versions/{version}"
    paths = PATHS | {base + tail: of for base in bases for tail, of in PATHS_OF_MODEL.items()}
    _, schemas = msgspec.json.schema_components([InferBody], ref_template="#/components/schemas/{name}")
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "isocharge",
            "version": server_metadata()["version"],
            "description": "Charges of a piezoelectric tactile film to contacts: the Open Inference Protocol, V2. "
            "Bodies may be compressed with gzip or deflate, and tensors sent in binary after the JSON, as its "
            "binary tensor extension says.",
        },
        "paths": {path: _path(path, *of) for path, of in paths.items()},
        "components": {
            "parameters": {"model": _path_parameter("model", models), "version": _path_parameter("version", versions)},
            "schemas": schemas | BODIES | ANSWERS,
            "responses": {"error": {"description": "Why not", "content": _content("error")}},
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
        "security": [{}, {"token": []}],
    }


def _path(path: str, summary: str, answer: str) -> Json:
    """What the document says about a path; those with a body are asked for with POST."""
    good = {"description": summary, "content": _content(answer, "text/plain" if answer == "text" else JSON)}
    operation: Json = {"summary": summary, "responses": {"200": good, "4XX": _ref("responses/error")}}
    tail = path.rpartition("/")[2]
    if tail == "infer":
        operation["requestBody"] = {"required": True, "content": _content("InferBody", example=EXAMPLE)}
    elif tail in BODIES:
        operation["requestBody"] = {"content": _content(tail)}
    parameters = [_ref(f"parameters/{name}") for name in ("model", "version") if f"{{{name}}}" in path]
    return {"parameters": parameters, "post" if "requestBody" in operation else "get": operation}


JSON = "application/json"


def _ref(name: str) -> Json:
    return {"$ref": f"#/components/{name}"}


def _content(schema: str, kind: str = JSON, **more: Any) -> Json:
    return {kind: {"schema": _ref(f"schemas/{schema}"), **more}}


def _path_parameter(name: str, values: set[str]) -> Json:
    schema = {"type": "string", "enum": sorted(values) or ["none"]}
    return {"name": name, "in": "path", "required": True, "schema": schema}


def _object(properties: Json, required: list[str] | None = None) -> Json:
    return {"type": "object", "properties": properties, "required": required or list(properties)}


def _list_of(items: Json) -> Json:
    return {"type": "array", "items": items}


_TEXT, _SHAPE = {"type": "string"}, _list_of({"type": "integer"})

_TENSORS = _list_of(_object({"name": _TEXT, "datatype": _TEXT, "shape": _SHAPE}))

_NUMBER = {"type": ["number", "null"], "description": "null: not finite, which JSON has no number for"}

_OUTPUT = _object(
    {
        "name": {"enum": list(OUTPUTS)},
        "datatype": {"const": "FP32"},
        "shape": _SHAPE,
        "data": _list_of(_NUMBER),
    },
    ["name", "datatype", "shape"],
)

ANSWERS: Json = {
    "any": {"type": "object"},
    "text": _TEXT,
    "error": _object({"error": _TEXT}),
    "server": _object({"name": _TEXT, "version": _TEXT, "extensions": _list_of(_TEXT)}),
    "model": _object(
        {
            "name": _TEXT,
            "versions": _list_of(_TEXT),
            "platform": _TEXT,
            "inputs": _TENSORS,
            "outputs": _TENSORS,
            "properties": {"type": "object", "additionalProperties": _TEXT},
        }
    ),
    "stats": _object({"model_stats": _list_of(_object({"name": _TEXT, "version": _TEXT}))}),
    "rows": _list_of(_object({"name": _TEXT, "version": _TEXT, "state": _TEXT, "reason": _TEXT})),
    "answer": _object(
        {"model_name": _TEXT, "model_version": _TEXT, "id": _TEXT, "outputs": _list_of(_OUTPUT)},
        ["model_name", "model_version", "outputs"],
    ),
}
"""Schemas of the answers."""
