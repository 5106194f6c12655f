"""Routes of the servers. Each route is an element of `ROUTES`.

The servers use `ROUTES` to find the function for a request. The file `openapi.json` describes the same routes. The
messages of the gRPC service have the same fields as the JSON objects that the functions return.
"""

from collections.abc import Callable
from importlib.resources import files
from typing import Any, NamedTuple

from prometheus_client import generate_latest

from isocharge.common.defaults import MAX_BATCH
from isocharge.common.errors import ModelError, RequestError, package_version
from isocharge.common.structs import parse_json
from isocharge.serve.model.session import INPUT, OUTPUTS
from isocharge.serve.network.browser_check import Headers
from isocharge.serve.network.metrics import Traffic
from isocharge.serve.network.model_store import LoadedVersion, ModelStore
from isocharge.serve.network.protocol.inference import (
    Json,
    RepositoryBody,
    infer,
    read_infer,
)
from isocharge.serve.network.protocol.response import Response, json_response, response_of

PLATFORM = "onnxruntime_onnx"
"""Triton's name for ONNX models."""


class Request(NamedTuple):
    """Request that is passed to the function of its route. Its body is already decompressed.

    Attributes:
        store: Store of the models that the server uses.
        traffic: Counters of the requests to the server.
        headers: Value of each header by the name of the header in lower case.
        body: Body of the request.
        name: Name of the model in the path. It is empty if the path contains no name.
        version: Version of the model in the path. It is empty if the path contains no version.
    """

    store: ModelStore
    traffic: Traffic
    headers: Headers
    body: bytes
    name: str = ""
    version: str = ""

    @property
    def loaded(self) -> LoadedVersion:
        """Loaded version of the model in the path. ModelNotFound is raised if the version is not loaded."""
        return self.store.get(self.name, self.version)


class Route(NamedTuple):
    """Route of the servers, which combines a method, a path and a function that answers requests.

    Attributes:
        method: HTTP method. A route with the method GET also answers HEAD requests, without a body.
        path: Template of the path. `{model}` stands for the name of a model, and `{version}` for the part
            `/versions/NUMBER`, which may be missing.
        respond: Function that receives a request, and returns a response or the content of a JSON response.
        rpcs: Names of the gRPC methods that give the same answer.
        needs_token: Whether requests must contain the token of the server. Health checks need no token, because the
            programs that start and monitor servers do not have it.
    """

    method: str
    path: str
    respond: Callable[[Request], Any]
    rpcs: tuple[str, ...] = ()
    needs_token: bool = True


def _show_openapi(_: Request) -> Response:
    """Return the OpenAPI document."""
    return response_of(200, b"application/json", files(__package__).joinpath("openapi.json").read_bytes())


def _show_server(_: Request) -> Json:
    """Return the name and the version of the server, and the extensions of the protocol that it supports."""
    return {
        "name": "isocharge",
        "version": package_version(),
        "extensions": [
            "binary_tensor_data",
            "model_configuration",
            "model_repository",
            "model_repository(unload_dependents)",
            "parameters",
            "statistics",
        ],
    }


def _show_metrics(request: Request) -> Response:
    """Return the metrics of the server and of its models in the text format of Prometheus."""
    content_type = b"text/plain; version=0.0.4; charset=utf-8"  # every version of Prometheus can read this format
    return response_of(200, content_type, generate_latest(request.traffic.registry))


def _is_ready(request: Request) -> dict[str, bool]:
    """Check that a model is loaded. The error names no files, because it is also sent to clients without a token."""
    if not request.store.versions_of():
        raise ModelError("not ready: no model is loaded; the repository's index has the reasons")
    return {"ready": True}


def _show_index(request: Request) -> list[dict[str, str]]:
    """Return the index of the repository, which contains all versions of all models.

    If the body contains `ready: true`, the index contains only the loaded versions.
    """
    body = parse_json(request.body or b"{}", "", RequestError, RepositoryBody)
    return [row for row in request.store.index() if row["state"] == "READY" or not body.ready]


def _load(request: Request) -> Json:
    """Read the files of a model again, and return an empty object."""
    if parse_json(request.body or b"{}", "", RequestError, RepositoryBody).parameters:
        raise RequestError(
            "load: parameters are not supported; put the files into the model's folder and load it again"
        )
    request.store.load(request.name)
    return {}


def _unload(request: Request) -> Json:
    """Remove all versions of a model, and return an empty object."""
    request.store.unload(request.name)
    return {}


