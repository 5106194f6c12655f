"""Commands whose stdin, stdout or stderr is closed, full, or read by somebody slow."""

import json
import os
import signal
import subprocess
import sys
import time
from itertools import pairwise

import pytest

from boards import TcpBoard, taps
from isocharge.serve import Recording

pytestmark = pytest.mark.xdist_group("clock")

ISOCHARGE = f"{sys.executable} -m isocharge.cli"


def bash(script, **environment):
    done = subprocess.run(
        ["bash", "-c", script], env=os.environ | environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    return done


@pytest.mark.parametrize("words", ["predict linear {presses}", "stream linear --port {frames} --record {record}"])
def test_a_closed_stdout_is_told(models, presses, frames, tmp_path, words):
    """And no file that is opened later gets its place."""
    record = tmp_path / "touch.rec"
    words = words.format(presses=presses, frames=frames, record=record)
    done = bash(f"{ISOCHARGE} serve {words} --models {models} >&-")
    assert (done.returncode, "OutputError: stdout is closed" in done.stderr) == (1, True)
    assert not record.exists() or Recording(record).model == "linear/1"


def test_a_closed_stdin_is_empty(models):
    done = bash(f"{ISOCHARGE} serve predict linear - --models {models} <&-")
    assert (done.returncode, "stdin: empty" in done.stderr) == (2, True)


def test_a_closed_stderr_changes_nothing(models, presses):
    done = bash(f"{ISOCHARGE} serve predict linear {presses} --models {models} 2>&-")
    assert (done.returncode, done.stdout.count("\n")) == (0, 3)


@pytest.mark.parametrize("streams", [">/dev/full 2>/dev/full", ">&- 2>&-"])
def test_a_server_whose_streams_are_full_serves(models, tmp_path, streams):
    path = tmp_path / "touch.sock"
    process = subprocess.Popen(["bash", "-c", f"exec {ISOCHARGE} serve http --models {models} --uds {path} {streams}"])
    try:
        end = time.monotonic() + 60
        answer = ""
        while answer != '{"live":true}' and time.monotonic() < end:
            time.sleep(0.1)
            answer = bash(f"curl -s --unix-socket {path} http://x/v2/health/live").stdout
        assert answer == '{"live":true}'
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0
    finally:
        process.kill()
        process.wait()


def test_an_empty_token_is_refused(models):
    """As `--token ''` is: whoever sets it means to have one."""
    done = bash(f"{ISOCHARGE} serve http --models {models} --port 0", ISOCHARGE_TOKEN="")
    assert (done.returncode, "token: expected printable ASCII" in done.stderr) == (2, True)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("A,B,C\n1,2,1_0\n", "expected a charge in pC"),
        ("A,B,C\n1,2,\u0663\n", "expected a charge in pC"),
        ("A,B,C\n" + "1," * 3_000_000, "line 2"),
        (",".join(f"column{number}" for number in range(40_000)) + "\n" + "1," * 39_999 + "1\n", "expected"),
    ],
    ids=["underscore", "digit of another script", "line without end", "columns without end"],
)
def test_a_table_that_is_refused_shortly(command, models, tmp_path, text, said):
    path = tmp_path / "presses.csv"
    path.write_text(text)
    code, out, err = command("serve", "predict", "linear", path, "--models", models)
    assert (code, out, said in err, len(err) < 2000) == (2, "", True, True)


def peak_bytes(script):
    """Largest resident set of a command."""
    program = f"import resource, subprocess; subprocess.run({script!r}, shell=True, check=True); " + (
        "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024)"
    )
    return int(subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout)


@pytest.mark.slow
@pytest.mark.parametrize("output", ["", "--json"])
def test_memory_of_a_long_table(models, presses, tmp_path, output):
    """200,000 rows cost some 15 MB; as lists of lists they cost ten times as much."""
    long = tmp_path / "long.csv"
    long.write_text("A,B,C\n" + "800.25,700.125,900.5\n" * 200_000)
    command = f"{ISOCHARGE} serve predict linear {{}} --models {models} {output} > /dev/null"
    assert peak_bytes(command.format(long)) - peak_bytes(command.format(presses)) < 50e6


def test_a_slow_reader_stops_neither_chain_nor_recording(models, film, tmp_path, start):
    """It takes nothing at first: what it missed is counted, and the recording has everything."""
    recording, count = tmp_path / "touch.rec", 16_000
    with TcpBoard(taps(film), rate_Hz=5000.0) as board:
        process = start(
            *("stream", "linear", "--port", board.url, "--models", models, "--record", recording, "--count", count)
        )
        lines, end = [process.stdout.readline()], time.monotonic() + 120
        while recording.read_bytes().count(b'"seq"') < 11_500 and time.monotonic() < end:
            time.sleep(0.1)  # more than the queue and the pipe hold
        out, err = process.stdout.read(), process.stderr.read()
        assert process.wait(60) == 0, err
    recorded = [json.loads(line)["seq"] for line in recording.read_text().splitlines() if '"seq"' in line]
    assert [after - before for before, after in pairwise(recorded)] == [1] * (count - 1)
    lines = [json.loads(line) for line in [*lines, *out.splitlines()]]
    lost = int(err.split(" records not written")[0].rpartition("; ")[2])
    assert len(lines) + lost == count
    assert lost > 0
    assert lines[-1]["seq"] == recorded[-1]  # the newest are there, the oldest are not


def test_a_reader_who_never_reads_does_not_keep_the_stream(models, board, start):
    process = start("stream", "linear", "--port", board.url, "--models", models, "--seconds", 2)
    assert process.wait(60) == 0
    assert "records not written, the oldest" in process.stderr.read()


def test_a_file_waits_for_a_slow_reader(models, frames):
    """Nothing is lost of a file, however slow the reader is."""
    script = f"{ISOCHARGE} serve stream linear --port {frames} --models {models} | (sleep 1; wc -l)"
    assert bash(script).stdout == "300\n"
