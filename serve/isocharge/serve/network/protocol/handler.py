"""Requests of the Open Inference Protocol to answers: method, path, headers and body in; status, headers and body out.

No transport is known here. Everything but loading and unloading is done in microseconds, or milliseconds for the
largest batch, and may be called from any thread; `blocks` says for which paths a server had better use another thread.
"""

import logging
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache, partial
from typing import Any, NamedTuple

import orjson

from isocharge.errors import IsochargeError, ModelError, RequestError, TooLarge, UnknownPath, WrongMethod
from isocharge.serve.network.limits import ServerLimits
from isocharge.serve.network.model_store import LoadedVersion, ModelStore
from isocharge.serve.network.protocol import describe
from isocharge.serve.network.protocol.answer import write_answer
from isocharge.serve.network.protocol.encoding import compress, decompress
from isocharge.serve.network.protocol.infer import answer_inference
from isocharge.serve.network.protocol.openapi import openapi
from isocharge.serve.network.protocol.page import page
from isocharge.serve.network.protocol.request import read_infer, read_object
from isocharge.serve.network.protocol.status import INTERNAL, http_status

log = logging.getLogger(__name__)

Headers = Iterable[tuple[bytes, bytes]]
"""Names in lower case, values as they came."""

KNOWN_PATHS = 64
"""So many paths that were asked for are remembered with what answers them."""

MODELS, REPOSITORY = "/v2/models/", "/v2/repository/models/"


class Response(NamedTuple):
    """An answer: status, headers, body."""

    status: int
    headers: list[tuple[bytes, bytes]]
    body: bytes


class Request(NamedTuple):
    """A request, its body no longer compressed, and the model that its path names."""

    headers: Mapping[bytes, bytes]
    body: bytes
    name: str = ""
    version: str = ""


Route = tuple[str, Callable[[Request], Response]]
"""The method, and what answers."""