def _show_statistics(request: Request) -> Json:
    """Return the counters of one version of a model, of all its versions, or of all versions of all models."""
    if request.name:
        _ = request.loaded  # raises ModelNotFound
    selected = request.store.versions_of(request.name or None, request.version)
    return {
        "model_stats": [
            {"name": loaded.metadata.name, "version": loaded.version, **loaded.statistics.to_json()}
            for loaded in selected
        ]
    }


def _show_model(request: Request) -> Json:
    """Return the metadata of a model, and the names, number types and shapes of its tensors.

    The metadata are under the key `properties`. Each value of the metadata is a JSON text, as in the model file.
    """
    metadata = request.loaded.metadata
    return {
        "name": metadata.name,
        "versions": [other.version for other in request.store.versions_of(metadata.name)],
        "platform": PLATFORM,
        "inputs": [_tensor(INPUT, len(metadata.electrodes))],
        "outputs": [_tensor(name, width) for name, width in OUTPUTS.items()],
        "properties": metadata.to_props(),
    }


def _tensor(name: str, width: int) -> Json:
    """Return the description of a tensor that has any number of rows and `width` columns."""
    return {"name": name, "datatype": "FP32", "shape": [-1, width]}


def _show_config(request: Request) -> Json:
    """Return the configuration of a model in the form that Triton uses."""
    metadata = request.loaded.metadata
    return {
        "name": metadata.name,
        "platform": PLATFORM,
        "backend": "onnxruntime",
        "version_policy": {"all": {}},
        "max_batch_size": MAX_BATCH,
        "input": [{"name": INPUT, "data_type": "TYPE_FP32", "dims": [len(metadata.electrodes)]}],
        "output": [{"name": name, "data_type": "TYPE_FP32", "dims": [OUTPUTS[name]]} for name in OUTPUTS],
    }


def _infer(request: Request) -> Response:
    """Compute the contacts of the presses in a request.

    The body of the response is a JSON text, which may be followed by binary tensors.
    """
    loaded_model = request.loaded
    if not request.body and b"upgrade" in request.headers:  # uvicorn discards the body of a request for an upgrade
        raise RequestError("Upgrade: this server reads no body after this header; set the client to HTTP/1.1")
    # Length of the JSON text in bytes. Without this header, the whole body is the JSON text.
    json_length = request.headers.get(b"inference-header-content-length", b"%d" % len(request.body))
    # An exception counts as a refused request.
    with loaded_model.statistics.refused.count_exceptions(), loaded_model.statistics.latency.time():
        body, binary = read_infer(request.body, json_length)
        content, binary_tensors = infer(loaded_model, body, binary)
        response = json_response(content)
    if not binary_tensors:
        return response
    length_header = (b"inference-header-content-length", b"%d" % len(response.body))
    return response_of(200, b"application/octet-stream", b"".join([response.body, *binary_tensors]), length_header)


ROUTES = (
    Route("GET", "/openapi.json", _show_openapi),
    Route("GET", "/v2/health/live", lambda _: {"live": True}, ("ServerLive",), needs_token=False),
    Route("GET", "/v2/health/ready", _is_ready, ("ServerReady",), needs_token=False),
    Route("GET", "/metrics", _show_metrics),
    Route("GET", "/v2", _show_server, ("ServerMetadata",)),
    Route("GET", "/v2/models/stats", _show_statistics, ("ModelStatistics",)),
    Route("GET", "/v2/models/{model}{version}/stats", _show_statistics),
    Route("POST", "/v2/repository/index", _show_index, ("RepositoryIndex",)),
    Route("POST", "/v2/repository/models/{model}/load", _load, ("RepositoryModelLoad",)),
    Route("POST", "/v2/repository/models/{model}/unload", _unload, ("RepositoryModelUnload",)),
    Route("GET", "/v2/models/{model}{version}", _show_model, ("ModelMetadata",)),
    Route("GET", "/v2/models/{model}{version}/ready", lambda request: {"ready": bool(request.loaded)}, ("ModelReady",)),
    Route("GET", "/v2/models/{model}{version}/config", _show_config, ("ModelConfig",)),
    Route("POST", "/v2/models/{model}{version}/infer", _infer, ("ModelInfer", "ModelStreamInfer")),
)
"""All routes of the HTTP server. If several templates match a path, the first of these templates is used."""

UNKNOWN = Route("", "unknown", _show_server)
"""Route under which requests with unknown paths are counted. Such requests are refused."""
