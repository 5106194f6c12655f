"""The OpenAPI document of a server, with the names and sizes of the models that it serves at the moment."""

from typing import Any

from isocharge.serve.model.session import INPUT, OUTPUTS
from isocharge.serve.network.limits import ServerLimits
from isocharge.serve.network.model_store import ModelStore
from isocharge.serve.network.protocol.describe import server_metadata
from isocharge.serve.network.protocol.tensors import DATATYPES

Json = dict[str, Any]


def openapi(store: ModelStore, limits: ServerLimits) -> Json:
    """The document, OpenAPI 3.1."""
    models = sorted({loaded.metadata.name for loaded in store.all()})
    versions = sorted({str(loaded.metadata.version) for loaded in store.all()})
    widths = sorted({len(loaded.metadata.electrodes) for loaded in store.all()})
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "isocharge",
            "version": server_metadata()["version"],
            "description": "Charges of a piezoelectric tactile film to contacts: the Open Inference Protocol, V2. "
            "Bodies may be compressed with gzip or deflate, and tensors sent in binary after the JSON, as its "
            "binary tensor extension says.",
        },
        "paths": _paths(),
        "components": {
            "parameters": {
                "model": _path_parameter("model", models),
                "version": _path_parameter("version", versions),
            },
            "schemas": {"error": _object({"error": {"type": "string"}}), "infer": _infer(widths, limits), **_ANSWERS},
            "responses": {"error": {"description": "Why not", "content": _content(_ref("schemas/error"))}},
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
        "security": [{}, {"token": []}],
    }


def _paths() -> Json:
    model, versioned = "/v2/models/{model}", "/v2/models/{model}/versions/{version}"
    paths: Json = {
        "/v2/health/live": _get("Whether the server runs", "any"),
        "/v2/health/ready": _get("Whether a model is loaded", "any"),
        "/metrics": _get("Counters of all models and requests, in the text format of Prometheus", "text", "text/plain"),
        "/v2": _get("Name, version and extensions of the server", "server"),
        "/v2/models/stats": _get("Counters of all models", "stats"),
        "/v2/repository/index": _post("Every version in the repository", "index", _INDEX_BODY),
        "/v2/repository/models/{model}/load": _post("Read a model's files again and swap it in", "any", _LOAD_BODY),
        "/v2/repository/models/{model}/unload": _post("Take a model off", "any", _UNLOAD_BODY),
    }
    for base in (model, versioned):
        paths[base] = _get("Tensors of a model and what its file says about itself", "model")
        paths[f"{base}/ready"] = _get("Whether a model serves", "any")
        paths[f"{base}/config"] = _get("A model's configuration, as Triton words it", "any")
        paths[f"{base}/stats"] = _get("A model's counters", "stats")
        paths[f"{base}/infer"] = _post("Charges to contacts", "answer", _ref("schemas/infer"))
    return {path: _with_parameters(path, item) for path, item in paths.items()}


def _with_parameters(path: str, item: Json) -> Json:
    named = [name for name in ("model", "version") if f"{{{name}}}" in path]
    return item | ({"parameters": [_ref(f"parameters/{name}") for name in named]} if named else {})


def _get(summary: str, answer: str, kind: str = "application/json") -> Json:
    return {"get": _operation(summary, answer, kind)}


def _post(summary: str, answer: str, body: Json) -> Json:
    request = {"required": "$ref" in body, "content": _content(body)}
    return {"post": {**_operation(summary, answer), "requestBody": request}}


def _operation(summary: str, answer: str, kind: str = "application/json") -> Json:
    good = {"description": summary, "content": _content(_ref(f"schemas/{answer}"), kind)}
    return {"summary": summary, "responses": {"200": good, "4XX": _ref("responses/error")}}


def _ref(name: str) -> Json:
    return {"$ref": f"#/components/{name}"}


def _content(schema: Json, kind: str = "application/json") -> Json:
    return {kind: {"schema": schema}}


def _object(properties: Json, required: list[str] | None = None, **more: Any) -> Json:
    return {"type": "object", "properties": properties, "required": required or list(properties), **more}


def _list_of(items: Json, **more: Any) -> Json:
    return {"type": "array", "items": items, **more}


def _path_parameter(name: str, values: list[str]) -> Json:
    return {"name": name, "in": "path", "required": True, "schema": {"type": "string", "enum": values or ["none"]}}


def _infer(widths: list[int], limits: ServerLimits) -> Json:
    """A request with its numbers as JSON; the number of numbers follows from the shape, which no schema can say."""
    shape = [{"type": "integer", "minimum": 1, "maximum": limits.batch}, {"enum": widths or [3]}]
    number = {"type": "number", "minimum": -1e30, "maximum": 1e30}
    tensor = {
        "name": {"const": INPUT},
        "datatype": {"enum": list(DATATYPES)},
        "shape": {"type": "array", "prefixItems": shape, "items": False, "minItems": 2, "maxItems": 2},
        "parameters": _PARAMETERS,
        "data": {"oneOf": [_list_of(number, minItems=1), _list_of(_list_of(number, minItems=1), minItems=1)]},
    }
    output = _object({"name": {"enum": list(OUTPUTS)}, "parameters": _PARAMETERS}, ["name"])
    return _object(
        {
            "id": {"type": "string"},
            "parameters": _PARAMETERS,
            "inputs": _list_of(_object(tensor, ["name", "datatype", "shape", "data"]), minItems=1, maxItems=1),
            "outputs": _list_of(output),
        },
        ["inputs"],
        example={"inputs": [{"name": INPUT, "datatype": "FP32", "shape": [1, 3], "data": [942.9, 910.4, 690.8]}]},
    )


_TEXT, _WHOLE = {"type": "string"}, {"type": "integer"}

_PARAMETERS: Json = {"type": "object"}

_INDEX_BODY: Json = {"type": "object", "properties": {"ready": {"type": "boolean"}}}

_LOAD_BODY: Json = {"type": "object", "properties": {"parameters": {"type": "object", "maxProperties": 0}}}

_UNLOAD_BODY: Json = {"type": "object"}

_TENSORS = _list_of(_object({"name": _TEXT, "datatype": _TEXT, "shape": _list_of(_WHOLE)}))

_OUTPUT = _object(
    {
        "name": {"enum": list(OUTPUTS)},
        "datatype": {"const": "FP32"},
        "shape": _list_of(_WHOLE),
        "data": _list_of({"type": ["number", "null"], "description": "null: not finite, which JSON has no number for"}),
    },
    ["name", "datatype", "shape"],
)

_ANSWERS: Json = {
    "any": {"type": "object"},
    "text": _TEXT,
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
    "index": _list_of(_object({"name": _TEXT, "version": _TEXT, "state": _TEXT, "reason": _TEXT})),
    "answer": _object(
        {"model_name": _TEXT, "model_version": _TEXT, "id": _TEXT, "outputs": _list_of(_OUTPUT)},
        ["model_name", "model_version", "outputs"],
    ),
}
