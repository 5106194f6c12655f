"""HTTP: `isocharge serve http` against ten lines of uvicorn, which serve the same model file.

    python tests/benchmarks/bench_http.py [--model NAME|PATH] [--seconds 10]

The ten lines (`bare_app.py`) give the same answer with a `Predictor`. The client and the servers share the cores. The
client is a plain socket, the same for both servers. Latency: one request at a time over one open
connection, in turns. Throughput: 32 connections, each with one request under way, in ten turns.
"""

import argparse
import json
import re
import selectors
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from shared import in_turns, options, print_results

from isocharge.serve import find_model, load_model
from isocharge.serve.benchmark import Contender

CONNECTIONS = 32

Address = tuple[str, int]
"""Host and port."""


class Connection:
    """An open connection, over which one request can be under way."""

    def __init__(self, address: Address, request: bytes = b"") -> None:
        self.socket = socket.create_connection(address)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.request = request
        self.close = self.socket.close

    def send(self) -> None:
        """Send the request."""
        self.socket.sendall(self.request)

    def receive(self) -> None:
        """Receive the answer, whose status must be 200."""
        data = b""
        body_size = None
        while body_size is None or len(data) < body_size:
            received = self.socket.recv(1 << 16)
            if not received:
                raise RuntimeError("the server closed the connection")
            data += received
            head, separator, _ = data.partition(b"\r\n\r\n")
            if separator:
                body_size = len(head) + 4 + int(re.search(rb"content-length: *(\d+)", head, re.IGNORECASE)[1])
        if not data.startswith(b"HTTP/1.1 200"):
            raise RuntimeError(f"expected an answer 200, got {data[:300]!r}")

    def ask(self) -> None:
        """Send the request and receive its answer."""
        self.send()
        self.receive()


def free_port() -> int:
    """Return a port on which nothing listens."""
    with closing(socket.create_server(("127.0.0.1", 0))) as server:
        return int(server.getsockname()[1])


@contextmanager
def running(command: Sequence[str | Path], address: Address) -> Iterator[None]:
    """Run a server while the block runs, which begins when the server accepts connections and has loaded its model."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        while not _accepts(address):
            if process.poll() is not None:
                raise RuntimeError(f"{process.args} ended before it accepted a connection")
            time.sleep(0.1)
        time.sleep(2.0)  # another server may listen before it has loaded its model
        yield
    finally:
        process.terminate()
        process.wait(timeout=15)


def _accepts(address: Address) -> bool:
    """Return whether a server accepts connections at an address."""
    try:
        Connection(address).close()
    except OSError:
        return False
    return True


def throughput(address: Address, request: bytes, seconds: float) -> float:
    """Return the answers per second over 32 connections, each with one request under way."""
    with ExitStack() as stack, selectors.DefaultSelector() as waiting:
        for _ in range(CONNECTIONS):
            connection = stack.enter_context(closing(Connection(address, request)))
            waiting.register(connection.socket, selectors.EVENT_READ, connection)
            connection.send()
        begin_s = time.perf_counter()
        answers = 0
        while (now_s := time.perf_counter()) < begin_s + seconds:
            for key, _ in waiting.select(1.0):
                key.data.receive()
                key.data.send()
                answers += 1
    return answers / (now_s - begin_s)


def measure(asked: argparse.Namespace) -> dict[str, Any]:
    """Return the results by title."""
    folder = find_model(asked.model).resolve()
    model = load_model(folder).metadata
    charge_pC = np.random.default_rng(asked.seed).uniform(300.0, 1500.0, len(model.electrodes)).tolist()
    tensor = {"name": "charge_pC", "datatype": "FP32", "shape": [1, len(charge_pC)], "data": charge_pC}
    body = json.dumps({"inputs": [tensor]})
    head = f"POST /v2/models/{model.name}/infer HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    request = f"{head}Content-Length: {len(body)}\r\n\r\n{body}".encode()

    commands = {
        "isocharge": [sys.executable, "-m", "isocharge.cli", "serve", "http", "--models", folder.parents[1], "--port"],
        "ten lines of uvicorn": [sys.executable, Path(__file__).parent / "rivals/bare_app.py", folder / "model.onnx"],
    }
    addresses = {name: ("127.0.0.1", free_port()) for name in commands}
    with ExitStack() as stack:
        for name, command in commands.items():
            stack.enter_context(running([*command, str(addresses[name][1])], addresses[name]))
        connections = {
            name: stack.enter_context(closing(Connection(address, request))) for name, address in addresses.items()
        }
        one_press = [Contender(name, 1, connection.ask) for name, connection in connections.items()]
        latencies = in_turns(one_press, asked.seconds)
        rounds = [
            [throughput(address, request, asked.seconds / 10) for address in addresses.values()] for _ in range(10)
        ]
    medians = np.median(rounds, axis=0).round().tolist()
    return {
        "one press, one request at a time": latencies,
        "32 connections, answers per second": dict(zip(addresses, medians, strict=True)),
    }


def main() -> None:
    asked = options(__doc__, seconds=10.0)
    print_results("http", asked, measure(asked))


if __name__ == "__main__":
    main()
