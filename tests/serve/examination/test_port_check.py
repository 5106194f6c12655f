"""The port check against boards whose faults are known."""

import json
import threading
import time
from dataclasses import asdict
from functools import partial

import numpy as np
import pytest

from isocharge.cli.serve.doctor import report_lines
from isocharge.common.errors import PortError
from isocharge.serve import Script, VirtualSensor, device_from_table, encode_text, examine
from isocharge.serve.virtual_sensor.pseudo_port import PseudoPort

BAUD = (115200,)


def idle(n=400, rate_Hz=200.0):
    """Nothing touches but in the last frame."""
    return Script(np.zeros(n), np.zeros(n), np.where(np.arange(n) < n - 1, 0.0, 1e-6), rate_Hz)


def board(film, **options):
    return VirtualSensor(film.charges, idle(), offset_pC=[5.0, -6.0, 7.0], **options)


def test_check_of_a_healthy_board(film):
    device = device_from_table({"leak": {"tau_s": 10.0}}, "test")
    noise = lambda charge_pC, rng: charge_pC + rng.normal(0, 0.3, charge_pC.shape)  # noqa: E731
    with board(film, noise=noise) as sensor:
        report = examine(sensor.url, seconds=0.9, device=device, electrodes=film.electrodes)
    assert (report.baud, report.format, report.missing) == (115200, "binary frames of isocharge", ())
    assert report.rate_Hz == pytest.approx(200.0, rel=0.02)
    assert (report.lost, report.repeated, report.device_clock) == (0, 0, True)
    assert [round(channel.offset_pC) for channel in report.channels] == [5, -6, 7]


def test_check_of_text_in_counts(film):
    device = device_from_table({"gain": {"pC_per_unit": {"A": 2.0, "B": -1.0, "C": 1.0}}}, "test")
    with board(film, encode=partial(encode_text, notation="pairs")) as sensor:
        report = examine(sensor.url, bauds=BAUD, seconds=0.6, device=device)
    assert "name:value: seq, t_us, A, B, C" in report.format
    assert [(channel.name, round(channel.offset_pC)) for channel in report.channels] == [("A", 10), ("B", 6), ("C", 7)]


def test_check_uses_no_stage_that_is_switched_off(film):
    """A gain that is off multiplies nothing, and a leak that is off is missing."""
    off = {"gain": {"on": False, "pC_per_unit": 2.0}, "leak": {"on": False, "tau_s": 10.0}}
    with board(film) as sensor:
        report = examine(sensor.url, bauds=BAUD, seconds=0.6, device=device_from_table(off, "test"))
    assert [round(channel.offset_pC) for channel in report.channels] == [5, -6, 7]
    assert "time constants ([leak] tau_s" in missing(report)


def test_check_of_a_channel_without_a_number():
    """A board prints `nan` where an amplifier is missing; the others are reported as ever, in valid JSON too."""
    port = PseudoPort()
    stop = threading.Event()

    def send():
        while not stop.wait(0.002):
            port.write_whole(b"A:nan,B:1.5,C:2.5\n")

    sender = threading.Thread(target=send)
    sender.start()
    report = examine(port.url, bauds=BAUD, seconds=0.6)
    stop.set()
    sender.join()
    port.close()
    assert [(c.name, c.offset_pC) for c in report.channels] == [("A", None), ("B", 1.5), ("C", 2.5)]
    assert report.channels[0].unusable == report.good > 100
    assert "charges on channel A" in missing(report)
    assert "?" in "\n".join(report_lines(report))
    json.dumps(asdict(report), allow_nan=False)


def missing(report):
    return " / ".join(report.missing)


def test_check_says_what_is_missing(film):
    hum = lambda q, rng: q + 9.0 * np.sin(2 * np.pi * 50 * np.arange(len(q))[:, None] / 200.0 + 0.5)  # noqa: E731, ARG005
    with board(film, noise=hum) as sensor:
        report = examine(sensor.url, bauds=BAUD, seconds=0.9, electrodes=("A", "B", "C", "D"))
    assert "3 channels, but the model has the electrodes ('A', 'B', 'C', 'D')" in missing(report)
    assert "[hum] frequency_Hz = 50" in missing(report)
    assert "time constants ([leak] tau_s" in missing(report)


