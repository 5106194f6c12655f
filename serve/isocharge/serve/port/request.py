"""Boards that speak only when they are asked: the request, when it is due, and its echo.

On a line with two wires both ends hear everything: what the host sends comes back before the answer, and has to be
taken out of it. The next request waits until the answer has come and the line is quiet.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

QUIET_S = 0.002
"""Silence after which an answer counts as complete, s: two bytes at 9600 baud."""

UNANSWERED_S = 0.2
"""Time after which a request without an answer is repeated, s."""


@dataclass(frozen=True)
class Request:
    """What a board is asked.

    Attributes:
        data: The bytes to send.
        rate_Hz: Requests per second, at most.
        echo: Whether the line brings them back.
    """

    data: bytes
    rate_Hz: float = 100.0
    echo: bool = False


class Asker:
    """Says when a request is due, and takes its echo out of what comes."""

    def __init__(self, request: Request, now_s: Callable[[], float] = time.monotonic) -> None:
        self._request, self._now_s = request, now_s
        self._requests = self._echoes = 0
        self.forget()

    @property
    def echo_share(self) -> float:
        """Share of the requests that came back, dimensionless, whether they are taken out or not."""
        return self._echoes / max(1, self._requests)

    def forget(self) -> None:
        """The line was opened anew: ask at once."""
        self._asked_s = self._heard_s = -float("inf")
        self._echo = b""

    def wait_s(self) -> float:
        """Time until the next request is due, s; 0 if it is."""
        now_s = self._now_s()
        due_s = self._asked_s + 1.0 / self._request.rate_Hz
        if self._heard_s < self._asked_s:
            due_s = max(due_s, self._asked_s + UNANSWERED_S)
        return max(0.0, due_s - now_s, self._heard_s + QUIET_S - now_s)

    def asked(self) -> bytes:
        """The bytes to send now."""
        self._asked_s = self._now_s()
        self._requests += 1
        self._echo = self._request.data
        return self._request.data

    def heard(self, data: bytes) -> bytes:
        """What of the bytes that came is not the echo of the request."""
        if not data:
            return b""
        self._heard_s = self._now_s()
        common = min(len(data), len(self._echo))
        if not common or data[:common] != self._echo[:common]:
            self._echo = b""
            return data
        self._echo = self._echo[common:]
        self._echoes += not self._echo
        return data[common:] if self._request.echo else data
