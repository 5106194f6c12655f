"""Handler that computes the responses to HTTP requests of the Open Inference Protocol.

The class `Handler` does not depend on the server that receives the requests. A request consists of method, path,
headers and body. A response consists of status, headers and body. Any thread may answer requests. Most responses take
microseconds to compute, and a response to the largest batch takes milliseconds. Some responses take longer, for example
because a model is loaded. The method `may_block` returns whether computing the response for a path may take a long
time.
"""

import re
import time
from collections.abc import Iterable
from functools import lru_cache

from isocharge.common.errors import UnknownPath, WrongMethod
from isocharge.serve.network.address import ServerLimits
from isocharge.serve.network.browser_check import AccessCheck, header_values
from isocharge.serve.network.metrics import Client, Exchange, Traffic
from isocharge.serve.network.model_store import ModelStore
from isocharge.serve.network.protocol.response import Response, decompress, error_response, json_response
from isocharge.serve.network.protocol.routes import ROUTES, Request, Route

Headers = Iterable[tuple[bytes, bytes]]
"""Headers of a request. The names are in lower case, and the values are unchanged."""

_PATTERNS = [
    (re.compile(template.format(model="(?P<model>[^/]*)", version="(?P<version>[^/]+)")), route)
    for route in ROUTES
    for template in route.paths
]
"""Regular expressions of the paths of each route. Templates of paths contain no special characters but the point."""


@lru_cache
def match_path(path: str) -> tuple[Route | None, str, str]:
    """Return the route of a path, and the name and the version of the model in the path.

    If the path contains no name or no version, the name or the version in the result is empty. If the server has no
    route for the path, the route is None.
    """
    for pattern, route in _PATTERNS:
        path_match = pattern.fullmatch(path)
        if path_match is not None:
            parameters = path_match.groupdict()
            return route, parameters.get("model", ""), parameters.get("version", "")
    return None, "", ""


class Handler:
    """Handler that answers HTTP requests with the models of a store, and counts and logs the requests."""

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

    def may_block(self, path: str) -> bool:
        """Return whether computing the response for a path may take a long time.

        The server should then compute the response in another thread, so that other requests are not delayed.
        """
        route, _, _ = match_path(path)
        return route is not None and route.may_block

    def answer(self, method: str, path: str, headers: Headers, body: bytes, client: Client = None) -> Response:
        """Answer one request, count the request, and log the request if there is a log.

        Args:
            method: Method in capitals.
            path: Path without the query. Its percent-encoding is already decoded.
            headers: Headers of the request.
            body: Body of the request, which may be compressed.
            client: Address and port of the client, for the log.

        Returns:
            The response. If an error occurs, it is not raised, but the response contains its status and its message.
        """
        start_ns = time.perf_counter_ns()
        route, model, version = match_path(path)
        label = "unknown" if route is None else route.paths[0]  # all paths of a route are counted under the first path
        try:
            request = Request(self.store, self.limits, self.traffic, header_values(headers), body, model, version)
            response = self._check_and_answer(method, path, route, request)
        except Exception as error:  # every error is sent to the client
            response = error_response(error)
        self.traffic.count("http", label, response.status)
        log = self.traffic.log
        if log is not None:  # the properties of the exchange are only determined for the log
            exchange = Exchange(
                transport="http",
                route=label,
                status=response.status,
                model=self.store.label(model, version),
                error=response.error,
                duration_us=(time.perf_counter_ns() - start_ns) / 1000,
                bytes_in=len(body),
                bytes_out=len(response.body),
                client=client,
            )
            log.write_exchange(exchange)
        return response

    def _check_and_answer(self, method: str, path: str, route: Route | None, request: Request) -> Response:
        """Check whether a request is allowed, answer the request, and return the response.

        Args:
            method: Method in capitals.
            path: Path without the query, for error messages.
            route: Route of the path, or None if the server has no route for the path.
            request: The request, whose body may be compressed.

        Raises:
            IsochargeError: If the request is refused.
        """
        headers = request.headers
        # The token is checked before unknown paths are refused. A client without the token therefore cannot find out
        # which paths exist.
        self.access.check(method, headers, needs_token=route is None or route.needs_token)
        if route is None:
            raise UnknownPath(f"{path[:200]}: nothing is served under this path; see /openapi.json")
        # A HEAD request is answered like a GET request. The server then sends the response without its body.
        is_head_of_get = method == "HEAD" and route.method == "GET"
        if method != route.method and not is_head_of_get:
            raise WrongMethod(f"{path}: expected the method {route.method}, got {method[:20]}", route.method)
        self.limits.check_body(len(request.body))
        encoding = headers.get(b"content-encoding")
        if encoding is not None:
            plain_body = decompress(request.body, encoding.lower(), self.limits.body_bytes)
            request = request._replace(body=plain_body)
        answer = route.respond(request)
        return answer if isinstance(answer, Response) else json_response(answer)
