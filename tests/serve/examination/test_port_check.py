"""Port check of simulated boards with known faults, and health of channels with known noise, drift and hum."""

import json
from dataclasses import asdict, replace
from functools import partial

import numpy as np
import pytest

from boards import received
from isocharge.cli.serve import doctor
from isocharge.common.errors import DeviceError
from isocharge.serve import Frame, device_from_table, encode_frame, encode_text
from isocharge.serve.examination.board_health import measure_channel_health
from isocharge.serve.examination.port_check import examine_received

RATE_HZ = 200.0
FOUR = ("A", "B", "C", "D")
LINES = partial(encode_text, notation="csv")
AT_REST = device_from_table({"leak": {"tau_s": 10.0}}, "test")


def examined(encode, url="/dev/ttyACM0", **settings):
    """Return the report about a board that sends `encode(number)` 200 times per second."""
    return examine_received(replace(received(map(encode, range(400)), RATE_HZ), url=url), **settings)


def charges(*, offset=(5.0, -6.0, 7.0), noise=0.3, hum=0.0, drift=0.0, press=None, encode=encode_frame):
    """Return a function that returns the frames of a board with three electrodes, which sends charges in pC."""
    rng = np.random.default_rng(0)

    def frame(number):
        time_s = number / RATE_HZ
        change = hum * np.sin(2 * np.pi * 50 * time_s + 0.5) + drift * time_s
        values = rng.normal(offset, noise) + change
        if press is not None and number > 150:
            values += press
        return encode(Frame(number, 5000 * number, tuple(values.tolist())))

    return frame


def row(number):
    """Return a line of counts: four inputs that vary near 300, a constant temperature, and a constant input."""
    first, second, third, fourth = (300 + (7 * number * (column + 3)) % 11 for column in range(4))
    return f"{first},21.5,{second},{third},4095,{fourth}\n".encode()


def missing(report):
    """Return all sentences about missing settings as one text."""
    return " / ".join(report.missing)


def test_of_a_touched_film_only_the_touch_is_reported():
    """The offset, the noise and the drift of a pressed film would lead to wrong advice."""
    report = examined(charges(press=(400.0, 800.0, 0.0)), device=AT_REST, electrodes=FOUR[:3])
    assert "as under a touch; take the finger away" in report.touch
    assert report.missing == (report.touch,)


def test_check_of_a_healthy_board():
    assert "gain" not in examined(charges()).device
    report = examined(charges(), device=AT_REST, electrodes=FOUR[:3])
    assert (report.baud, report.format) == (115200, "binary frames of isocharge")
    assert not {*report.missing, *report.missing_for_held_presses}
    assert (report.good, report.bad, report.lost, report.repeated, report.device_clock) == (400, 0, 0, 0, True)
    assert round(report.rate_Hz) == 200
    assert [round(channel.offset_pC) for channel in report.channels] == [5, -6, 7]
    first_frame, *other_frames = map(charges(), range(40))
    assert not examine_received(received([first_frame[5:], *other_frames], RATE_HZ)).missing  # an incomplete frame
    assert round(examine_received(received([row(1) * 100] * 10, 10.0)).rate_Hz) == 1000  # without a clock


@pytest.mark.parametrize("others", [("1.5", "2.5"), ("nan", "nan")])
def test_check_of_a_channel_without_a_number(others):
    """A board sends `nan` for a missing amplifier. The other channels are reported as usual, also as valid JSON."""
    report = examined(lambda _: "A:nan,B:{},C:{}\n".format(*others).encode())
    assert "channel A is nan in 400 frames" in missing(report)
    assert "counts" not in missing(report)  # the board is not taken for one that sends counts
    if others[0] == "1.5":
        assert [(c.name, c.offset_pC) for c in report.channels] == [("A", None), ("B", 1.5), ("C", 2.5)]
        assert report.channels[0].unusable == report.good == 400
        assert "channel B is dead: every value is 1.5" in missing(report)
    json.dumps(asdict(report), allow_nan=False)


