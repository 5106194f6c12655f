"""The commands as a user and a script meet them: data on stdout, words on stderr, a clean end.

Commands whose stdin, stdout or stderr is closed, full, or read by somebody slow.
"""

import json
import os
import re
import shlex
import signal
import sys
import threading
import time
from itertools import chain, pairwise

import numpy as np
import pytest
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from boards import TcpBoard, interrupt, taps
from isocharge.serve import Recording, Script, VirtualSensor, load_device
from isocharge.serve.signal_chain.channels import GainRule
from isocharge.serve.virtual_sensor.sensor import PseudoPort
from processes import finished


def records_of(text):
    return [json.loads(line) for line in text.splitlines()]


def test_predict_from_stdin_and_from_a_file_of_measured_presses(presses, models, run):
    """A byte order mark and the line ends of Windows are passed over; further columns are named on stderr."""
    expected = run("predict", "linear", presses, "--models", models).stdout
    contacts = np.loadtxt(expected.splitlines()[1:], delimiter=",", usecols=(0, 1, 2))
    np.testing.assert_allclose(contacts, [[1, 0.5, 1], [-2, 3, 0.25]], atol=5e-6)
    text = b"\xef\xbb\xbf" + presses.read_bytes().replace(b"\n", b"\r\n") + b"\r\n"
    assert run("predict", "linear", "-", "--models", models, stdin=text).stdout == expected
    header, *rows = presses.read_text().splitlines()
    presses.write_text("\n".join(["x_mm,y_mm,force_N," + header, *(f"1,,2,{row}" for row in rows)]))
    result = run("predict", "linear", presses, "--models", models)
    assert (result.stdout, "ignored columns" in result.stderr) == (expected, True)


@pytest.fixture
def measured(tmp_path, film):
    """Write presses of the linear film, their forces read on a scale with an error of its own."""

    def write(*, scale=1.0, count=6, known="x_mm,y_mm,force_N"):
        contact = np.random.default_rng(1).uniform([-4.0, -4.0, 0.2], [4.0, 4.0, 1.5], (count, 3))
        first_known = 2 if known == "force_N" else 0
        read_contact = contact[:, first_known:] * [1.0, 1.0, scale][first_known:]
        path = tmp_path / "measured.csv"
        table = np.column_stack([read_contact, film.charges(contact), np.ones(count)])
        np.savetxt(path, table, delimiter=",", header=f"{known},A,B,C,day", comments="")
        return path

    return write


def test_check_options_position_std_and_force_std(measured, models, command):
    words = ["serve", "check", "linear", measured(scale=0.97), "--models", models, "--json"]
    assert [command(*words, "--force-std", share)[0] for share in (0.01, 0.05)] == [1, 0]
    values = json.loads(command(*words, "--position-std", "0.4", "--force-std", "0.05")[1])
    assert (values["position_mm"]["rig"], values["force_percent"]["rig"]) == pytest.approx((0.4 * 2**0.5, 5.0))
    assert values["model"] == "linear/1"


