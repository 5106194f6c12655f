"""Routes of the HTTP server. Each route is an element of `ROUTES`.

A route contains a method, its paths, a summary, the schemas of the request and of the answer, and the function that
answers requests. The server uses `ROUTES` to find the function for a request. The OpenAPI document is also derived from
`ROUTES`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

from isocharge.common.errors import RequestError
from isocharge.serve.model.session import OUTPUT_MEANINGS, OUTPUTS
from isocharge.serve.network.address import ServerLimits
from isocharge.serve.network.metrics import CONTENT_TYPE, Metrics
from isocharge.serve.network.model_store import LoadedVersion, ModelStore
from isocharge.serve.network.protocol import describe
from isocharge.serve.network.protocol.infer_body import InferBody
from isocharge.serve.network.protocol.inference import (
    FLAGS,
    answer_inference,
    read_infer,
    read_object,
    write_answer,
)
from isocharge.serve.network.protocol.page import CONTENT_SECURITY_POLICY, PAGE_HEADERS, card, page
from isocharge.serve.network.protocol.response import Response, compress, json_response, response_of

Json = dict[str, Any]


class Service(NamedTuple):
    """Objects of the server that the functions of the routes need.

    Attributes:
        store: Store of the models that the server uses.
        limits: Limits of the size of a body and of a batch.
        metrics: Counters of the server in the format of Prometheus.
        openapi: Function that returns the OpenAPI document.
        scheme: Scheme of the address of the server, which is "http" or "https".
    """

    store: ModelStore
    limits: ServerLimits
    metrics: Metrics
    openapi: Callable[[], Json]
    scheme: str = "http"


class Request(NamedTuple):
    """Request that is passed to the function of its route. Its body is already decompressed.

    Attributes:
        service: Objects of the server.
        headers: Value of each header by the name of the header in lower case.
        body: Body of the request.
        model: Name of the model in the path. It is empty if the path contains no name.
        version: Version of the model in the path. It is empty if the path contains no version.
    """

    service: Service
    headers: Mapping[bytes, bytes]
    body: bytes
    model: str = ""
    version: str = ""

    @property
    def loaded(self) -> LoadedVersion:
        """Loaded version of the model in the path. ModelNotFound is raised if the version is not loaded."""
        return self.service.store.get(self.model, self.version)


class Schema(NamedTuple):
    """Named schema of the OpenAPI document.

    The content of the schema is either given as a JSON object, or as a type from which this object is derived.
    """

    name: str
    content: Json | type


class Body(NamedTuple):
    """Description of the body of a request.

    Attributes:
        schema: Schema of the body.
        is_required: Whether a request must have a body.
        example: Example of the body; None if there is no example.
    """

    schema: Schema
    is_required: bool = False
    example: Json | None = None


@dataclass(frozen=True, kw_only=True)
class Route:
    """Route of the HTTP server, which combines a method, several paths and a function that answers requests.

    Attributes:
        method: HTTP method. A route with the method GET also answers HEAD requests, without a body.
        paths: Templates of the paths. Requests are logged and counted under the first template.
        respond: Function that answers a request.
        summary: Purpose of the route. It is empty if the OpenAPI document does not contain the route.
        answer: Schema of the answer.
        answer_type: Media type of the answer.
        body: Description of the body of a request, or None if requests have no body.
        needs_token: Whether requests must contain the token of the server. Health checks need no token, because the
            programs that start and monitor servers do not have it.
        may_block: Whether an answer may take a long time. The server then computes the answer in another thread.
    """

    method: str
    paths: tuple[str, ...]
    respond: Callable[[Request], Response]
    summary: str = ""
    answer: Schema
    answer_type: str = "application/json"
    body: Body | None = None
    needs_token: bool = True
    may_block: bool = False


def object_schema(properties: Json, required: list[str] | None = None) -> Json:
    """Return the schema of a JSON object.

    Args:
        properties: Schema of each property by the name of the property.
        required: Names of the required properties. By default, all properties are required.
    """
    return {"type": "object", "properties": properties, "required": required or list(properties)}


def list_schema(items: Json) -> Json:
    """Return the schema of a list whose elements have a given schema."""
    return {"type": "array", "items": items}


_TEXT = {"type": "string"}
_SHAPE = list_schema({"type": "integer"})
_TENSORS = list_schema(object_schema({"name": _TEXT, "datatype": _TEXT, "shape": _SHAPE}))
_NUMBER = {"type": ["number", "null"], "description": "null: not finite, which JSON has no number for"}

_OUTPUT_NAMES = "; ".join(f"`{name}`: {meaning}" for name, meaning in OUTPUT_MEANINGS.items())

_OUTPUT = object_schema(
    {
        "name": {
            "enum": [*OUTPUTS, FLAGS],
            "description": f"{_OUTPUT_NAMES}; `{FLAGS}`: reasons not to trust the contact, separated by commas",
        },
        "datatype": {"enum": ["FP32", "BYTES"]},
        "shape": _SHAPE | {"description": "number of presses, and numbers for each press"},
        "data": {"anyOf": [list_schema(_NUMBER), list_schema(_TEXT)]},
    },
    ["name", "datatype", "shape"],
)

ANY = Schema("any", {"type": "object"})
PLAIN_TEXT = Schema("text", _TEXT)
SERVER = Schema("server", object_schema({"name": _TEXT, "version": _TEXT, "extensions": list_schema(_TEXT)}))
MODEL = Schema(
    "model",
    object_schema(
        {
            "name": _TEXT,
            "versions": list_schema(_TEXT),
            "platform": _TEXT,
            "inputs": _TENSORS,
            "outputs": _TENSORS,
            "properties": {"type": "object", "additionalProperties": _TEXT},
        }
    ),
)
STATISTICS = Schema(
    "stats", object_schema({"model_stats": list_schema(object_schema({"name": _TEXT, "version": _TEXT}))})
)
REPOSITORY = Schema(
    "rows", list_schema(object_schema({"name": _TEXT, "version": _TEXT, "state": _TEXT, "reason": _TEXT}))
)
INFERENCE = Schema(
    "answer",
    object_schema(
        {"model_name": _TEXT, "model_version": _TEXT, "id": _TEXT, "outputs": list_schema(_OUTPUT)},
        ["model_name", "model_version", "outputs"],
    ),
)

INDEX_BODY = Schema("index", {"type": "object", "properties": {"ready": {"type": ["boolean", "null"]}}})
LOAD_BODY = Schema(
    "load", {"type": "object", "properties": {"parameters": {"type": ["object", "null"], "maxProperties": 0}}}
)
UNLOAD_BODY = Schema("unload", {"type": "object"})
INFER_BODY = Schema("InferBody", InferBody)

EXAMPLE = {"inputs": [{"name": "charge_pC", "datatype": "FP32", "shape": [1, 3], "data": [942.9, 910.4, 690.8]}]}
"""Example of the body of a request for an inference."""


# The functions below answer the requests of the routes. A parameter `_` is a request whose content is not needed.


def _show_page(request: Request) -> Response:
    """Return the start page of the server."""
    service = request.service
    host = request.headers.get(b"host", b"").decode("latin-1")
    has_token = b"authorization" in request.headers  # the token was checked if the server has one
    text = page(service.store, f"{service.scheme}://{host}", has_token=has_token)
    return _page_response(b"text/html; charset=utf-8", text)


def _show_card(request: Request) -> Response:
    """Return the card of a model."""
    return _page_response(b"text/plain; charset=utf-8", card(request.loaded.model))


def _page_response(content_type: bytes, text: str) -> Response:
    """Return the response that contains a page, with the headers that restrict what browsers do with the page."""
    response = response_of(200, content_type, text.encode())
    response.headers.append((b"content-security-policy", CONTENT_SECURITY_POLICY))
    response.headers.extend(PAGE_HEADERS)
    return response


def _show_openapi(request: Request) -> Response:
    return json_response(request.service.openapi())


def _show_metrics(request: Request) -> Response:
    return response_of(200, CONTENT_TYPE, request.service.metrics.text())


def _show_server(_: Request) -> Response:
    return json_response(describe.server_metadata())


def _is_live(_: Request) -> Response:
    return json_response({"live": True})


def _is_ready(request: Request) -> Response:
    request.service.store.check_ready()
    return json_response({"ready": True})


def _show_statistics(request: Request) -> Response:
    return json_response(describe.statistics_of(request.service.store, request.model, request.version))


def _show_index(request: Request) -> Response:
    """Return the index of the repository, which contains all versions of all models.

    If the body contains `ready: true`, the index contains only the loaded versions.
    """
    ready = read_object(request.body).get("ready")
    if not isinstance(ready, bool | None):
        raise RequestError(f"ready: expected true or false, got {ready!r:.100}")
    return json_response(describe.repository_index(request.service.store, ready=ready is True))


def _load(request: Request) -> Response:
    """Read the files of a model again, and return an empty object."""
    if read_object(request.body).get("parameters") not in (None, {}):
        raise RequestError(describe.NO_LOAD_PARAMETERS)
    request.service.store.load(request.model)
    return json_response({})


def _unload(request: Request) -> Response:
    read_object(request.body)
    request.service.store.unload(request.model)
    return json_response({})


def _show_model(request: Request) -> Response:
    return json_response(describe.model_metadata(request.loaded, request.service.store))


def _is_model_ready(request: Request) -> Response:
    return json_response({"ready": bool(request.loaded)})


def _show_config(request: Request) -> Response:
    return json_response(describe.model_config(request.loaded, request.service.limits))


def _infer(request: Request) -> Response:
    """Compute the contacts of the presses in a request.

    The body of the response is a JSON text, which may be followed by binary tensors. The server compresses only the
    responses to inferences, because the asyncio client of Triton does not decompress other responses.
    """
    loaded = request.loaded
    if not request.body and b"upgrade" in request.headers:  # uvicorn discards the body of a request for an upgrade
        raise RequestError("Upgrade: this server reads no body after this header; set the client to HTTP/1.1")
    header_length = request.headers.get(b"inference-header-content-length")
    # `answer_inference` calls `read` and `write_answer`, because it measures the duration of these steps.
    read = partial(read_infer, request.body, header_length, loaded, request.service.limits.batch)
    plain_body, json_length = answer_inference(loaded, read, write_answer)

    accepted_encodings = request.headers.get(b"accept-encoding", b"")
    body, encoding = compress(plain_body, accepted_encodings)

    # If binary tensors follow the JSON text, a header contains the length of the text.
    content_type = b"application/json" if json_length is None else b"application/octet-stream"
    response = response_of(200, content_type, body)
    if json_length is not None:
        response.headers.append((b"inference-header-content-length", b"%d" % json_length))
    if encoding:
        response.headers.append((b"content-encoding", encoding))
    return response


def model_paths(ending: str = "") -> tuple[str, str]:
    """Return the templates of the two paths for requests to a model.

    The first path contains only the name of the model. The second path contains the name and the version of the model.

    Args:
        ending: End of both paths, such as `/infer`.
    """
    return f"/v2/models/{{model}}{ending}", f"/v2/models/{{model}}/versions/{{version}}{ending}"


ROUTES: tuple[Route, ...] = (
    Route(method="GET", paths=("/",), respond=_show_page, answer=PLAIN_TEXT, answer_type="text/html"),
    Route(method="GET", paths=("/openapi.json",), respond=_show_openapi, answer=ANY),
    Route(
        method="GET",
        paths=("/v2/health/live",),
        respond=_is_live,
        summary="Whether the server runs",
        answer=ANY,
        needs_token=False,
    ),
    Route(
        method="GET",
        paths=("/v2/health/ready",),
        respond=_is_ready,
        summary="Whether a model is loaded",
        answer=ANY,
        needs_token=False,
    ),
    Route(
        method="GET",
        paths=("/metrics",),
        respond=_show_metrics,
        summary="Counters of all models and requests, in the text format of Prometheus",
        answer=PLAIN_TEXT,
        answer_type="text/plain",
    ),
    Route(
        method="GET",
        paths=("/v2",),
        respond=_show_server,
        summary="Name, version and extensions of the server",
        answer=SERVER,
    ),
    Route(
        method="GET",
        paths=("/v2/models/stats",),
        respond=_show_statistics,
        summary="Counters of all models",
        answer=STATISTICS,
    ),
    Route(
        method="POST",
        paths=("/v2/repository/index",),
        respond=_show_index,
        summary="Every version in the repository",
        answer=REPOSITORY,
        body=Body(INDEX_BODY),
    ),
    Route(
        method="POST",
        paths=("/v2/repository/models/{model}/load",),
        respond=_load,
        summary="Read the files of a model again and replace its loaded versions",
        answer=ANY,
        body=Body(LOAD_BODY),
        may_block=True,
    ),
    Route(
        method="POST",
        paths=("/v2/repository/models/{model}/unload",),
        respond=_unload,
        summary="Remove a model from the server",
        answer=ANY,
        body=Body(UNLOAD_BODY),
        may_block=True,
    ),
    Route(
        method="GET",
        paths=model_paths(),
        respond=_show_model,
        summary="Tensors and metadata of a model",
        answer=MODEL,
    ),
    Route(
        method="GET",
        paths=model_paths("/ready"),
        respond=_is_model_ready,
        summary="Whether a model is loaded",
        answer=ANY,
    ),
    Route(
        method="GET",
        paths=model_paths("/card"),
        respond=_show_card,
        summary="Card of a model, in Markdown",
        answer=PLAIN_TEXT,
        answer_type="text/plain",
    ),
    Route(
        method="GET",
        paths=model_paths("/config"),
        respond=_show_config,
        summary="Configuration of a model in the form of Triton",
        answer=ANY,
    ),
    Route(
        method="GET",
        paths=model_paths("/stats"),
        respond=_show_statistics,
        summary="Counters of a model",
        answer=STATISTICS,
    ),
    Route(
        method="POST",
        paths=model_paths("/infer"),
        respond=_infer,
        summary="Compute contacts from charges",
        answer=INFERENCE,
        body=Body(INFER_BODY, is_required=True, example=EXAMPLE),
    ),
)
"""All routes of the HTTP server. If several templates match a path, the first of them is used."""
