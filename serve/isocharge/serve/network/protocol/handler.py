"""ASGI applications: their base class, and the handler of the requests of the Open Inference Protocol.

The class `Handler` answers the requests of the protocol. The handler does not depend on the server that receives the
requests. The function `asgi_app` creates a handler that another program can mount. A request consists of method, path,
headers and body. A response consists of status, headers and body. Any thread may answer requests. Most responses take
microseconds to compute, and a response to the largest batch takes milliseconds. Some responses take longer, for example
because a model is loaded. The attribute `blocking_paths` lists the paths of such requests.

The base class `Application` is a bare ASGI callable without a framework. `Application` is also the base class of the
live page. The handler needs no router of a framework, because the table `ROUTES` already selects the function for a
request and the name of its counter.
"""

import asyncio
import re
import time
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Iterable, MutableMapping
from functools import lru_cache
from typing import Any

from isocharge.common.errors import RequestError
from isocharge.common.files import StrPath
from isocharge.serve.network.address import ServerLimits
from isocharge.serve.network.browser_check import AccessCheck, Headers, header_values
from isocharge.serve.network.metrics import Client, Traffic
from isocharge.serve.network.model_store import ModelStore
from isocharge.serve.network.protocol.response import Header, Response, decompress, json_response, refusal
from isocharge.serve.network.protocol.routes import ROUTES, UNKNOWN, Request, Route

Message = MutableMapping[str, Any]
"""Message or scope of ASGI."""

Channel = Callable[..., Awaitable[Any]]
"""Function of ASGI that receives or sends a message."""


class Application(ABC):
    """ASGI application: the handler of models or the live page. An application can be mounted under any path of another
    program.

    Attributes:
        limits: Limits of the requests.
        traffic: Counters of the requests.
        blocking_paths: Beginnings of the paths for which computing a response may take a long time. Such a response is
            computed in another thread, so that other requests are not delayed.
    """

    limits: ServerLimits
    traffic: Traffic
    blocking_paths: tuple[str, ...] = ()

    async def __call__(self, scope: Message, receive: Channel, send: Channel) -> None:
        """Answer one HTTP request. If the client disconnects before its request is complete, nothing is sent.

        WebSockets are refused. No work is needed at the start and at the end of the program (lifespan of ASGI). A
        server that stops cancels requests that it cannot finish in time, and their clients receive the status 503.

        Args:
            scope: Method, path, headers and client of the request.
            receive: Function that returns the next part of the request.
            send: Function that sends a part of the response.
        """
        if scope["type"] == "websocket":
            await send({"type": "websocket.close"})
            return
        if scope["type"] == "lifespan":  # the messages of the start and of the end of the program are only confirmed
            for event in ("startup", "shutdown"):
                await receive()
                await send({"type": f"lifespan.{event}.complete"})
            return
        try:
            body = await self._read_body(receive)
            if body is None:
                return
            path = scope["path"].removeprefix(scope.get("root_path", ""))  # the root path belongs to a mounting program
            request = (scope["method"], path, scope["headers"], body, scope.get("client"))
            if path.startswith(self.blocking_paths):  # a tuple of beginnings of paths
                response = await asyncio.to_thread(self.answer, *request)
            else:  # most answers take only microseconds
                response = self.answer(*request)
        except asyncio.CancelledError:
            error = "the server has stopped before it could answer; send the request again"
            response = json_response({"error": error}, 503)
        await send({"type": "http.response.start", "status": response.status, "headers": response.headers})
        await send({"type": "http.response.body", "body": response.body})

    async def _read_body(self, receive: Channel) -> bytes | None:
        """Return the body of a request, or None if the client disconnects before the end of the body.

        If the body is larger than allowed, the rest of the body is not received. The method `answer` then refuses the
        request.

        Args:
            receive: Function that returns the next part of the request.
        """
        body = bytearray()
        message: Message = {"more_body": True}  # as if a part of the body had been received and another part followed
        while message.get("more_body") and len(body) <= self.limits.body_bytes:
            message = await receive()
            if message["type"] == "http.disconnect":
                return None
            body += message.get("body", b"")
        return bytes(body)

    def answer(self, method: str, path: str, headers: Iterable[Header], body: bytes, client: Client = None) -> Response:
        """Answer one request, count the request, and log the request if there is a log.

        Args:
            method: Method in capitals.
            path: Path without the query. Its percent-encoding is already decoded.
            headers: Headers of the request.
            body: Body of the request, which may be compressed.
            client: Address and port of the client, for the log.

        Returns:
            The response. If an error occurs, the error is not raised. The response then contains the status and the
            message of the error.
        """
        start_ns = time.perf_counter_ns()
        limit = self.limits.body_bytes
        try:
            if len(body) > limit:
                raise RequestError(f"expected a body of at most {limit} bytes, got more; send smaller batches", 413)
            response = self._check_and_answer(method, path, header_values(headers), body)
        except Exception as error:  # every error is sent to the client
            status, message = refusal(error)
            # A RequestError may contain headers for the response.
            response = json_response({"error": message}, status, *getattr(error, "headers", ()))
        self.traffic.count("http", self._route_name(path), response.status, client, start_ns)
        return response

    def _route_name(self, path: str) -> str:  # noqa: ARG002
        """Return the name under which a request is counted and logged. By default, all requests have the same name."""
        return "page"

    @abstractmethod
    def _check_and_answer(self, method: str, path: str, headers: Headers, body: bytes) -> Response:
        """Check whether a request is allowed, answer the request, and return the response.

        Args:
            method: Method in capitals.
            path: Path without the query.
            headers: Values of the headers by name.
            body: Body of the request, which may be compressed.

        Raises:
            IsochargeError: If the request is refused.
        """