def test_check_of_many_presses_shows_the_worst(measured, models, command):
    """Of forces that are off by the same share these are the largest, for their noise is the least share."""
    words = ["serve", "check", "linear", measured(count=100, known="force_N", scale=0.97), "--models", models]
    _, out, err = command(*words)
    assert "ignored columns: ['day']" in err
    assert "the table has the 40 worst of 100 presses; --json has all" in err
    values = json.loads(command(*words, "--json")[1])
    worst = sorted(sorted(values["each"], key=lambda row: row["force_N"])[-40:], key=lambda row: row["line"])
    form = "{line} {x_mm:.5g} {y_mm:.5g} {force_N:.5g} - {force_error_percent:.5g} none -"
    assert [" ".join(line.split()) for line in out.splitlines()[2:42]] == [form.format(**row) for row in worst]
    assert values["chi_squared_per_degree"] == pytest.approx(values["chi_squared"] / 100)
    assert values["force_scale"] == pytest.approx(1.0 / 0.97, rel=1e-4)
    for name in ("chi_squared_per_degree", "force_scale"):
        assert re.search(rf"{name} +{values[name]:.5g}\n", out)
    assert "position_mm" not in out


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("check linear measured.csv --force-std 0", "Invalid value for '--force-std'"),
        ("check linear measured.csv --position-std nan", "Invalid value for '--position-std'"),
        ("stream linear --port frames.csv --device leak.toml", "expected a column t_ms, t_us or t_s"),
        ("stream linear --port frames.csv --track", "expected a column t_ms, t_us or t_s"),
        ("stream linear --port frames.csv --device currents.toml", "expected a column t_ms, t_us or t_s"),
        ("stream linear --port p --name ''", "--name: expected printable characters"),
        ("stream linear --port p --name 'a\nb'", "--name: expected printable characters"),
        ("doctor --port p --device gain.toml --pc-per-unit 1000", "--pc-per-unit: expected none beside --device"),
        ("doctor --port p --device gain.toml --request 3F", "--request: expected none beside --device"),
        ("doctor --port p --pc-per-unit much", "expected a number like 0.0457, or A=0.0457,B=-0.0457, got 'much'"),
        ("doctor --port p --pc-per-unit A=1,B", "--pc-per-unit: expected a number"),
        ("doctor --port p --pc-per-unit 0", "--pc-per-unit: gain.pC_per_unit: expected a finite number that is not 0"),
        ("doctor --port p --request ?", "--request: frames.request: expected bytes in hexadecimal, as in '20 4E'"),
    ],
)
def test_wrong_options_are_refused_with_the_reason(measured, models, refused, monkeypatch, line, message):
    """A file without times has no leak, and the device file already states the charge of a unit."""
    path = measured()
    path.with_name("leak.toml").write_text("[leak]\ntau_s = 5.0\n")
    path.with_name("currents.toml").write_text('front_end = "current"\n')
    path.with_name("frames.csv").write_text("A,B,C\n" + "1,2,3\n" * 200)
    path.with_name("gain.toml").write_text("[gain]\npC_per_unit = 2.0\n")
    monkeypatch.chdir(path.parent)
    monkeypatch.setenv("ISOCHARGE_MODELS", str(models))
    refused("serve", *shlex.split(line), message=message)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stream_ends_cleanly_at_sigint_and_sigterm(board_until, stream, number):
    with board_until(lambda: interrupt(number)) as board:
        result = stream(board.url)
    assert len(records_of(result.stdout)) > 0
    assert " frames, 0 lost" in result.stderr.splitlines()[-1]


def test_stream_ends_cleanly_when_the_pipe_closes(board, start_stream):
    process = start_stream(board.url)
    process.stdout.readline()
    process.stdout.close()
    assert process.wait(timeout=60) == 0
    assert "Error" not in process.stderr.read()


@pytest.mark.parametrize(("stop", "exit_code"), [(("--seconds", 0.2), 1), ((), 0)])
def test_stream_that_waits_for_its_port_can_be_stopped(tmp_path, stream, stop, exit_code):
    ctrl_c = threading.Timer(0.3, interrupt)
    if not stop:
        ctrl_c.start()
    result = stream(tmp_path / "film", "--output", tmp_path / "x.csv", "--wait", 30, *stop)
    assert result.exit_code == exit_code
    assert f"{tmp_path / 'film'}: the command was stopped before the port was open" in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_stream_writes_a_record_for_each_frame_and_replay_repeats_them_at_their_pace(
    board, models, tmp_path, stream, run
):
    path = tmp_path / "touch.rec"
    streamed = stream(board.url, "--record", path, "--name", "left, \u00fc", "--count", 1000)
    records = records_of(streamed.stdout)
    assert {record["frame_id"] for record in records} == {"left, \u00fc"}
    assert [record["seq"] - records[0]["seq"] for record in records] == list(range(1000))
    pressed = [(r["x_mm"], r["y_mm"], r["force_N"]) for r in records if r["contact"]]
    np.testing.assert_allclose(pressed, np.tile([3.0, -2.0, 1.0], (len(pressed), 1)), atol=0.05)
    assert streamed.stderr.count("tared: A ") == 1
    assert "0 lost, 0 repeated, 0 restarts, 0 crc errors, 0 malformed" in streamed.stderr.splitlines()[-1]
    began = time.monotonic()
    assert run("replay", path, "--real-time", "--models", models).stdout == streamed.stdout
    assert time.monotonic() - began > 0.2  # 50 chunks of 10 ms


def test_stream_that_ends_without_a_tare_says_why(stream):
    with TcpBoard([(300.0, 1.0, 2.0)] * 150) as board:
        streamed = stream(board.url, "--seconds", 1)
    assert '"flags": []' not in streamed.stdout
    assert "caution: no tare" in streamed.stderr
    assert "A 300.00 pC, B 1.00 pC, C 2.00 pC" in streamed.stderr


