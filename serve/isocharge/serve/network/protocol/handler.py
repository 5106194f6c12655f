"""Responses to requests of the Open Inference Protocol, independent of the transport.

A request consists of method, path, headers and body. A response consists of status, headers and body. Requests may be
answered in any thread. Most responses take microseconds, and the largest batch takes milliseconds. The method
`may_block` returns whether a server should use another thread for a path.
"""

import re
import time
from collections.abc import Iterable
from functools import lru_cache, partial
from typing import NamedTuple

from isocharge.common.errors import UnknownPath, WrongMethod
from isocharge.serve.network.address import ServerLimits, Token
from isocharge.serve.network.browser_check import BrowserCheck
from isocharge.serve.network.metrics import Metrics
from isocharge.serve.network.model_store import ModelStore
from isocharge.serve.network.protocol import describe
from isocharge.serve.network.protocol.openapi import openapi_document
from isocharge.serve.network.protocol.response import Response, decompress, error_response
from isocharge.serve.network.protocol.routes import ROUTES, Request, Route, Service
from isocharge.serve.network.traffic import Client, Exchange, Traffic

Headers = Iterable[tuple[bytes, bytes]]
"""Headers of a request: names in lower case, values as they were sent."""

MAX_REMEMBERED_PATHS = 64
"""Number of recent paths whose route is cached."""


class Match(NamedTuple):
    """The route of a path.

    Attributes:
        route: The route; None if there is none.
        label: Template of the path for the log and the counters.
        model: Name of the model in the path; empty if the path names none.
        version: Version in the path; empty if the path names none.
    """

    route: Route | None
    label: str
    model: str = ""
    version: str = ""


NO_ROUTE = Match(None, "unknown")

_PARAMETERS = {"{model}": "(?P<model>[^/]*)", "{version}": "(?P<version>[^/]+)"}
"""Regular expressions of the parameters in a template."""


def _pattern(template: str) -> re.Pattern[str]:
    """Return the regular expression of the paths that fit a template."""
    expression = re.escape(template)
    for name, parameter in _PARAMETERS.items():
        expression = expression.replace(re.escape(name), parameter)
    return re.compile(expression)


_PATTERNS = [(_pattern(template), route) for route in ROUTES for template in route.paths]


@lru_cache(MAX_REMEMBERED_PATHS)
def match_path(path: str) -> Match:
    """Return the route of a path, with the name and the version of the model that the path contains.

    The name and the version are empty if the path contains none. The result is `NO_ROUTE` if no route has this path.
    """
    for pattern, route in _PATTERNS:
        path_match = pattern.fullmatch(path)
        if path_match is not None:
            parameters = path_match.groupdict()
            label = route.paths[0]  # all paths of a route are counted together
            return Match(route, label, parameters.get("model", ""), parameters.get("version", ""))
    return NO_ROUTE


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
        """Set up the handler.

        Args:
            store: The models.
            limits: Limits of the body and of the batch. The transport observes the limits of the connections.
            traffic: Counters and log of the requests.
            token: Token that requests must carry; None if no token is needed.
            browser_check: Check that refuses requests from web pages of other sites. By default, requests for the host
                names of this machine are accepted, or requests for any host name if there is a token.
        """
        self.store = store
        self.token = token
        self.limits = limits or ServerLimits()
        has_token = token is not None
        self._browser_check = browser_check or BrowserCheck(any_host=has_token)
        self.traffic = traffic or Traffic()
        metrics = Metrics(store, self.traffic, describe.server_metadata()["version"])
        self._service = Service(store, self.limits, metrics, partial(openapi_document, ROUTES, store))

    def may_block(self, path: str) -> bool:
        """Return whether the response for this path may take long, so that it must not delay other requests."""
        route = match_path(path).route
        return route is not None and route.may_block

    def answer(self, method: str, path: str, headers: Headers, body: bytes, client: Client = None) -> Response:
        """Answer one request, count it, and write it to the log, if there is one.

        Args:
            method: Method in capitals.
            path: Path without the query, percent-decoded.
            headers: Headers of the request.
            body: Body of the request, which may be compressed.
            client: Address of the client, for the log.

        Returns:
            The response. No error is raised: an error becomes a response with the body {"error": "..."}.
        """
        start_ns = time.perf_counter_ns()
        match = match_path(path)
        try:
            response = self._check_and_answer(method, path, match, dict(headers), body)
        except Exception as error:  # every error becomes a response here
            response = error_response(error)
        self.traffic.count("http", match.label, response.status)
        log = self.traffic.log
        if log is not None:
            exchange = Exchange(
                transport="http",
                route=match.label,
                status=response.status,
                model=self.store.label(match.model, match.version),
                error=response.error,
                ns=time.perf_counter_ns() - start_ns,
                bytes_in=len(body),
                bytes_out=len(response.body),
                client=client,
            )
            log.exchange(exchange)
        return response

    def refused(self, response: Response, client: Client = None) -> None:
        """Count and log the refusal of a request that the transport could not read to its end."""
        size = len(response.body)
        self.traffic.note(Exchange("http", "none", response.status, None, response.error, 0, 0, size, client))

    def _check_and_answer(
        self, method: str, path: str, match: Match, fields: dict[bytes, bytes], body: bytes
    ) -> Response:
        """Check a request, answer it, and return the response.

        Args:
            method: Method in capitals.
            path: Path without the query, for error messages.
            match: Route of the path.
            fields: Values of the headers by their names in lower case.
            body: Body of the request, which may be compressed.

        Raises:
            IsochargeError: If the request is refused.
        """
        self._browser_check.check(method, fields)
        route = match.route
        # The token is checked before unknown paths are refused, so that a client without a token does not learn which
        # paths exist.
        if self.token is not None and (route is None or route.needs_token):
            self.token.check(fields.get(b"authorization", b""))
        if route is None:
            raise UnknownPath(f"{path[:200]}: nothing is served under this path; see /openapi.json")
        is_head_of_get = method == "HEAD" and route.method == "GET"  # the transport then omits the body
        if method != route.method and not is_head_of_get:
            raise WrongMethod(f"{path}: expected the method {route.method}, got {method[:20]}", route.method)
        self.limits.check_body(len(body))
        encoding = fields.get(b"content-encoding", b"").lower()
        plain_body = decompress(body, encoding, self.limits.body_bytes)
        return route.respond(Request(self._service, fields, plain_body, match.model, match.version))
