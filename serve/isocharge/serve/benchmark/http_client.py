"""A client for load on a server of the Open Inference Protocol: plain sockets, as a client should cost least."""

import json
import selectors
import socket
import time
from types import TracebackType
from typing import Self

import numpy as np

from isocharge.common.arrays import Singles
from isocharge.common.errors import IsochargeError
from isocharge.serve.benchmark.timing import Contender, Timing

TIMEOUT_S = 20.0
"""Time for an answer, s."""


class HttpLoad:
    """Requests for one model over one open connection or many; a context manager."""

    def __init__(self, host: str, port: int, model: str) -> None:
        """Connect.

        Args:
            host, port: Of the server.
            model: Name of the model, or NAME/versions/NUMBER; the latest version without a number.

        Raises:
            OSError: If nothing listens there.
        """
        self._address, self._path = (host, port), f"/v2/models/{model}/infer"
        self._connection = self._connect()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the connection."""
        self._connection.close()

    def contender(self, charge_pC: Singles) -> Contender:
        """A request with all rows, shape (n, electrodes), pC, as JSON: one at a time over the open connection."""
        request, presses = self._request(charge_pC), len(charge_pC)
        name = "HTTP, JSON" if presses == 1 else f"HTTP, JSON, {presses}"
        return Contender(name, presses, lambda: self._exchange(request))

    def many(self, charge_pC: Singles, connections: int, seconds: float) -> Timing:
        """One press on each of many connections at a time.

        Args:
            charge_pC: The press, shape (1, electrodes), pC.
            connections: Their number.
            seconds: For so long, s; a tenth of it before that warms up.
        """
        request, began = self._request(charge_pC), time.perf_counter_ns()
        durations: list[int] = []
        start, end = began + round(1e8 * seconds), began + round(1.1e9 * seconds)
        with selectors.DefaultSelector() as waiting:
            opened = [self._connect() for _ in range(connections)]
            sent = {}
            for connection in opened:
                waiting.register(connection, selectors.EVENT_READ)
                sent[connection] = time.perf_counter_ns()
                connection.sendall(request)
            while time.perf_counter_ns() < end or len(durations) < connections:
                for key, _ in waiting.select(TIMEOUT_S):
                    connection = key.fileobj  # type: ignore[assignment]
                    _receive(connection)
                    now = time.perf_counter_ns()
                    if sent[connection] >= start:
                        durations.append(now - sent[connection])
                    sent[connection] = now
                    connection.sendall(request)
            for connection in opened:
                connection.close()
        return Timing.of(f"HTTP, JSON, {connections} connections", 1, np.array(durations, float), connections)

    def _exchange(self, request: bytes) -> None:
        self._connection.sendall(request)
        _receive(self._connection)

    def _connect(self) -> socket.socket:
        connection = socket.create_connection(self._address, timeout=TIMEOUT_S)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return connection

    def _request(self, charge_pC: Singles) -> bytes:
        shape = list(charge_pC.shape)
        tensor = {"name": "charge_pC", "datatype": "FP32", "shape": shape, "data": charge_pC.ravel().tolist()}
        body = json.dumps({"inputs": [tensor]}).encode()
        return f"POST {self._path} HTTP/1.1\r\nHost: bench\r\nContent-Length: {len(body)}\r\n\r\n".encode() + body


def _receive(connection: socket.socket) -> None:
    """Read a whole answer.

    Raises:
        ConnectionError: If the server hangs up.
        IsochargeError: If the answer is not a good one.
    """
    data = _more(connection)
    while (end := data.find(b"\r\n\r\n")) < 0:
        data += _more(connection)
    if not data.startswith(b"HTTP/1.1 200"):
        raise IsochargeError(f"expected an answer 200, got {data[:200]!r}")
    start = data.lower().index(b"content-length:") + len(b"content-length:")
    missing = end + 4 + int(data[start : data.index(b"\r\n", start)]) - len(data)
    while missing > 0:
        missing -= len(_more(connection))


def _more(connection: socket.socket) -> bytes:
    data = connection.recv(1 << 20)
    if not data:
        raise ConnectionError("the server hung up")
    return data