class Handler:
    """Answers requests from the models on a shelf."""

    def __init__(self, shelf: ModelStore, limits: ServerLimits | None = None) -> None:
        """`limits` bound body and batch; the others are for transports."""
        self.shelf = shelf
        self.limits = limits or ServerLimits()
        self._fixed: dict[str, Route] = {
            "/": ("GET", self._page),
            "/openapi.json": ("GET", lambda _: _json(openapi(shelf, self.limits))),
            "/v2": ("GET", lambda _: _json(describe.server_metadata())),
            "/v2/health/live": ("GET", lambda _: _json({"live": True})),
            "/v2/health/ready": ("GET", self._ready),
            "/v2/models/stats": ("GET", lambda _: _json(describe.statistics_of(shelf))),
            "/v2/repository/index": ("POST", self._index),
        }
        self._of_model: dict[str, Route] = {
            "": ("GET", lambda asked: _json(describe.model_metadata(self._served(asked), shelf))),
            "ready": ("GET", lambda asked: _json({"ready": bool(self._served(asked))})),
            "config": ("GET", lambda asked: _json(describe.model_config(self._served(asked), self.limits))),
            "stats": ("GET", lambda asked: _json(describe.statistics_of(shelf, asked.name, asked.version))),
            "infer": ("POST", self._infer),
        }
        self._route = lru_cache(KNOWN_PATHS)(self._find)
        self._of_repository: dict[str, Route] = {"load": ("POST", self._load), "unload": ("POST", self._unload)}

    def blocks(self, path: str) -> bool:
        """Whether answering this path may take longer than others should wait."""
        return path.startswith(REPOSITORY)

    def answer(self, method: str, path: str, headers: Headers, body: bytes) -> Response:
        """Answer one request.

        Args:
            method: In capitals.
            path: Without query, percent signs undone.
            headers: Of the request.
            body: As it came, perhaps compressed.

        Returns:
            The answer; an error is one, with the body {"error": "..."}. Nothing is raised.
        """
        try:
            route, name, version = self._route(path)
            if method != route[0] and (method, route[0]) != ("HEAD", "GET"):
                raise WrongMethod(f"{path}: expected the method {route[0]}, got {method[:20]}", route[0])
            picked = dict(headers)
            if len(body) > self.limits.body_bytes:
                raise TooLarge(f"the body has {len(body)} bytes, at most {self.limits.body_bytes} are read")
            if b"content-encoding" in picked:
                body = decompress(body, picked[b"content-encoding"].lower(), self.limits.body_bytes)
            return route[1](Request(picked, body, name, version))
        except Exception as error:  # the one place where an error becomes an answer
            return error_response(error)

    def _find(self, path: str) -> tuple[Route, str, str]:
        """What answers a path, with the name and version in it."""
        if path in self._fixed:
            return self._fixed[path], "", ""
        try:
            if path.startswith(MODELS) and not path.endswith("/"):
                name, *rest = path[len(MODELS) :].split("/")
                version = rest[1] if rest[:1] == ["versions"] else ""
                return self._of_model["/".join(rest[2:] if version else rest)], name, version
            if path.startswith(REPOSITORY):
                name, tail = path[len(REPOSITORY) :].split("/")
                return self._of_repository[tail], name, ""
        except (KeyError, IndexError, ValueError):
            pass
        raise UnknownPath(f"{path[:200]}: nothing is served here; see /openapi.json")

    def _served(self, asked: Request) -> LoadedVersion:
        return self.shelf.get(asked.name, asked.version)

    def _infer(self, asked: Request) -> Response:
        served, headers = self.shelf.get(asked.name, asked.version), asked.headers
        length = headers.get(b"inference-header-content-length")
        read = partial(read_infer, asked.body, length, served.metadata.electrodes, self.limits.batch)
        body, json_length = answer_inference(served, read, write_answer)
        return _infer_response(body, json_length, headers.get(b"accept-encoding", b""))

    def _ready(self, _: Request) -> Response:
        if not self.shelf.all():
            raise ModelError("not ready: no model is loaded")
        return _json({"ready": True})

    def _index(self, asked: Request) -> Response:
        ready = read_object(asked.body).get("ready", False)
        if not isinstance(ready, bool):
            raise RequestError(f"ready: expected true or false, got {ready!r:.100}")
        return _json(describe.repository_index(self.shelf, ready=ready))

    def _load(self, asked: Request) -> Response:
        if read_object(asked.body).get("parameters", {}) != {}:
            raise RequestError(
                "load: parameters are not supported; put the files into the model's folder and load again"
            )
        self.shelf.load(asked.name)
        return _json({})

    def _unload(self, asked: Request) -> Response:
        read_object(asked.body)
        self.shelf.unload(asked.name)
        return _json({})

    def _page(self, _: Request) -> Response:
        return _response(200, b"text/html; charset=utf-8", page(self.shelf).encode())


def error_response(error: Exception) -> Response:
    """An error as an answer; one that is not ours is logged, and the client learns no more than that it happened."""
    status = http_status(error)
    if not isinstance(error, IsochargeError):
        log.exception("a request failed", exc_info=error)
    words = str(error) if isinstance(error, IsochargeError) else INTERNAL
    response = _json({"error": words}, status)
    if isinstance(error, WrongMethod):
        response.headers.append((b"allow", error.allowed.encode()))
    if status == 401:
        response.headers.append((b"www-authenticate", b"Bearer"))
    return response


def _json(content: Any, status: int = 200) -> Response:
    return _response(status, b"application/json", orjson.dumps(content))


def _response(status: int, kind: bytes, body: bytes) -> Response:
    return Response(status, [(b"content-type", kind), (b"content-length", b"%d" % len(body))], body)


def _infer_response(body: bytes, json_length: int | None, accepted: bytes) -> Response:
    """The answer to an inference, the only one that is compressed: Triton's asyncio client expects no other so."""
    body, encoding = compress(body, accepted) if accepted else (body, b"")
    response = _response(200, b"application/json" if json_length is None else b"application/octet-stream", body)
    if json_length is not None:
        response.headers.append((b"inference-header-content-length", b"%d" % json_length))
    if encoding:
        response.headers.append((b"content-encoding", encoding))
    return response