def check_method(path: str, method: str, allowed: str) -> None:
    """Check the method of a request.

    Raises:
        RequestError: If the method is not the only method that is allowed for the path.
    """
    if method != allowed:
        raise RequestError(
            f"{path}: expected the method {allowed}, got {method[:20]}", 405, (b"allow", allowed.encode())
        )


_PATTERNS = [
    (re.compile(route.path.format(model="(?P<name>[^/]+)", version="(/versions/(?P<version>[^/]+))?")), route)
    for route in ROUTES
]
"""Regular expression of the path of each route. The point is the only special character in templates."""


@lru_cache
def match_path(path: str) -> tuple[Route, dict[str, str]]:
    """Return the route of a path, and the `name` and the `version` of the model that the path contains.

    If the server has no route for the path, the route is `UNKNOWN`.
    """
    for pattern, route in _PATTERNS:
        if path_match := pattern.fullmatch(path):
            return route, path_match.groupdict(default="")
    return UNKNOWN, {}


class Handler(Application):
    """Application that answers HTTP requests with the models of a store, and counts and logs the requests."""

    blocking_paths = ("/v2/repository/models/",)

    def __init__(
        self,
        store: ModelStore,
        limits: ServerLimits | None = None,
        traffic: Traffic | None = None,
        access: AccessCheck | None = None,
    ) -> None:
        """Create a handler for the models of a store.

        Args:
            store: Store of the models that the server uses.
            limits: Limits of the server. The handler applies the limits of the body and of the batch. The server itself
                applies the limits of the connections.
            traffic: Counters and log of the requests. By default, the requests are counted, but not logged.
            access: Check of the token, and of the web page that has sent a request. By default, requests need no token,
                and only requests for IP addresses and for `localhost` are accepted.
        """
        self.store = store
        self.access = access or AccessCheck()
        self.limits = limits or ServerLimits()
        self.traffic = traffic or Traffic()
        self.traffic.registry.register(store)  # the store provides the metrics of the models

    def _route_name(self, path: str) -> str:
        """Return the path of the route of a request. Requests with and without a version have the same name."""
        route, _ = match_path(path)
        return route.path.replace("{version}", "")

    def _check_and_answer(self, method: str, path: str, headers: Headers, body: bytes) -> Response:
        """Check a request, and answer it with the function of its route."""
        route, path_values = match_path(path)  # the values are the name and the version of the model, if any
        # The token is checked before unknown paths are refused. A client without the token therefore cannot find out
        # which paths exist.
        self.access.check(method, headers, needs_token=route.needs_token)
        if route is UNKNOWN:
            raise RequestError(f"{path[:200]}: nothing is served under this path; see /openapi.json", 404)
        # A HEAD request is answered like a GET request. The server then sends the response without its body.
        if method != "HEAD" or route.method != "GET":
            check_method(path, method, route.method)
        body = decompress(body, headers.get(b"content-encoding", b"").lower(), self.limits.body_bytes)
        answer = route.respond(Request(self.store, self.traffic, headers, body, **path_values))
        return answer if isinstance(answer, Response) else json_response(answer)


def asgi_app(models: StrPath | None = None, *, token: str | None = None, allowed_hosts: Iterable[str] = ()) -> Handler:
    """Load models, and return an ASGI application that serves them with the Open Inference Protocol.

    The limits of connections belong to the server that runs the program. The application itself limits the size of a
    request, and checks the token and the headers of browsers.

    Args:
        models: Folder of the models. By default, all repositories are searched, as `isocharge serve http` does.
        token: Secret that clients must send as `Authorization: Bearer TOKEN`. By default, requests need no token.
        allowed_hosts: Host names by which browsers reach the program, in addition to IP addresses and `localhost`. With
            a token, every host name is accepted.

    Raises:
        MissingExtra: If the extra `http` is not installed.
        InputError: If the token or a host name cannot be used.
        ModelError: If there is no model, or no version passes its checks.

    Example:
        >>> from starlette.applications import Starlette  # doctest: +SKIP
        >>> from starlette.routing import Mount  # doctest: +SKIP
        >>> app = Starlette(routes=[Mount("/touch", asgi_app(token="s3cret"))])  # doctest: +SKIP
    """
    access = AccessCheck(allowed_hosts=allowed_hosts, token=token)
    return Handler(ModelStore(models), access=access)
