"""Answers requests of the Open Inference Protocol: method, path, headers and body in; status, headers and body out.

This module knows no transport. Everything but loading and unloading takes microseconds, or milliseconds for the
largest batch, and may be called from any thread; `blocks` says for which paths a server had better use another thread.
"""

import time
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache, partial
from typing import NamedTuple

from isocharge.common.errors import ModelError, RequestError, UnknownPath, WrongMethod
from isocharge.serve.network.credentials import Token
from isocharge.serve.network.limits import ServerLimits
from isocharge.serve.network.metrics import CONTENT_TYPE, Metrics
from isocharge.serve.network.model_store import LoadedVersion, ModelStore
from isocharge.serve.network.protocol import describe
from isocharge.serve.network.protocol.encoding import compress, decompress
from isocharge.serve.network.protocol.infer import answer_inference
from isocharge.serve.network.protocol.openapi import openapi
from isocharge.serve.network.protocol.page import PAGE_HEADERS, page
from isocharge.serve.network.protocol.request import read_infer, read_object, write_answer
from isocharge.serve.network.protocol.response import Response, error_response, json_response, response_of
from isocharge.serve.network.traffic import Client, Exchange, Traffic

Headers = Iterable[tuple[bytes, bytes]]
"""Names in lower case, values as they came."""

KNOWN_PATHS = 64
"""Paths whose route is remembered: those asked for last."""

MODELS, REPOSITORY = "/v2/models/", "/v2/repository/models/"


OPEN = ("/v2/health/live", "/v2/health/ready")
"""Paths that need no token: programs that start and watch servers have none."""


class Request(NamedTuple):
    """A request with its body unpacked, the model that its path names, and whether all may be said to the client."""

    headers: Mapping[bytes, bytes]
    body: bytes
    name: str
    version: str
    trusted: bool


Route = tuple[str, Callable[[Request], Response]]
"""The method that a path takes, and the function that answers."""


