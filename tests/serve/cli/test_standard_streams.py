"""Commands whose stdin, stdout or stderr is closed, full, or read by somebody slow."""

import json
import os
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import pytest

from isocharge.serve import Recording, VirtualSensor, wander

ISOCHARGE = f"{sys.executable} -m isocharge.cli"


def bash(script, timeout=60, **environment):
    done = subprocess.run(
        ["bash", "-c", script],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    return done


@pytest.fixture
def presses(tmp_path):
    path = tmp_path / "presses.csv"
    path.write_text("A,B,C\n800,700,900\n")
    return path


@pytest.fixture
def frames(tmp_path):
    """Lines of text at rest."""
    path = tmp_path / "frames.txt"
    path.write_text("seq,A,B,C\n" + "".join(f"{seq},1.0,2.0,{3 + seq % 2}\n" for seq in range(300)))
    return path


@pytest.mark.parametrize("words", ["predict linear presses.csv", "stream linear --port frames.txt"])
def test_a_closed_stdout_is_told(models, presses, frames, words):
    """And no file that is opened later gets its place."""
    words = words.replace("presses.csv", str(presses)).replace("frames.txt", str(frames))
    record = f"--record {frames.parent}/touch.rec" if "stream" in words else ""
    done = bash(f"{ISOCHARGE} serve {words} --models {models} {record} >&-")
    assert done.returncode == 1
    assert "OutputError: stdout is closed" in done.stderr
    if record:
        assert Recording(frames.parent / "touch.rec").model == "linear/1"


def test_a_closed_stdin_is_empty(models):
    done = bash(f"{ISOCHARGE} serve predict linear - --models {models} <&-")
    assert (done.returncode, "stdin: empty" in done.stderr) == (2, True)


def test_a_closed_stderr_changes_nothing(models, presses):
    done = bash(f"{ISOCHARGE} serve predict linear {presses} --models {models} 2>&-")
    assert (done.returncode, done.stdout.count("\n")) == (0, 2)
    assert bash(f"{ISOCHARGE} serve predict linear {presses}x --models {models} 2>&-").returncode == 2


@pytest.mark.parametrize("streams", [">/dev/full 2>/dev/full", ">&- 2>&-", ">/dev/full 2>&1"])
def test_a_server_whose_streams_are_full_serves(models, tmp_path, streams):
    path = tmp_path / "touch.sock"
    process = subprocess.Popen(["bash", "-c", f"exec {ISOCHARGE} serve http --models {models} --uds {path} {streams}"])
    try:
        end = time.monotonic() + 30
        while not path.exists() and time.monotonic() < end:
            time.sleep(0.1)
        time.sleep(0.5)
        assert process.poll() is None
        answer = bash(f"curl -s --unix-socket {path} http://x/v2/health/live").stdout
        assert answer == '{"live":true}'
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 0
    finally:
        process.kill()
        process.wait()


def test_an_empty_token_is_refused(models):
    """As `--token ''` is: whoever sets it means to have one."""
    for words, environment in (("--token ''", {}), ("", {"ISOCHARGE_TOKEN": ""})):
        done = bash(f"{ISOCHARGE} serve http --models {models} --port 0 {words}", **environment)
        assert (done.returncode, "token: expected printable ASCII" in done.stderr) == (2, True)


@pytest.mark.timeout(60)
def test_a_table_of_unknown_columns_is_refused_shortly(models, tmp_path):
    path = tmp_path / "wide.csv"
    path.write_text(",".join(f"column{number}" for number in range(40_000)) + "\n" + "1," * 39_999 + "1\n")
    began = time.monotonic()
    done = bash(f"{ISOCHARGE} serve predict linear {path} --models {models}")
    assert time.monotonic() - began < 10
    assert (done.returncode, len(done.stderr) < 2000) == (2, True)
    assert "expected at most 100,000 characters" in done.stderr


@pytest.mark.parametrize("cell", ["1_0", "\u0663", "\uff11", "0x1"])
def test_cells_that_are_no_numbers(command, models, tmp_path, cell):
    path = tmp_path / "presses.csv"
    path.write_text(f"A,B,C\n1,2,{cell}\n")
    code, out, err = command("serve", "predict", "linear", path, "--models", models)
    assert (code, out, "expected a charge in pC" in err) == (2, "", True)


def test_a_line_without_end(command, models, tmp_path):
    path = tmp_path / "presses.csv"
    path.write_text("A,B,C\n" + "1," * 3_000_000)
    code, out, err = command("serve", "predict", "linear", path, "--models", models)
    assert (code, out, len(err) < 1000) == (2, "", True)


def peak_bytes(script):
    """Largest resident set of a command."""
    program = f"import resource, subprocess; subprocess.run({script!r}, shell=True, check=True); " + (
        "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024)"
    )
    return int(subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout)


@pytest.mark.parametrize("output", ["", "--json"])
def test_memory_of_a_long_table(models, presses, tmp_path, output):
    """200,000 rows cost some 15 MB; as lists of lists they cost ten times as much."""
    long = tmp_path / "long.csv"
    long.write_text("A,B,C\n" + "800.25,700.125,900.5\n" * 200_000)
    command = f"{ISOCHARGE} serve predict linear {{}} --models {models} {output} > /dev/null"
    assert peak_bytes(command.format(long)) - peak_bytes(command.format(presses)) < 50e6


def test_a_slow_reader_stops_neither_chain_nor_recording(models, film, tmp_path):
    """It takes nothing for seconds: what it missed is counted, and the recording has everything."""
    recording, words = tmp_path / "touch.rec", tmp_path / "stderr"
    with VirtualSensor(film.charges, wander(seed=2, seconds=60.0, rate_Hz=2000.0)) as sensor:
        command = f"{ISOCHARGE} serve stream linear --port {sensor.url} --models {models} --record {recording}"
        with (
            words.open("w") as err,
            subprocess.Popen(
                [*command.split(), "--count", "18000"], stdout=subprocess.PIPE, stderr=err, text=True
            ) as process,
        ):
            first = process.stdout.readline()
            end = time.monotonic() + 30
            while recording.stat().st_size < 8.5e6 and time.monotonic() < end:
                time.sleep(0.1)  # some 14,000 records, more than the queue and the pipe hold
            out = process.stdout.read()
        said = words.read_text()
    assert process.returncode == 0, said
    recorded = [record for line in recording.read_text().splitlines() if "seq" in (record := json.loads(line))]
    assert len(recorded) == 18000
    steps = [(b["seq"] - a["seq"]) % 65536 for a, b in pairwise(recorded)]
    assert sum(steps) - len(steps) < 2000  # what a port loses on a busy machine; a chain that waits loses all the rest
    lines = [json.loads(line) for line in [first, *out.splitlines()]]
    lost = int(said.split(" records not written")[0].rpartition("; ")[2])
    assert len(lines) + lost == 18000
    assert lost > 0
    assert lines[-1]["seq"] == recorded[-1]["seq"]  # the newest are there, the oldest are not


def test_a_reader_who_never_reads_does_not_keep_the_stream(models, film):
    with VirtualSensor(film.charges, wander(seed=2, seconds=30.0, rate_Hz=2000.0)) as sensor:
        process = subprocess.Popen(
            f"{ISOCHARGE} serve stream linear --port {sensor.url} --models {models} --seconds 2".split(),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert process.wait(30) == 0
        assert "records not written, the oldest" in process.stderr.read()
        process.stdout.close()
        process.stderr.close()


def test_a_file_waits_for_a_slow_reader(models, frames):
    """Nothing is lost of a file, however slow the reader is."""
    script = f"{ISOCHARGE} serve stream linear --port {frames} --models {models} | (sleep 1; wc -l)"
    whole = bash(f"{ISOCHARGE} serve stream linear --port {frames} --models {models} | wc -l").stdout
    assert bash(script).stdout == whole
    assert Path(frames).exists()