def test_sigusr1_requests_a_new_tare(stream):
    rest = lambda level, count: [(level, level + 1.0, level + 2.0)] * count  # noqa: E731
    signals = (interrupt(signal.SIGUSR1) for _ in range(1))
    rows = chain(rest(0.0, 400), filter(None, signals), rest(5.0, 400))
    with TcpBoard(rows) as board:
        records = records_of(stream(board.url, "--count", 680).stdout)
    assert records[150]["tare_pC"] == {"A": 0.0, "B": 1.0, "C": 2.0}
    assert records[-1]["tare_pC"]["A"] > 3.0


@pytest.fixture
def resting(film):
    """Play a board that nobody touches."""

    def play(**options):
        contact = np.zeros((60_000, 3))
        contact[-1, 2] = 1.0
        return VirtualSensor(film.charges, Script(contact, 500.0), **options)

    return play


def test_doctor_as_json_waits_for_its_port(resting, run, tmp_path):
    link = tmp_path / "film"
    with resting(offset_pC=[5.0, -6.0, 7.0]) as sensor:
        plugging = threading.Timer(0.2, link.symlink_to, (sensor.url,))
        plugging.start()
        found = json.loads(run("doctor", "--port", link, "--wait", 30, "--seconds", 0.5, "--json").stdout)
        plugging.join()
    assert found["rate_Hz"] == pytest.approx(500.0, rel=0.05)
    assert [round(channel["offset_pC"], 3) for channel in found["channels"]] == [5.0, -6.0, 7.0]


def test_doctor_exit_code_if_no_frames_are_recognised(command, monkeypatch):
    monkeypatch.setattr("isocharge.serve.port.source.START_UP_s", 0.5)
    silent = PseudoPort()
    code, out, err = command("serve", "doctor", "--port", silent.url, "--seconds", 0.5)
    silent.close()
    assert (code, "no bytes were received" in out, "listening for 0.5 s" in err) == (1, True, True)
    assert "held presses" not in out


def test_doctor_lists_the_ports_and_what_they_send(resting, run, monkeypatch):
    with resting() as sensor:
        ports = [ListPortInfo(sensor.url), ListPortInfo("/dev/ttyNone")]
        monkeypatch.setattr(list_ports, "comports", lambda: ports)
        first, none = json.loads(run("doctor", "--json").stdout)["ports"]
    assert re.fullmatch(r"/dev/\S+ \(n/a\): binary frames of isocharge, \d+ frames/s at 115200 baud", first)
    assert none.startswith("/dev/ttyNone (n/a): /dev/ttyNone: there is no such port")


MINE = """name = "mine"
[film]
radius_mm = 45.0
thickness_um = 25.0
young_GPa = 3.0
poisson = 0.34
[piezo]
d31 = 8.0
d32 = 8.0
[electrodes]
side_mm = 3.0
"électrode 1" = [0.0, 9.0]
B = [9.0, 0.0]
C = [-9.0, 0.0]
"""


def test_doctor_writes_no_file_of_which_the_unit_is_missing(resting, command, tmp_path):
    """The command that is completed with the unit and a sensor file can then write the file, and the file is valid."""
    path = tmp_path / "board.toml"
    sensor_file = tmp_path / "mine.toml"
    sensor_file.write_text(MINE)

    def line_of_counts(frame):
        return b"%d,%d,%d\n" % (2 * frame.seq % 5, 4 * frame.seq % 11, 3 * frame.seq % 7)

    with resting(encode=line_of_counts) as sensor:
        words = ("serve", "doctor", "--port", sensor.url, "--seconds", 0.6, "--write", path)
        code, out, err = command(*words)
        assert (code, path.exists()) == (1, False)
        assert "--pc-per-unit NUMBER" in out
        assert "no device file can be written, because the charge of one unit is missing" in err
        code, _, err = command(*words[:-1], "/proc/none/board.toml", "--pc-per-unit", ".1")
        assert code == 1
        assert "OutputError: /proc/none/board.toml cannot be written: No such file" in err
        code, _, err = command(*words, "--pc-per-unit", "électrode 1=.5, B=-2,C=1", "--model", sensor_file)
        assert code == 0, err
    assert load_device(path).rule(GainRule).pC_per_unit == {"électrode 1": 0.5, "B": -2.0, "C": 1.0}


ISOCHARGE = f"{sys.executable} -m isocharge.cli"


def bash(script, **environment):
    done = finished(["bash", "-c", script], env=os.environ | environment, timeout=120)
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    return done


