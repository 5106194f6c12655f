"""The live page's price: what viewers cost the reader, and how old a picture is.

A board of 1 kHz plays on a pseudo-terminal; `isocharge serve stream --live --record` follows it. Rounds without viewers
and rounds with three (one of which stalls) take turns in one run; each stream is a process of its own, as is the board
and the viewers. Reported: the reader's latency (last byte to record), the frames that the recording misses, the age of
the newest sample when a viewer has it. With --browser, headless Chromium is one of the viewers and says how old its
pictures are and how many a second it draws.

    python tests/benchmarks/bench_live.py --rounds 4 --seconds 10 [--browser] [--rate-hz 1000]
"""

import asyncio
import json
import multiprocessing
import os
import re
import struct
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path

import bench_stream
import numpy as np
from shared import arguments, percentiles
from websockets.asyncio.client import connect

from isocharge.serve import Predictor, Recording, Script, wander
from isocharge.serve.viewer.messages import HEADER, SampleFormat

SHARES = (50, 95, 99)
MODEL = "three-25um-biaxial"
CHROMIUM = "/usr/bin/chromium"
ARGUMENTS = [
    *("--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-sync"),
    *("--disable-component-update", "--disable-gpu", "--enable-unsafe-swiftshader"),
]


def presses(rate_Hz):
    """A second of rest before every short press: a stream that begins at any time finds its tare in 2,000 frames."""
    scripts = [wander(seed=seed, seconds=1.0 + min(1.5, 1500 / rate_Hz), rate_Hz=rate_Hz) for seed in range(12)]
    columns = [np.concatenate([getattr(script, name) for script in scripts]) for name in ("x_mm", "y_mm", "force_N")]
    return Script(*columns, rate_Hz)


def watch(url, electrodes, stalls, seconds, results):
    """A viewer by the stock client, in a process of its own: ages of the newest sample, s."""
    results.send(asyncio.run(_watch(url, SampleFormat(electrodes), stalls, seconds)))


async def _watch(url, form, stalls, seconds):
    ages = []
    async with connect(url.replace("http", "ws", 1) + "/live") as client:
        if stalls:
            client.transport.pause_reading()
            await asyncio.sleep(seconds)
            client.transport.abort()  # a stalled client would not take part in closing, either
            return ages
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            data = await client.recv()
            if isinstance(data, bytes):
                rows = np.frombuffer(data, form.dtype, offset=HEADER.size)
                if len(rows):
                    ages.append(time.time() - float(rows["timestamp"][-1]))
                await asyncio.sleep(1 / 60)  # a picture
                await client.send(struct.pack("<I", HEADER.unpack_from(data)[3]))
    return ages


def browse(url, seconds):
    """Chromium's view: ages of its pictures (ms), and pictures a second."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        page = browser.new_page(viewport={"width": 1280, "height": 820})
        page.goto(url)
        page.wait_for_timeout(3000)
        page.evaluate("isocharge.page.ages.length = 0")
        page.wait_for_timeout(1e3 * seconds)
        ages = page.evaluate("isocharge.page.ages")
        rate = page.evaluate("(({starts: s}) => 1000 * (s.length - 1) / (s.at(-1) - s[0]))(isocharge.page)")
        browser.close()
    return ages, rate


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


@contextmanager
def watched(url, viewers, seconds):
    """Viewers for a while, the first of which stalls; the list has the ages of what the others saw after the block."""
    ages, electrodes, watching = [], Predictor(MODEL).metadata.electrodes, []
    for k in range(viewers):
        ours, theirs = multiprocessing.Pipe(duplex=False)
        process = multiprocessing.Process(target=watch, args=(url, electrodes, k == 0, seconds, theirs))
        process.start()
        watching.append((process, ours))
    yield ages
    for process, result in watching:
        ages += result.recv() if result.poll(20) else []
        process.join()


def one_round(port, viewers, seconds, folder, name, in_browser):
    """Follow the port for a while: latencies (us), lost frames, ages (s), and what the browser says."""
    path = folder / f"{name}.rec"
    words = ["--live", "127.0.0.1:0"] if viewers else []
    with (
        following(port, folder, name, "--record", path, *words) as url,
        watched(url, viewers - in_browser, seconds) as ages,
    ):
        browsed = browse(url, seconds) if in_browser else time.sleep(seconds)
    latencies = np.array([us for event in Recording(path).events() for us in event.latencies_us])
    lines = (json.loads(line) for line in path.open() if line.startswith('{"timestamp"'))
    seq = np.array([line["seq"] for line in lines])
    return latencies, int(((np.diff(seq) - 1) % 65536).sum()), ages, browsed


def main():
    options = arguments(__doc__, rounds=4, seconds=10.0, rate_Hz=1000.0, browser=False)
    context = multiprocessing.get_context("spawn")
    pipe, far = context.Pipe()
    board = context.Process(target=bench_stream.board, args=(far, 3, presses(options.rate_Hz), 0), daemon=True)
    board.start()
    port, p99 = pipe.recv(), {0: [], 3: []}
    print(
        f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, {options.rate_Hz:g} Hz, {options.seconds:g} s a round"
    )
    with tempfile.TemporaryDirectory() as name:
        for number in range(options.rounds):
            for viewers in (0, 3) if number % 2 == 0 else (3, 0):
                in_browser = options.browser and viewers > 0
                latencies, lost, ages, browsed = one_round(
                    port, viewers, options.seconds, Path(name), f"{number}-{viewers}", in_browser
                )
                p99[viewers].append(float(np.percentile(latencies, 99)))
                print(
                    f"round {number}, {viewers} viewers: latency us {percentiles(latencies, SHARES)}; "
                    f"{len(latencies)} records, {lost} lost; age ms {percentiles(1e3 * np.array(ages), SHARES)}"
                )
                if browsed is not None:
                    print(
                        f"  Chromium: age of a picture ms {percentiles(browsed[0], SHARES)}, {browsed[1]:.1f} a second"
                    )
    ratios = np.array(p99[3]) / np.array(p99[0])
    spread = f"median {np.median(ratios):.2f}, {ratios.min():.2f} to {ratios.max():.2f}"
    print(f"p99 with three viewers over without: {spread}")
    pipe.send("enough")
    played = pipe.recv()
    print(f"board: {played['sent']} frames sent, {played['withheld']} withheld while nobody followed")
    board.join()


if __name__ == "__main__":
    main()
