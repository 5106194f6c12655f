"""HTTP: ours against ten lines of uvicorn, which serve the same model file.

    python tests/benchmarks/bench_http.py [--seconds 10] [--json]

The ten lines (`bare_app.py`) give the same answer with a Predictor. Client and servers share the cores; the client is a
plain socket, the same for all. Latency: one request at a time over one open connection, contenders take turns.
Throughput: 32 connections, each with one request under way; contenders take turns in ten rounds. A batch of 1024 is
measured twice: bytes on a socket, and arrays in and out of Triton's stock client.
"""

import argparse
import json
import selectors
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import tritonclient.http
from shared import in_turns, options, print_results

from isocharge.serve import find_model, load_model
from isocharge.serve.benchmark import Contender
from isocharge.serve.model.session import OUTPUTS

HERE = Path(__file__).parent
CONNECTIONS = 32

Address = tuple[str, int] | str
"""Host and port, or the path of a Unix socket."""

Contenders = dict[str, tuple[Address, str]]
"""Name to address and path of the request."""


class Connection:
    """One open connection that can have one request under way."""

    def __init__(self, address: Address) -> None:
        is_unix = isinstance(address, str)
        self.socket = socket.socket(socket.AF_UNIX) if is_unix else socket.create_connection(address)
        if is_unix:
            self.socket.connect(address)
        else:
            self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def ask(self, request: bytes) -> bytes:
        """The body of an answer that must be good."""
        self.socket.sendall(request)
        return self.receive()

    def receive(self) -> bytes:
        """The body of the answer to what was sent."""
        data = b""
        while (end := data.find(b"\r\n\r\n")) < 0:
            data += self._more()
        head = data[:end].lower()
        if not head.startswith(b"http/1.1 200"):
            raise RuntimeError(f"expected an answer 200, got {data[:300]!r}")
        size = end + 4 + int(head.partition(b"content-length:")[2].split(b"\r\n")[0])
        while len(data) < size:
            data += self._more()
        return data[end + 4 :]

    def _more(self) -> bytes:
        data = self.socket.recv(1 << 20)
        if not data:
            raise RuntimeError("the server hung up")
        return data

    def close(self) -> None:
        self.socket.close()


def http_request(path: str, body: bytes, headers: str = "") -> bytes:
    head = f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n{headers}"
    return f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body


def json_request(path: str, charge_pC: np.ndarray) -> bytes:
    tensor = {
        "name": "charge_pC",
        "datatype": "FP32",
        "shape": list(charge_pC.shape),
        "data": charge_pC.ravel().tolist(),
    }
    return http_request(path, json.dumps({"inputs": [tensor]}).encode())


def binary_request(path: str, charge_pC: np.ndarray) -> bytes:
    tensor = {"name": "charge_pC", "datatype": "FP32", "shape": list(charge_pC.shape)}
    tensor["parameters"] = {"binary_data_size": charge_pC.nbytes}
    text = json.dumps({"inputs": [tensor], "parameters": {"binary_data_output": True}}).encode()
    return http_request(path, text + charge_pC.tobytes(), f"Inference-Header-Content-Length: {len(text)}\r\n")


