"""The doctor against boards whose illness is known."""

import json
import threading
from dataclasses import asdict
from functools import partial

import numpy as np
import pytest

from isocharge.cli.serve.doctor import _in_words
from isocharge.errors import PortError
from isocharge.serve import Script, VirtualSensor, device_from_table, encode_text, examine
from isocharge.serve.live.port_check import _health
from isocharge.serve.virtual_sensor.pseudo_port import PseudoPort

BAUD = (115200,)


def idle(n=400, rate_Hz=200.0):
    """Nothing touches but in the last frame."""
    return Script(np.zeros(n), np.zeros(n), np.where(np.arange(n) < n - 1, 0.0, 1e-6), rate_Hz)


def board(film, **options):
    return VirtualSensor(film.charge_pC, idle(), offset_pC=[5.0, -6.0, 7.0], **options)


def test_offset_drift_hum_and_noise_of_a_channel():
    t, rng = np.arange(0.0, 4.0, 0.002), np.random.default_rng(0)
    charge = 12.0 + 3.0 * t + 2.0 * np.sin(2 * np.pi * 50 * t + 1) + 0.5 * np.sin(2 * np.pi * 60 * t)
    health = _health("A", charge + rng.normal(0, 0.3, t.size), t, 500.0)
    assert health.offset_pC == pytest.approx(12.0 + 6.0, abs=0.1)
    assert health.drift_pC_per_s == pytest.approx(3.0, abs=0.05)
    assert health.hum_pC == pytest.approx((2.0, 0.5), abs=0.05)
    assert health.noise_pC == pytest.approx(0.3, rel=0.05)


def test_hum_above_half_the_rate_is_not_told():
    t = np.arange(0.0, 4.0, 0.01)
    assert _health("A", np.sin(t), t, 100.0).hum_pC == (None, None)


def test_a_healthy_board(film):
    device = device_from_table({"leak": {"tau_s": 10.0}}, "test")
    noise = lambda charge_pC, rng: charge_pC + rng.normal(0, 0.3, charge_pC.shape)  # noqa: E731
    with board(film, noise=noise) as sensor:
        found = examine(sensor.url, seconds=0.9, device=device, electrodes=film.electrodes)
    assert (found.baud, found.format, found.missing) == (115200, "binary frames of isocharge", ())
    assert found.rate_Hz == pytest.approx(200.0, rel=0.02)
    assert (found.lost, found.repeated, found.device_clock) == (0, 0, True)
    assert [round(channel.offset_pC) for channel in found.channels] == [5, -6, 7]


def test_text_in_counts(film):
    device = device_from_table({"gain": {"pC_per_unit": {"A": 2.0, "B": -1.0, "C": 1.0}}}, "test")
    with board(film, encode=partial(encode_text, notation="pairs")) as sensor:
        found = examine(sensor.url, bauds=BAUD, seconds=0.6, device=device)
    assert "name:value: seq, t_us, A, B, C" in found.format
    assert [(channel.name, round(channel.offset_pC)) for channel in found.channels] == [("A", 10), ("B", 6), ("C", 7)]


def test_values_that_are_no_charges_are_counted_and_left_out():
    t = np.arange(0.0, 4.0, 0.01)
    charge = 7.0 + np.random.default_rng(0).normal(0.0, 0.3, t.size)
    charge[[3, 90, 200]] = np.nan, 1e300, -np.inf
    health = _health("A", charge, t, 100.0)
    assert health.offset_pC == pytest.approx(7.0, abs=0.05)
    assert (health.unusable, health.noise_pC) == (3, pytest.approx(0.3, rel=0.1))


def test_a_channel_without_a_number():
    """A board prints `nan` where an amplifier is missing; the other channels are told as ever, in valid JSON too."""
    port = PseudoPort()
    stop = threading.Event()

    def send():
        while not stop.wait(0.002):
            port.write_whole(b"A:nan,B:1.5,C:2.5\n")

    sender = threading.Thread(target=send)
    sender.start()
    found = examine(port.url, bauds=BAUD, seconds=0.6)
    stop.set()
    sender.join()
    port.close()
    assert [(c.name, c.offset_pC) for c in found.channels] == [("A", None), ("B", 1.5), ("C", 2.5)]
    assert found.channels[0].unusable == found.good > 100
    assert "charges on channel A" in missing(found)
    assert "?" in "\n".join(_in_words(found))
    json.dumps(asdict(found), allow_nan=False)


def missing(found):
    return " / ".join(found.missing)


def test_what_is_missing(film):
    hum = lambda q, rng: q + 9.0 * np.sin(2 * np.pi * 50 * np.arange(len(q))[:, None] / 200.0 + 0.5)  # noqa: E731, ARG005
    with board(film, noise=hum) as sensor:
        found = examine(sensor.url, bauds=BAUD, seconds=0.9, electrodes=("A", "B", "C", "D"))
    assert "3 channels, but the model has the electrodes ('A', 'B', 'C', 'D')" in missing(found)
    assert "[hum] frequency_Hz = 50" in missing(found)
    assert "time constants ([leak] tau_s" in missing(found)


def test_a_board_that_is_dead():
    silent = PseudoPort()
    found = examine(silent.url, seconds=0.5)
    silent.close()
    assert (found.bytes_seen, found.good, found.channels) == (0, 0, ())
    assert "not one byte came" in missing(found)


def test_another_baud_rate_looks_like_noise():
    port, stop = PseudoPort(), threading.Event()

    def babble():
        while not stop.wait(0.005):
            port.write_whole(b"\xf8\x80\xfe\xff" * 5)

    talking = threading.Thread(target=babble)
    talking.start()
    found = examine(port.url, bauds=BAUD, seconds=0.5)
    stop.set()
    talking.join()
    port.close()
    assert found.bytes_seen > 100
    assert "bytes come, but no frames: another baud rate" in missing(found)


def test_no_port_at_all():
    with pytest.raises(PortError, match="cannot be opened"):
        examine("/dev/ttyNone")
