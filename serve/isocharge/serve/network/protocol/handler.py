"""Answers requests of the Open Inference Protocol: method, path, headers and body in; status, headers and body out.

This module knows no transport. Everything but loading and unloading takes microseconds, or milliseconds for the
largest batch, and may be called from any thread; `blocks` says for which paths a server had better use another thread.
"""

import re
import time
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache, partial
from typing import NamedTuple

from isocharge.common.errors import RequestError, UnknownPath, WrongMethod
from isocharge.serve.network.address import ServerLimits, Token
from isocharge.serve.network.browser_check import BrowserCheck
from isocharge.serve.network.metrics import CONTENT_TYPE, Metrics
from isocharge.serve.network.model_store import LoadedVersion, ModelStore
from isocharge.serve.network.protocol import describe
from isocharge.serve.network.protocol.inference import answer_inference, read_infer, read_object, write_answer
from isocharge.serve.network.protocol.response import (
    Response,
    compress,
    decompress,
    error_response,
    json_response,
    response_of,
)
from isocharge.serve.network.traffic import Client, Exchange, Traffic

Headers = Iterable[tuple[bytes, bytes]]
"""Names in lower case, values as they came."""

KNOWN_PATHS = 64
"""Paths whose route is remembered: those asked for last."""

MODEL_PATH = re.compile(r"/v2/models/(?P<name>[^/]*)(/versions/(?P<version>[^/]+))?(/(?P<tail>\w+))?")
REPOSITORY_PATH = re.compile(r"/v2/repository/models/(?P<name>[^/]*)/(?P<tail>\w+)")


OPEN = ("/v2/health/live", "/v2/health/ready")
"""Paths that need no token: programs that start and watch servers have none."""


class Request(NamedTuple):
    """A request with its body unpacked, and the model that its path names."""

    headers: Mapping[bytes, bytes]
    body: bytes
    name: str
    version: str


Route = tuple[str, Callable[[Request], Response]]
"""The method that a path takes, and the function that answers."""


class Found(NamedTuple):
    """What is served under a path: its route, the path for the log and the counters, and the model that it names."""

    route: Route | None
    label: str
    name: str = ""
    version: str = ""


class Handler:
    """Answers requests from the models of a store, counts them, and writes them into the log."""

    def __init__(
        self,
        store: ModelStore,
        limits: ServerLimits | None = None,
        traffic: Traffic | None = None,
        token: Token | None = None,
        browser_check: BrowserCheck | None = None,
    ) -> None:
        """Set up the routes.

        Args:
            store: The models.
            limits: Bounds of body and batch, and of the connections, which the transport observes.
            traffic: Counters and log of the requests.
            token: Token that requests must carry; None answers everybody.
            browser_check: Refuses requests by pages of other sites; None accepts the host names that always lead to
                this machine.
        """
        self.store = store
        self.token = token
        self.limits = limits or ServerLimits()
        self._browser_check = browser_check or BrowserCheck(any_host=token is not None)
        self.traffic = traffic or Traffic()
        metrics = Metrics(store, self.traffic, describe.server_metadata()["version"])
        self._fixed: dict[str, Route] = {
            "/": ("GET", self._page),
            "/metrics": ("GET", lambda _: response_of(200, CONTENT_TYPE, metrics.text())),
            "/openapi.json": ("GET", lambda _: json_response(describe.openapi(store))),
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
            "stats": (
                "GET",
                lambda request: json_response(describe.statistics_of(store, request.name, request.version)),
            ),
            "infer": ("POST", self._infer),
        }
        self._of_repository: dict[str, Route] = {"load": ("POST", self._load), "unload": ("POST", self._unload)}
        self._find = lru_cache(KNOWN_PATHS)(self._find_path)

    def blocks(self, path: str) -> bool:
        """Whether answering this path may take longer than others should wait."""
        return path.startswith("/v2/repository/models/")

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
        began, found, log = time.perf_counter_ns(), self._find(path), self.traffic.log
        try:
            response = self._answer(method, path, found, dict(headers), body)
        except Exception as error:  # the one place where an error becomes an answer
            response = error_response(error)
        status = response.status
        self.traffic.count("http", found.label, status)
        if log is not None:
            model, ns = self.store.label(found.name, found.version), time.perf_counter_ns() - began
            sizes = len(body), len(response.body)
            log.exchange(Exchange("http", found.label, status, model, response.error, ns, *sizes, client))
        return response

    def refused(self, response: Response, client: Client = None) -> None:
        """Count and log a refusal that did not come from here, as the request could not be read to its end."""
        size = len(response.body)
        self.traffic.note(Exchange("http", "none", response.status, None, response.error, 0, 0, size, client))

    def _answer(self, method: str, path: str, found: Found, fields: dict[bytes, bytes], body: bytes) -> Response:
        self._browser_check.check(method, fields)
        if self.token is not None and path not in OPEN:
            self.token.check(fields.get(b"authorization", b""))
        route, _, name, version = found
        if route is None:
            raise UnknownPath(f"{path[:200]}: nothing is served under this path; see /openapi.json")
        expected, respond = route
        if method != expected and (method, expected) != ("HEAD", "GET"):
            raise WrongMethod(f"{path}: expected the method {expected}, got {method[:20]}", expected)
        self.limits.check_body(len(body))
        if b"content-encoding" in fields:
            body = decompress(body, fields[b"content-encoding"].lower(), self.limits.body_bytes)
        return respond(Request(fields, body, name, version))

    def _find_path(self, path: str) -> Found:
        """What is served under a path."""
        if path in self._fixed:
            return Found(self._fixed[path], path)
        for pattern, base, routes in (
            (MODEL_PATH, "/v2/models/{model}/", self._of_model),
            (REPOSITORY_PATH, "/v2/repository/models/{model}/", self._of_repository),
        ):
            match = pattern.fullmatch(path)
            if match is not None and (tail := match["tail"] or "") in routes:
                version = match.groupdict().get("version") or ""
                return Found(routes[tail], (base + tail).rstrip("/"), match["name"], version)
        return Found(None, "unknown")

    def _loaded(self, request: Request) -> LoadedVersion:
        return self.store.get(request.name, request.version)

    def _infer(self, request: Request) -> Response:
        """The answer to an inference, the only one that is compressed: Triton's asyncio client unpacks no other."""
        loaded, headers = self.store.get(request.name, request.version), request.headers
        length = headers.get(b"inference-header-content-length")
        read = partial(read_infer, request.body, length, loaded, self.limits.batch)
        body, json_length = answer_inference(loaded, read, write_answer)
        accepted = headers.get(b"accept-encoding")
        body, encoding = compress(body, accepted) if accepted else (body, b"")
        response = response_of(200, b"application/json" if json_length is None else b"application/octet-stream", body)
        if json_length is not None:
            response.headers.append((b"inference-header-content-length", b"%d" % json_length))
        if encoding:
            response.headers.append((b"content-encoding", encoding))
        return response

    def _ready(self, _: Request) -> Response:
        self.store.check_ready()
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
        response = response_of(200, b"text/html; charset=utf-8", describe.page(self.store).encode())
        response.headers.extend(describe.PAGE_HEADERS)
        return response