CODINGS = {"JSON": json_request, "binary": binary_request}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def running(command: list[str | Path], address: Address) -> Iterator[None]:
    """A server process, from its first accepted connection to the end of the block."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        _wait_for(process, address)
        yield
    finally:
        process.terminate()
        process.wait(timeout=15)


def _wait_for(process: subprocess.Popen[bytes], address: Address) -> None:
    """Wait until something listens, and a moment more: a rival may listen before it has loaded its model."""
    while process.poll() is None:
        try:
            Connection(address).close()
        except OSError:
            time.sleep(0.1)
        else:
            time.sleep(2.0)
            return
    raise RuntimeError(f"{process.args} ended before it accepted a connection")


def start(stack: ExitStack, model: str) -> Contenders:
    """Start every contender: ours, and the ten lines of uvicorn."""
    folder = find_model(model).resolve()
    path = f"/v2/models/{load_model(folder).metadata.name}/infer"
    tcp, uds = _local_address(), f"{stack.enter_context(tempfile.TemporaryDirectory())}/isocharge.sock"
    ours = [Path(sys.executable).with_name("isocharge"), "serve", "http", "--models", folder.parents[1]]
    stack.enter_context(running([*ours, "--port", str(tcp[1])], tcp))
    stack.enter_context(running([*ours, "--uds", uds], uds))
    contenders: Contenders = {"isocharge": (tcp, path), "isocharge, Unix socket": (uds, path)}
    bare = _local_address()
    words = [sys.executable, HERE / "rivals/bare_app.py", str(bare[1]), folder / "model.onnx"]
    stack.enter_context(running(words, bare))
    contenders["ten lines of uvicorn"] = bare, path
    return contenders


def _local_address() -> tuple[str, int]:
    return "127.0.0.1", free_port()


def throughput(address: Address, request: bytes, seconds: float) -> float:
    """Answers per second over 32 connections, each with one request under way."""
    with ExitStack() as stack, selectors.DefaultSelector() as waiting:
        for _ in range(CONNECTIONS):
            connection = stack.enter_context(closing(Connection(address)))
            waiting.register(connection.socket, selectors.EVENT_READ, connection)
            connection.socket.sendall(request)
        begin, answers = time.perf_counter(), 0
        while (now := time.perf_counter()) < begin + seconds:
            for key, _ in waiting.select(1.0):
                key.data.receive()
                key.data.socket.sendall(request)
                answers += 1
    return answers / (now - begin)


def asking(stack: ExitStack, address: Address, request: bytes) -> Callable[[], bytes]:
    """A call that sends a request over an open connection and waits for its answer; the first one opens it."""
    connection = cache(lambda: stack.enter_context(closing(Connection(address))))
    return lambda: connection().ask(request)


def stock_infer(client: Any, name: str, charges: np.ndarray, *, binary: bool) -> None:
    """Arrays in, arrays out through Triton's HTTP client: its own coding included."""
    tensor = tritonclient.http.InferInput("charge_pC", list(charges.shape), "FP32")
    tensor.set_data_from_numpy(charges, binary_data=binary)
    outputs = [tritonclient.http.InferRequestedOutput(output, binary_data=binary) for output in OUTPUTS]
    answer = client.infer(name, [tensor], outputs=outputs)
    for output in OUTPUTS:
        answer.as_numpy(output)


def measure(asked: argparse.Namespace) -> dict[str, list[dict[str, Any]]]:
    """Every table."""
    charges = np.random.default_rng(asked.seed).uniform(300.0, 1500.0, (1024, 3)).astype(np.float32)
    with ExitStack() as stack:
        servers = start(stack, asked.model)
        one = {name: (address, json_request(path, charges[:1])) for name, (address, path) in servers.items()}
        address, path = servers["isocharge"]
        client = stack.enter_context(tritonclient.http.InferenceServerClient("{}:{}".format(*address)))
        stock = partial(stock_infer, client, path.split("/")[3], charges)
        tables = {
            "one press, one request at a time": {name: asking(stack, *target) for name, target in one.items()},
            "1024 presses, plain socket": {
                name: asking(stack, address, make(path, charges)) for name, make in CODINGS.items()
            },
            "1024 presses, arrays in and out of the stock client": {
                name: partial(stock, binary=name == "binary") for name in CODINGS
            },
        }
        results = {
            title: in_turns([Contender(name, 1, call) for name, call in calls.items()], asked.seconds)
            for title, calls in tables.items()
        }
        rounds = [{name: throughput(*target, asked.seconds / 10) for name, target in one.items()} for _ in range(10)]
    results["32 connections"] = [
        {"call": name, "per_second": round(np.median([counts[name] for counts in rounds]))} for name in one
    ]
    return results


def main() -> None:
    asked = options(__doc__, seconds=10.0)
    print_results("http", asked, measure(asked))


if __name__ == "__main__":
    main()