class Handler:
    """Answers requests from the models of a store, counts them, and writes them into the log."""

    def __init__(
        self,
        store: ModelStore,
        limits: ServerLimits | None = None,
        traffic: Traffic | None = None,
        token: Token | None = None,
    ) -> None:
        """`limits` bound body and batch, the others are for transports; without a token, everybody is answered."""
        self.store, self.token = store, token
        self.limits = limits or ServerLimits()
        self.traffic = traffic or Traffic()
        metrics = Metrics(store, self.traffic, describe.server_metadata()["version"])
        self._fixed: dict[str, Route] = {
            "/": ("GET", self._page),
            "/metrics": ("GET", lambda _: response_of(200, CONTENT_TYPE, metrics.text())),
            "/openapi.json": ("GET", lambda _: json_response(openapi(store))),
            "/v2": ("GET", lambda _: json_response(describe.server_metadata())),
            "/v2/health/live": ("GET", lambda _: json_response({"live": True})),
            "/v2/health/ready": ("GET", self._ready),
            "/v2/models/stats": ("GET", lambda _: json_response(describe.statistics_of(store))),
            "/v2/repository/index": ("POST", self._index),
        }
        self._of_model: dict[str, Route] = {
            "": ("GET", lambda request: json_response(describe.model_metadata(self._loaded(request), store))),
            "ready": ("GET", lambda request: json_response({"ready": bool(self._loaded(request))})),
            "config": ("GET", lambda request: json_response(describe.model_config(self._loaded(request), self.limits))),
            "stats": ("GET", self._stats),
            "infer": ("POST", self._infer),
        }
        self._of_repository: dict[str, Route] = {"load": ("POST", self._load), "unload": ("POST", self._unload)}
        self._route = lru_cache(KNOWN_PATHS)(self._route_of)
        self._label = lru_cache(KNOWN_PATHS)(self._label_of)

    def blocks(self, path: str) -> bool:
        """Whether answering this path may take longer than others should wait."""
        return path.startswith(REPOSITORY)

    def answer(self, method: str, path: str, headers: Headers, body: bytes, client: Client = None) -> Response:
        """Answer one request.

        Args:
            method: In capitals.
            path: Without query, percent signs undone.
            headers: Headers of the request.
            body: Body of the request, perhaps compressed.
            client: Who asks, for the log.

        Returns:
            The answer; an error is one, with the body {"error": "..."}. Nothing is raised.
        """
        began = time.perf_counter_ns()
        try:
            response = self._answer(method, path, dict(headers), body)
        except Exception as error:  # the one place where an error becomes an answer
            response = error_response(error)
        label, status, size = self._label(path), response.status, len(response.body)
        self.traffic.count("http", label, status)
        if self.traffic.log is not None:
            model, ns = self._model_label(path), time.perf_counter_ns() - began
            self.traffic.log.exchange(
                Exchange("http", label, status, model, response.error, ns, len(body), size, client)
            )
        return response

    def refused(self, response: Response, client: Client = None) -> None:
        """Count and log a refusal that did not come from here, as the request could not be read to its end."""
        size = len(response.body)
        self.traffic.note(Exchange("http", "none", response.status, None, response.error, 0, 0, size, client))

    def _answer(self, method: str, path: str, fields: dict[bytes, bytes], body: bytes) -> Response:
        trusted, authorization = True, fields.get(b"authorization", b"")
        if self.token is not None and path in OPEN:
            trusted = self.token.fits(authorization)
        elif self.token is not None:
            self.token.check(authorization)
        route, name, version = self._route(path)
        if method != route[0] and (method, route[0]) != ("HEAD", "GET"):
            raise WrongMethod(f"{path}: expected the method {route[0]}, got {method[:20]}", route[0])
        self.limits.check_body(len(body))
        if b"content-encoding" in fields:
            body = decompress(body, fields[b"content-encoding"].lower(), self.limits.body_bytes)
        return route[1](Request(fields, body, name, version, trusted))

    def _route_of(self, path: str) -> tuple[Route, str, str]:
        """The route of a path, with the name and version of the model in it."""
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
        raise UnknownPath(f"{path[:200]}: nothing is served under this path; see /openapi.json")

    def _model_label(self, path: str) -> str | None:
        """`name/version` of the model that serves under a path, None if there is none."""
        try:
            _, name, version = self._route(path)
        except UnknownPath:
            return None
        return self.store.label(name, version)

    def _label_of(self, path: str) -> str:
        """The route of a path with `{model}` for the model's name, "unknown" for a path that is none."""
        try:
            route, _, _ = self._route(path)
        except UnknownPath:
            return "unknown"
        for base, routes in ((f"{MODELS}{{model}}/", self._of_model), (f"{REPOSITORY}{{model}}/", self._of_repository)):
            for tail, of_tail in routes.items():
                if route is of_tail:
                    return (base + tail).rstrip("/")
        return path

    def _loaded(self, request: Request) -> LoadedVersion:
        return self.store.get(request.name, request.version)

    def _stats(self, request: Request) -> Response:
        return json_response(describe.statistics_of(self.store, request.name, request.version))

    def _infer(self, request: Request) -> Response:
        """The answer to an inference, the only one that is compressed: Triton's asyncio client unpacks no other."""
        loaded, headers = self.store.get(request.name, request.version), request.headers
        length = headers.get(b"inference-header-content-length")
        read = partial(read_infer, request.body, length, loaded.metadata.electrodes, self.limits.batch)
        body, json_length = answer_inference(loaded, read, write_answer)
        body, encoding = compress(body, headers.get(b"accept-encoding", b""))
        response = response_of(200, b"application/json" if json_length is None else b"application/octet-stream", body)
        if json_length is not None:
            response.headers.append((b"inference-header-content-length", b"%d" % json_length))
        if encoding:
            response.headers.append((b"content-encoding", encoding))
        return response

    def _ready(self, request: Request) -> Response:
        if why := self.store.unready(full=request.trusted):
            raise ModelError(f"not ready: {why}")
        return json_response({"ready": True})

    def _index(self, request: Request) -> Response:
        ready = read_object(request.body).get("ready", False)
        if not isinstance(ready, bool):
            raise RequestError(f"ready: expected true or false, got {ready!r:.100}")
        return json_response(describe.repository_index(self.store, ready=ready))

    def _load(self, request: Request) -> Response:
        if read_object(request.body).get("parameters", {}) != {}:
            raise RequestError(describe.NO_LOAD_PARAMETERS)
        self.store.load(request.name)
        return json_response({})

    def _unload(self, request: Request) -> Response:
        read_object(request.body)
        self.store.unload(request.name)
        return json_response({})

    def _page(self, _: Request) -> Response:
        response = response_of(200, b"text/html; charset=utf-8", page(self.store).encode())
        response.headers.extend(PAGE_HEADERS)
        return response
