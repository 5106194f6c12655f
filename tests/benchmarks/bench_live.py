"""The live page's price: what viewers cost the reader, and how old a picture is.

A board of 1 kHz plays on a pseudo-terminal; `isocharge serve stream --live --record` follows it. Rounds without viewers
and rounds with three (one of which stalls) take turns in one run; each stream is a process of its own, as is the board
and the viewers. Reported: the reader's latency (last byte to record), the frames that the recording misses, the age of
the newest sample when a viewer has it.

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
from itertools import product
from pathlib import Path
from urllib.parse import urlsplit

import bench_stream
import numpy as np
from shared import arguments, percentiles, print_results

from isocharge.serve import Recording, Script, wander

SHARES = (50, 95, 99)
MODEL = "three-25um-biaxial"


def presses(rate_Hz):
    """A second of rest before every short press: a stream that begins at any time finds its tare in 2,000 frames."""
    scripts = [wander(seed=seed, seconds=1.0 + min(1.5, 1500 / rate_Hz), rate_Hz=rate_Hz) for seed in range(12)]
    columns = [np.concatenate([getattr(script, name) for script in scripts]) for name in ("x_mm", "y_mm", "force_N")]
    return Script(*columns, rate_Hz)


def watch(url, viewers, seconds, results):
    """Viewers in threads of a process of its own: ages of the newest sample, s. The first one reads no answers."""
    with ThreadPoolExecutor(viewers) as threads:
        ages = threads.map(lambda number: _watch(urlsplit(url).netloc, number == 0, seconds), range(viewers))
        results.send([age for viewer in ages for age in viewer])


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
def following(port, folder, name, *words):
    """A stream that follows the port and has its tare; the URL of its page."""
    said = folder / f"{name}.txt"
    command = [sys.executable, "-m", "isocharge.cli", "serve", "stream", MODEL, "--port", port, "--output", "none"]
    with said.open("w") as output:
        process = subprocess.Popen([*command, *words], stderr=output)
    try:
        while "tared" not in said.read_text():
            assert process.poll() is None, said.read_text()
            time.sleep(0.05)
        match = re.search(r"page: (\S+)", said.read_text())
        yield match[1] if match else ""
        assert process.poll() is None, said.read_text()
    finally:
        process.terminate()
        process.wait(30)


def one_round(port, viewers, seconds, folder, name):
    """Follow the port for a while: latencies (us), lost frames and ages (s)."""
    path, (ours, theirs) = folder / f"{name}.rec", multiprocessing.Pipe(duplex=False)
    words = ["--live", "127.0.0.1:0"] if viewers else []
    with following(port, folder, name, "--record", path, *words) as url:
        watching = multiprocessing.Process(target=watch, args=(url, viewers, seconds, theirs))
        if viewers:
            watching.start()
        time.sleep(seconds)
        ages = ours.recv() if viewers else []
    latencies = np.array([us for event in Recording(path).events() for us in event.latencies_us])
    lines = (json.loads(line) for line in path.open() if line.startswith('{"timestamp"'))
    seq = np.array([line["seq"] for line in lines])
    return latencies, int(((np.diff(seq) - 1) % 65536).sum()), ages


def main():
    options, results = arguments(__doc__, rounds=4, seconds=10.0, rate_Hz=1000.0, json=False), {}
    pipe, far = multiprocessing.Pipe()
    board = multiprocessing.get_context("spawn").Process(
        target=bench_stream.board, args=(far, 3, presses(options.rate_Hz), 0), daemon=True
    )
    board.start()
    port, p99 = pipe.recv(), {0: [], 3: []}
    with tempfile.TemporaryDirectory() as folder:
        for number, viewers in product(range(options.rounds), (0, 3)):
            name = f"round {number}, {viewers} viewers"
            latencies, lost, ages = one_round(port, viewers, options.seconds, Path(folder), name)
            p99[viewers].append(float(np.percentile(latencies, 99)))
            results[name] = {
                "latency_us": percentiles(latencies, SHARES),
                "records, lost": (len(latencies), lost),
                "age_ms": percentiles(1e3 * np.array(ages), SHARES),
            }
    ratios = np.array(p99[3]) / p99[0]
    results["p99 with three viewers over without, by round"] = ratios.round(2).tolist()
    pipe.send("enough")
    results["board"] = pipe.recv()
    board.join()
    print_results("live", options, results)


if __name__ == "__main__":
    main()