def test_check_of_a_dead_board():
    silent = PseudoPort()
    report = examine(silent.url, seconds=0.5)
    silent.close()
    assert (report.bytes_seen, report.good, report.channels) == (0, 0, ())
    assert "not one byte came" in missing(report)


def test_check_at_another_baud_rate():
    port, stop = PseudoPort(), threading.Event()

    def babble():
        while not stop.wait(0.005):
            port.write_whole(b"\xf8\x80\xfe\xff" * 5)

    talking = threading.Thread(target=babble)
    talking.start()
    report = examine(port.url, bauds=BAUD, seconds=0.5)
    stop.set()
    talking.join()
    port.close()
    assert report.bytes_seen > 100
    assert "bytes come, but no frames: another baud rate" in missing(report)


@pytest.fixture
def talk():
    """Let a port say the same again and again."""
    talking = []

    def start(data, pause_s=0.005):
        port, stop = PseudoPort(), threading.Event()

        def send():
            number = 0
            while not stop.wait(pause_s):
                port.write_whole(data(number) if callable(data) else data)
                number += 1

        thread = threading.Thread(target=send)
        thread.start()
        talking.append((port, stop, thread))
        return port.url

    yield start
    for port, stop, thread in talking:
        stop.set()
        thread.join()
        port.close()


def row(number):
    """Counts: four inputs that live about 300, two that do not."""
    q = [300 + (7 * number * (k + 3)) % 11 for k in range(4)]
    return f"{q[0]},0,{q[1]},{q[2]},4095,{q[3]}\n".encode()


def test_two_seconds_take_two_seconds(talk):
    """Also where the speed is looked for: what is heard then counts."""
    url = talk(row)
    began = time.monotonic()
    report = examine(url, seconds=2.0)
    assert 1.9 < report.seconds < 2.2
    assert time.monotonic() - began < 4.0  # what was heard is examined after it


def test_inputs_that_do_not_live_are_ignored(talk):
    report = examine(talk(row), seconds=0.6, electrodes=("A", "B", "C", "D"))
    assert report.device["channels"] == {"A": "1", "B": "3", "C": "4", "D": "6"}
    assert report.unused == ("2", "5")
    assert "life" not in missing(report)
    assert report.unit == "counts"
    assert "--pC-per-unit" in missing(report)
    text = "\n".join(report_lines(report))
    assert "the channels are counts, not pC" in text
    assert "pC" not in text.partition("channel ")[2].splitlines()[0]


def test_channels_that_a_file_leaves_out_are_ignored(talk):
    board = {"channels": {"A": "ch1", "B": "3", "C": "4"}, "gain": {"pC_per_unit": 0.5, "offset": 300}}
    report = examine(talk(row), seconds=0.6, device=device_from_table(board, "test"))
    assert [channel.name for channel in report.channels] == ["1", "3", "4"]
    assert report.unused == ("2", "5", "6")
    assert all(abs(channel.offset_pC) < 10 for channel in report.channels)
    assert "life" not in missing(report)


def test_the_proposal_is_a_device_that_reads_the_same(talk):
    """What doctor says of the board, its file says again."""
    gain = {"pC_per_unit": {"A": 0.5, "B": -0.5, "C": 0.5, "D": 0.5}}
    url = talk(row)
    first = examine(url, seconds=0.6, electrodes=("A", "B", "C", "D"), gain=gain)
    assert first.device["gain"]["offset"] == pytest.approx(305, abs=10)
    again = examine(url, seconds=0.6, device=device_from_table(first.device, "test"))
    assert [channel.name for channel in again.channels] == [channel.name for channel in first.channels]
    assert all(abs(channel.offset_pC) < 5 for channel in again.channels)
    assert (again.unit, again.unused) == ("pC", ("2", "5"))
    json.dumps(asdict(first), allow_nan=False)


def test_a_file_that_does_not_fit_is_no_reason_to_be_silent(talk):
    fields = [{"name": "A", "type": "f32"}]
    table = {"frames": {"format": "described", "sync": "AA", "length": 5, "fields": fields}}
    report = examine(talk(row), bauds=BAUD, seconds=0.5, device=device_from_table(table, "test"))
    assert report.good == 0
    assert "bytes come, but no frames" in missing(report)


def test_check_without_a_port():
    with pytest.raises(PortError, match="cannot be opened"):
        examine("/dev/ttyNone")
