"""The live path over a pseudo-terminal: frames lost and repeated, how long a record takes, and how much of a core.

    python tests/benchmarks/bench_stream.py [--model NAME|PATH] [--seconds 60] [--rate-hz 1000]

The virtual sensor plays in a process of its own; the reader's processor time is its own alone, all stages of the signal
chain on, each record turned into a line of JSON. The latency is that of the record itself: from the arrival of the last
byte. Every electrode has 800 pC/N: nothing here depends on what the model answers.
"""

import multiprocessing
import time
from dataclasses import asdict
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from shared import options, percentiles, print_results

from isocharge.serve import Port, Predictor, Script, TouchStream, VirtualSensor, device_from_table, wander
from isocharge.simulate import noise_model

BOARD = {
    "gain": {"pC_per_unit": 1.0},
    "saturation": {"limit_pC": 1e5},
    "hum": {"frequency_Hz": 50.0},
    "leak": {"tau_s": 1e6},
}


def board(pipe: Connection, electrodes: int, script: Script, seed: int) -> None:
    """Play until the other end says so; then tell what was played."""

    def charges(contact: np.ndarray) -> np.ndarray:
        return 800.0 * np.repeat(contact[:, 2:], electrodes, axis=1)

    with VirtualSensor(charges, script, noise=noise_model("reference").add, seed=seed) as sensor:
        pipe.send(sensor.url)
        pipe.recv()
    pipe.send({name: getattr(sensor, name) for name in ("sent", "withheld")})


def play(predictor: Predictor, seconds: float, rate_Hz: float, seed: int) -> dict[str, Any]:
    """Follow a virtual sensor for a while."""
    pipe, far = multiprocessing.Pipe()
    script = wander(seed=seed, seconds=60.0, rate_Hz=rate_Hz)
    process = multiprocessing.get_context("spawn").Process(
        target=board, args=(far, len(predictor.metadata.electrodes), script, seed)
    )
    process.start()
    path, latencies = TouchStream(predictor, device_from_table(BOARD, "bench")), []
    with Port(pipe.recv(), reconnect=True) as port:
        began, used = time.perf_counter(), time.process_time()
        for chunk in port:
            for record in path.feed(chunk):
                record.to_json()
                latencies.append(record.latency_us)
            if time.perf_counter() - began >= seconds:
                break
        wall, used = time.perf_counter() - began, time.process_time() - used
    pipe.send("enough")
    played = pipe.recv()
    process.join()
    return asdict(path.parser.counts) | {
        "board": played,
        "last_byte_to_record_us": percentiles(latencies, (50, 99, 99.9)),
        "core_share": round(used / wall, 3),
    }


def main() -> None:
    asked = options(__doc__, seconds=60.0, rate_Hz=1000.0)
    print_results("stream", asked, play(Predictor(asked.model), asked.seconds, asked.rate_Hz, asked.seed))


if __name__ == "__main__":
    main()
