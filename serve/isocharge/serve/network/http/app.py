"""The protocol's handler behind the token and the log of requests."""

import time
from collections.abc import Callable

from isocharge.common.errors import TokenError
from isocharge.serve.network.credentials import Token
from isocharge.serve.network.protocol import Handler, Response
from isocharge.serve.network.protocol.handler import Headers
from isocharge.serve.network.protocol.response import error_response
from isocharge.serve.network.traffic import Client, Exchange

OPEN = ("/v2/health/live", "/v2/health/ready")
"""Paths that need no token: programs that start and watch servers have none."""


class App:
    """The handler, behind a token."""

    def __init__(self, handler: Handler, token: Token | None = None) -> None:
        """Without a token, everybody is answered."""
        self.handler, self._token = handler, token
        self.blocks = handler.blocks

    def watch_connections(self, count: Callable[[], int]) -> None:
        """Read the number of open connections for the metrics."""
        self.handler.traffic.open["http"] = count

    def answer(self, method: str, path: str, headers: Headers, body: bytes, client: Client = None) -> Response:
        """Answer one request, as `Handler.answer` does, if it carries the token; log it."""
        if self.handler.traffic.log is not None:
            return self._answer_logged(method, path, headers, body, client)
        if self._token is not None:
            return self._answer_to_token(self._token, method, path, headers, body)
        return self.handler.answer(method, path, headers, body)

    def refused(self, response: Response, client: Client = None) -> None:
        """Count and log a refusal that did not come from here, as the request could not be read to its end."""
        self.handler.traffic.count("http", "none", response.status)
        self._log(None, response, 0, 0, client)

    def _answer_to_token(self, token: Token, method: str, path: str, headers: Headers, body: bytes) -> Response:
        try:
            token.check(dict(headers).get(b"authorization", b""))
        except TokenError as error:
            if path in OPEN:
                return self.handler.answer(method, path, headers, body, trusted=False)
            response = error_response(error)
            self.handler.traffic.count("http", self.handler.label(path), response.status)
            return response
        return self.handler.answer(method, path, headers, body)

    def _answer_logged(self, method: str, path: str, headers: Headers, body: bytes, client: Client) -> Response:
        began = time.perf_counter_ns()
        if self._token is None:
            response = self.handler.answer(method, path, headers, body)
        else:
            response = self._answer_to_token(self._token, method, path, headers, body)
        self._log(path, response, time.perf_counter_ns() - began, len(body), client)
        return response

    def _log(self, path: str | None, response: Response, ns: int, bytes_in: int, client: Client) -> None:
        """Write a request into the log, if there is one; without a path it could not be read."""
        log, sizes = self.handler.traffic.log, (bytes_in, len(response.body))
        if log is None:
            return
        route, model = ("none", None) if path is None else (self.handler.label(path), self.handler.model_label(path))
        error: str | None = getattr(response, "error", None)
        log.exchange(Exchange("http", route, response.status, model, error, ns, *sizes, client))