@pytest.mark.parametrize(
    ("line", "printed"),
    [
        ("stream linear --port {frames} --record {record} >&-", ""),
        ("predict linear {presses} 2>&- | wc -l", "3\n"),
        ("stream linear --port {frames} | (sleep 1; wc -l)", "300\n"),
        (
            "stream linear --port - --output {csv} --seconds 1 < <(exec 2>&-; cat {frames}; sleep 9) && wc -l <{csv}",
            "301\n",
        ),
    ],
)
def test_closed_output_is_the_null_device_a_slow_reader_gets_all_of_a_file_and_a_stopped_pipe_leaves_its_file(
    models, presses, frames, tmp_path, line, printed
):
    """No file that is opened later gets the place of a closed output. The bytes of a pipe cannot be read again."""
    record = tmp_path / "touch.rec"
    line = line.format(presses=presses, frames=frames, record=record, csv=tmp_path / "touch.csv")
    done = bash(f"set -o pipefail; {ISOCHARGE} serve {line}", ISOCHARGE_MODELS=str(models))
    assert (done.returncode, done.stdout) == (0, printed)
    assert not record.exists() or Recording(record).model == "linear/1"


def test_closed_stdin_is_refused(models):
    done = bash(f"{ISOCHARGE} serve predict linear - --models {models} <&-")
    assert (done.returncode, "stdin: empty" in done.stderr) == (2, True)


WITH_SHORT_QUEUE = """
from isocharge.cli.main import main
from isocharge.serve.outputs import output

output.MAX_WAITING_ITEMS = 1_000
main()
"""
"""Program of a command in which fewer records than usual wait for a slow reader."""


def test_a_slow_reader_stops_neither_chain_nor_recording(film, tmp_path, start_stream):
    """It takes nothing at first: what it missed is counted, and the recording has everything."""
    recording, count = tmp_path / "touch.rec", 2_800
    with TcpBoard(taps(film), rate_Hz=5000.0) as board:
        words = (board.url, "--record", recording, "--count", count)
        process = start_stream(*words, program=("-c", WITH_SHORT_QUEUE))
        lines, end = [process.stdout.readline()], time.monotonic() + 120
        while recording.read_bytes().count(b'"seq"') < 2_000 and time.monotonic() < end:
            time.sleep(0.1)  # more than the queue and the pipe hold
        out, err = process.stdout.read(), process.stderr.read()
        assert process.wait(60) == 0, err
    recorded = [json.loads(line)["seq"] for line in recording.read_text().splitlines() if '"seq"' in line]
    assert [after - before for before, after in pairwise(recorded)] == [1] * (count - 1)
    lines = [json.loads(line) for line in [*lines, *out.splitlines()]]
    lost = int(re.search(r"json: (\d+) records not written, the oldest", err)[1])
    assert len(lines) + lost - count in (
        0,
        1,
    )  # a record whose write is pending at the end may arrive, but counts as lost
    assert lost > 0
    assert lines[-1]["seq"] == recorded[-1]  # the newest are there, the oldest are not


@pytest.mark.parametrize(("count", "seconds"), [(200, 30.0), (1, 0.5), (0, 0.2)])
def test_a_board_that_is_not_recognised_names_the_doctor(models, command, count, seconds):
    """Many bytes that are no frames end the stream. After a few of them or none, the option --seconds ends it."""
    board = PseudoPort()

    def send():
        for _ in range(count):
            board.write_whole(bytes(range(128, 256)))
            time.sleep(0.005)

    sender = threading.Timer(0.2, send)
    sender.start()
    words = ("--models", models, "--port", board.url, "--seconds", seconds)
    code, out, err = command("serve", "stream", "linear", *words)
    sender.join()
    board.close()
    assert (code, out) == (1, "")
    assert f"isocharge serve doctor --port {board.url} --write board.toml" in err


def test_a_recording_that_was_killed_is_readable(board, models, start_stream, tmp_path, run):
    """It lacks at most the records of the chunk that was being made."""
    path = tmp_path / "touch.rec"
    process = start_stream(board.url, "--record", path)
    lines = [process.stdout.readline() for _ in range(500)]
    process.kill()
    process.wait()
    replayed = run("replay", path, "--models", models).stdout.splitlines(keepends=True)
    assert replayed
    assert replayed[:500] == lines[: len(replayed)]


def test_stream_ends_if_its_stdout_is_never_read(board, start_stream):
    process = start_stream(board.url, "--seconds", 1)
    assert process.wait(60) == 0
    assert "records not written, the oldest" in process.stderr.read()