@pytest.mark.parametrize(
    ("board", "message"),
    [
        (charges(), "3 of 3 channels, but the model has the electrodes ('A', 'B', 'C', 'D')"),
        (charges(hum=9.0), "channel 1 has a hum of 9 pC: set [hum] frequency_Hz = 50"),
        (charges(drift=-4.0), "channel 1 drifts by -4 pC/s"),
        (charges(offset=(0.0, 120.0, 0.0)), "channel 2 has 120 pC at rest, but a tare accepts at most 100 pC"),
        (charges(noise=8.0), "channel 1 has a noise of "),
        (lambda k: charges()(3 * k), "798 frames were lost"),
        (charges(encode=lambda f: encode_frame(Frame(f.seq, f.t_us // 1000, f.values))), "took 0.00199 s by the clock"),
        (lambda k: charges()(k) + b"\x07\0" * (k % 4 == 0), "2.0% of the bytes do not belong to good frames"),
        (lambda k: b'{"A":%s,"B":%d}\n' % (b"null" if k % 20 == 7 else b"3", k % 2), """the line '{"A":null,"B":"""),
        (lambda _: b"", "no bytes were received"),
        (lambda _: b"\xf8\x80\xfe\xff" * 5, "no frames were recognised: try another baud rate"),
        (lambda _: b"3.1,-2.0,5.2;", "such as b'3.1,-2.0,5.2;', but no frames"),
        # The board is restarted after ten frames, because its port was opened.
        (lambda k: b"t_ms:%d,A:%d,B:1\n" % (5 * k + 1_000_000 * (k < 9), 3 * k % 7), "channel B is dead"),
        (lambda _: b"t_ms:5\n", "lines of text are not understood, for example 't_ms:5'"),
        (lambda k: b"%03X %03X %03X\n" % (k % 99, 90 - k % 9, 80 + k % 9), "and 0x before hexadecimal numbers"),
        (lambda k: f"#{k} 3.1 -2.0 5.2\n".encode(), "a line that begins with # is a comment"),
        (
            lambda k: b"%d,%d,3.1\n" % (k // 3, k % 3),
            "for example '133,0,3.1': send the numbers of all channels in each",
        ),
        (
            lambda k: f"{1e-3 * (k % 7):.4f};{1.65 + 1e-3 * (k % 5):.4f}\n".encode(),
            "seem to be in V: state the charge",
        ),
    ],
)
def test_check_reports_missing_settings(board, message):
    assert message in missing(examined(board, electrodes=FOUR))


def test_settings_of_the_device_file_are_not_missing():
    device = device_from_table({"leak": {"tau_s": 10.0}, "hum": {}}, "test")
    report = examined(charges(hum=9.0, drift=-4.0), device=device, electrodes=("A", "B", "C"))
    assert "hum" not in missing(report)
    assert "drifts" not in missing(report)


@pytest.mark.parametrize(
    ("encode", "settings", "is_missing"),
    [(LINES, {"device": AT_REST}, True), (LINES, {}, False), (encode_frame, {"device": AT_REST}, False)],
)
def test_missing_clock_is_reported_only_with_leak(encode, settings, is_missing):
    report = examined(charges(encode=encode), **settings)
    assert ("a device clock" in " / ".join(report.missing_for_held_presses)) == is_missing


def test_proposed_device_file_ignores_unused_inputs_and_reads_the_same_charges(monkeypatch):
    """A check with the proposed file gives the same result as the check that has proposed the file.

    The order of the electrodes can be checked, although the gain is not known.
    """
    report = examined(row, "loop://", electrodes=FOUR)
    monkeypatch.setattr(doctor, "check_electrodes", print)
    doctor._check_wiring(report)
    assert report.device["channels"] == {"A": "1", "B": "3", "C": "4", "D": "6"}
    assert (report.unused, report.unit) == (("2", "5"), "counts")
    assert "dead" not in missing(report)
    assert "--pc-per-unit" in missing(report)
    (first, *_) = doctor.brief_report(report)["channels"]
    assert [*first] == ["name", "offset_counts", "noise_counts", "drift_counts_per_s", "hum_counts"]

    gain = {"A": 0.5, "B": -0.5, "C": 0.5, "D": 0.5}
    proposed = examined(row, electrodes=FOUR, gain={"pC_per_unit": gain}).device
    assert proposed["gain"]["offset"] == pytest.approx(dict.fromkeys("ABCD", 305), abs=10)
    again = examined(row, device=device_from_table(proposed, "test"))
    assert [channel.name for channel in again.channels] == [channel.name for channel in report.channels]
    assert all(abs(channel.offset_pC) < 5 for channel in again.channels)
    assert (again.unit, again.unused) == ("pC", ("2", "5"))


@pytest.mark.parametrize("electrodes", [FOUR[:3], ()])
@pytest.mark.parametrize("notation", ["csv", "json"])
def test_gain_by_electrode_applies_without_a_section_channels(electrodes, notation):
    device = device_from_table({"gain": {"pC_per_unit": {"A": 1.0, "B": 2.0, "C": -1.0}}}, "board.toml")
    report = examined(charges(encode=partial(encode_text, notation=notation)), device=device, electrodes=electrodes)
    assert [round(channel.offset_pC) for channel in report.channels] == [5, -12, -7]


def test_channel_of_a_device_file_that_the_board_does_not_send_is_reported():
    device = device_from_table({"channels": {"A": "1", "B": "4", "C": "3"}}, "board.toml")
    report = examined(charges(), device=device, electrodes=FOUR[:3])
    assert report.missing[0].startswith('board.toml: [channels] B = "4": no channel is called that; the frames have 1,')


@pytest.mark.parametrize("electrodes", [(), FOUR[:3], FOUR[:2]])
def test_channels_of_a_board_that_sends_the_same_values_all_the_time_are_proposed_in_their_order(electrodes):
    gain = {"pC_per_unit": dict.fromkeys(electrodes or FOUR[:3], 0.5)}
    report = examined(lambda _: b"100,200,300\n", electrodes=electrodes, gain=gain)
    assert report.device["channels"] == dict(zip(electrodes or FOUR[:3], "123", strict=False))
    assert "1 is dead: every value is 0; check the amplifier and the wire of this channel, or send" in missing(report)


def test_gain_of_some_electrodes_is_refused():
    with pytest.raises(DeviceError, match=r"gain\.pC_per_unit: expected a number, or one for each"):
        examined(row, electrodes=FOUR, gain={"pC_per_unit": {"A": 0.5}})


@pytest.mark.parametrize(
    ("gain", "levels", "has_offset"),
    [
        ({}, (33168, 32678), True),
        ({"pC_per_unit": 0.01}, (33168, 32678), True),
        ({"pC_per_unit": 1.0}, (10, -10), True),
        ({}, (0, 0), False),
    ],
)
def test_level_at_rest_is_proposed_as_offset(gain, levels, has_offset):
    board = lambda k: b"%d,%d\n" % tuple(level + (k * 7) % 5 - 2 for level in levels)  # noqa: E731
    offset = {"offset": dict(zip("AB", levels, strict=True))} if has_offset else {}
    assert examined(board, electrodes=("A", "B"), gain=gain).device["gain"] == gain | offset


@pytest.mark.parametrize(
    ("names", "channels", "message"),
    [
        ("A_nC B_nC C_nC", "A_nC B_nC C_nC", "the channels seem to be in nC"),
        ("T A_uV B_uV C_uV", "A_uV B_uV C_uV", "the channels seem to be in uV"),  # a temperature has no unit of charge
        ("A B C_nC", "A B C_nC", "their units differ: state pC_per_unit of each electrode"),
        ("c b a", "a b c", ""),
        ("A B z", None, "('A', 'B', 'z')"),
        ("x y z", "x y z", ""),
        ("ch3 ch2 ch1", None, "('ch3', 'ch2', 'ch1')"),
        ("1,B A C", None, "a frame has 4"),  # it is not clear whether the name stands before or behind its value
    ],
)
def test_channels_are_proposed_by_their_names(names, channels, message):
    rng = np.random.default_rng(0)
    mark = "," if "," in names else ":"

    def board(_):
        return ",".join(f"{name}{mark}{rng.normal():.3f}" for name in names.split()).encode() + b"\n"

    report = examined(board, electrodes=FOUR[:3])
    expected = channels and dict(zip("ABC", channels.split(), strict=True))
    assert (report.device.get("channels"), not report.missing) == (expected, not message)
    assert message in missing(report)


def test_channels_with_different_units_are_not_taken_for_voltages_because_their_noise_is_small():
    rng = np.random.default_rng(0)
    assert examined(lambda _: "A_nC:{:.4f},B_pC:{:.4f}\n".format(*rng.normal(0, 0.01, 2)).encode()).unit == "pC"


def test_channels_without_names_beside_others_are_proposed_by_their_numbers():
    report = examined(lambda k: b"left: %d 2, right: 3 4\n" % (3 * k % 5), electrodes=FOUR)
    assert report.device["channels"] == {"A": "left", "B": "2", "C": "right", "D": "4"}


@pytest.mark.parametrize("noise", [0.3, 1.0])
def test_doubled_bytes_of_a_serial_server_lead_to_the_advice_about_telnet(noise):
    board = charges(noise=noise, encode=lambda frame: encode_frame(frame).replace(b"\xff", b"\xff\xff"))
    report = examined(board, "tcp://127.0.0.1:4001", device=AT_REST)
    assert "if a serial server uses the telnet protocol" in missing(report)
    assert "baud" not in missing(report)


@pytest.mark.parametrize(("rate_Hz", "hum_pC"), [(500.0, (2.0, 0.5)), (100.0, (None, None))])
def test_offset_drift_hum_and_noise_of_a_channel(rate_Hz, hum_pC):
    """A hum above half of the rate is not estimated."""
    t = np.arange(0.0, 4.0, 1.0 / rate_Hz)
    charge = np.random.default_rng(0).normal(12.0 + 3.0 * t, 0.3)
    for frequency_Hz, amplitude_pC in zip((50, 60), hum_pC, strict=True):
        charge += (amplitude_pC or 0.0) * np.sin(2 * np.pi * frequency_Hz * t + 1)
    health = measure_channel_health("A", "A", charge, t, rate_Hz)
    assert health.offset_pC == pytest.approx(12.0 + 6.0, abs=0.1)
    assert health.drift_pC_per_s == pytest.approx(3.0, abs=0.05)
    assert health.hum_pC == (pytest.approx(hum_pC, abs=0.05) if hum_pC[0] else hum_pC)
    assert health.noise_pC == pytest.approx(0.3, rel=0.05)
