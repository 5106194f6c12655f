"""A long run: 10 clients over HTTP and 6 over gRPC, every answer compared with that in process, memory watched.

    python tests/benchmarks/bench_soak.py [--requests 1000000] [--model NAME|PATH] [--seed 0] [--json]

Requests are JSON and binary, of one press and of three, drawn from 1000 that were made before; six of sixteen go over
gRPC. An answer must equal, bit for bit, what `Predictor` says of the same charges. Ten times the model is loaded anew
while all ask. Memory is the server's resident set, from the end of the first tenth to the end.
"""

import argparse
import itertools
import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import orjson
from bench_http import Connection, binary_request, free_port, http_request, json_request, running
from shared import options, print_results

from isocharge.serve import Predictor, find_model
from isocharge.serve.network.grpc.messages import METHODS, SERVICE

KINDS = 1000
ROUNDS = 10
HTTP_CLIENTS, GRPC_CLIENTS = 10, 6


def presses(predictor: Predictor, seed: int) -> list[np.ndarray]:
    """Charges of one press or of three, float32."""
    rng, width = np.random.default_rng(seed), len(predictor.metadata.electrodes)
    sizes = [1 if number % 4 else 3 for number in range(KINDS)]
    return [rng.uniform(100.0, 1500.0, (size, width)).astype(np.float32) for size in sizes]


def exchanges(predictor: Predictor, path: str, seed: int) -> list[tuple[bytes, bytes]]:
    """Requests, and the numbers that their answers must have, as bytes."""
    return [
        ((json_request if number % 2 else binary_request)(path, charges), _expected(predictor, charges))
        for number, charges in enumerate(presses(predictor, seed))
    ]


def _expected(predictor: Predictor, charges: np.ndarray) -> bytes:
    if len(charges) == 1:
        row = np.empty(10, np.float32)
        predictor.predict_into(charges[0], row)
        columns = row[np.newaxis]
    else:
        columns = np.column_stack(predictor.predict_batch(charges))
    return b"".join(columns[:, part].tobytes() for part in (slice(0, 3), slice(3, 6), slice(7, 10), slice(6, 7)))


def numbers_in(body: bytes) -> bytes:
    """The numbers of an answer, output by output, JSON or binary, as float32 bytes."""
    end = body.find(b"}}]}") + 4  # where the text before binary numbers ends, a brace of the numbers notwithstanding
    if end > 3:
        return body[end:]
    return b"".join(np.array(output["data"], np.float32).tobytes() for output in orjson.loads(body)["outputs"])


def resident_bytes(process: int) -> int:
    return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def ask_over_http(address: tuple[str, int], made: list[tuple[bytes, bytes]], count: int) -> None:
    """Ask and compare over an HTTP connection of its own."""
    with closing(Connection(address)) as connection:
        for request, expected in itertools.islice(itertools.cycle(made), count):
            got = numbers_in(connection.ask(request))
            if got != expected:
                raise RuntimeError(f"HTTP: expected {expected!r}, got {got!r}")


def ask_over_grpc(address: tuple[str, int], predictor: Predictor, count: int, seed: int) -> None:
    """Ask and compare over a gRPC connection of its own."""
    request_type, response_type = METHODS["ModelInfer"]
    made = []
    for charges in presses(predictor, seed):
        tensor = {"name": "charge_pC", "datatype": "FP32", "shape": list(charges.shape)}
        name = predictor.metadata.name
        request = request_type(model_name=name, inputs=[tensor], raw_input_contents=[charges.tobytes()])
        made.append((request, _expected(predictor, charges)))
    with grpc.insecure_channel("{}:{}".format(*address), [("grpc.use_local_subchannel_pool", 1)]) as channel:
        infer = channel.unary_unary(
            f"/{SERVICE}/ModelInfer",
            request_serializer=request_type.SerializeToString,
            response_deserializer=response_type.FromString,
        )
        for request, expected in itertools.islice(itertools.cycle(made), count):
            got = b"".join(infer(request, timeout=60).raw_output_contents)
            if got != expected:
                raise RuntimeError(f"gRPC: expected {expected!r}, got {got!r}")


def measure(asked: argparse.Namespace) -> dict[str, Any]:
    """Run it all, in rounds."""
    folder, address, grpc_address = find_model(asked.model).resolve(), *(("127.0.0.1", free_port()) for _ in range(2))
    predictor, memory = Predictor(folder), []
    path, name = f"/v2/models/{predictor.metadata.name}/infer", predictor.metadata.name
    count, made = asked.requests // (ROUNDS * (HTTP_CLIENTS + GRPC_CLIENTS)), exchanges(predictor, path, asked.seed)
    clients = [partial(ask_over_http, address, made[first:] + made[:first], count) for first in range(HTTP_CLIENTS)]
    clients += [partial(ask_over_grpc, grpc_address, Predictor(folder), count, seed) for seed in range(GRPC_CLIENTS)]
    command = [Path(sys.executable).with_name("isocharge"), "serve", "http", "--models", folder.parents[1]]
    command += ["--port", str(address[1]), "--grpc-port", str(grpc_address[1])]
    with ThreadPoolExecutor(len(clients)) as threads, running(command, address) as process:
        begin = time.perf_counter()
        for _ in range(ROUNDS):
            asking = [threads.submit(client) for client in clients]
            with closing(Connection(address)) as connection:
                connection.ask(http_request(f"/v2/repository/models/{name}/load", b""))
            for one in asking:
                one.result()
            memory.append(resident_bytes(process.pid))
        seconds = time.perf_counter() - begin
    return {
        "requests": count * ROUNDS * len(clients),
        "over_grpc": count * ROUNDS * GRPC_CLIENTS,
        "clients": len(clients),
        "answers_equal": "all, bit for bit",
        "loads_meanwhile": ROUNDS,
        "seconds": round(seconds, 1),
        "memory_MB": round(memory[-1] / 1e6, 2),
        "memory_growth_MB": round((memory[-1] - memory[0]) / 1e6, 2),
    }


def main() -> None:
    asked = options(__doc__, requests=1_000_000)
    print_results("soak", asked, measure(asked))


if __name__ == "__main__":
    main()
