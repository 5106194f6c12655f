"""The age of the newest sample when a viewer of the live page has it.

A board of 1 kHz plays on a pseudo-terminal, and `isocharge serve stream --live` follows it in a process of its own, as
is the board. Three viewers read the samples, of which one stalls. The reported age is that of the newest sample in each
answer.

    python tests/benchmarks/bench_live.py --rounds 4 --seconds 10 [--rate-hz 1000]
"""

import http.client
import json
import multiprocessing
import re
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import bench_stream
import numpy as np
from shared import arguments, percentiles, print_results

from isocharge.serve import Script, wander

MODEL = "three-25um-biaxial"


def presses(rate_Hz):
    """A second of rest before every short press: a stream that begins at any time finds its tare in 2,000 frames."""
    scripts = [wander(seed=seed, seconds=1.0 + min(1.5, 1500 / rate_Hz), rate_Hz=rate_Hz) for seed in range(12)]
    columns = [np.concatenate([getattr(script, name) for script in scripts]) for name in ("x_mm", "y_mm", "force_N")]
    return Script(*columns, rate_Hz)


def watch(url, viewers, seconds):
    """Ages of the newest sample at viewers in threads, s. The first viewer reads no answers."""
    with ThreadPoolExecutor(viewers) as threads:
        ages = threads.map(lambda number: _watch(urlsplit(url).netloc, number == 0, seconds), range(viewers))
        return np.array([age for viewer in ages for age in viewer])


def _watch(place, stalls, seconds):
    client, ages, first, end = http.client.HTTPConnection(place), [], None, time.monotonic() + seconds
    while time.monotonic() < end:
        client.request("POST", "/request", json.dumps({"do": "read", "first": first}))
        if stalls:
            time.sleep(seconds)
            break
        answer = json.load(client.getresponse())
        first = answer["first"]
        ages += [time.time() - sample[0] for sample in answer["samples"][-1:]]
        time.sleep(1 / 60)  # a picture
    client.close()
    return ages


@contextmanager
def following(port, folder):
    """A stream with a live page that follows the port and has its tare; the URL of its page."""
    said = folder / "said.txt"
    command = [sys.executable, "-m", "isocharge.cli", "serve", "stream", MODEL, "--port", port, "--output", "none"]
    with said.open("w") as output:
        process = subprocess.Popen([*command, "--live", "127.0.0.1:0"], stderr=output)
    try:
        while "tared" not in said.read_text():
            assert process.poll() is None, said.read_text()
            time.sleep(0.05)
        yield re.search(r"page: (\S+)", said.read_text())[1]
        assert process.poll() is None, said.read_text()
    finally:
        process.terminate()
        process.wait(30)


def main():
    options, results = arguments(__doc__, rounds=4, seconds=10.0, rate_Hz=1000.0), {}
    pipe, far = multiprocessing.Pipe()
    board = multiprocessing.get_context("spawn").Process(
        target=bench_stream.board, args=(far, 3, presses(options.rate_Hz), 0), daemon=True
    )
    board.start()
    port = pipe.recv()
    with tempfile.TemporaryDirectory() as folder:
        for number in range(options.rounds):
            with following(port, Path(folder)) as url:
                ages_s = watch(url, 3, options.seconds)
            results[f"round {number}, age in ms"] = percentiles(1e3 * ages_s, (50, 95, 99))
    pipe.send("enough")
    results["board"] = pipe.recv()
    board.join()
    print_results("live", options, results)


if __name__ == "__main__":
    main()
