"""Swapped and turned channels, found by a press near each electrode of a virtual sensor.

The time of most tests is simulated. A busy computer, which lets presses pass unread, then does not change the result.
"""

from itertools import islice, permutations
from types import SimpleNamespace

import numpy as np
import pytest

from isocharge.cli.serve import doctor
from isocharge.cli.shared.virtual_sensor import film_charges
from isocharge.common.errors import PressCheckError
from isocharge.serve import (
    Chunk,
    VirtualSensor,
    device_from_table,
    encode_frame,
    load_device,
)
from isocharge.serve.examination import electrode_check
from isocharge.serve.examination.electrode_check import (
    ElectrodeCheck,
    assign_channels,
    check_electrodes,
    corrected_table,
)
from isocharge.serve.virtual_sensor.script import VirtualScript
from isocharge.simulate import Circle, ForwardMap, load_sensor
from kept import kept

RATE_HZ = 200.0
REST_S = 0.9
FRAMES_AT_ONCE = 4
END_S = 60.0
"""Time without a press at the end of a script, s."""


def press_script(directions, rest_s=REST_S, first_rest_s=REST_S, end_of_press_s=0.6):
    """Return a script of presses of 0.3 N, 8 mm from the centre in some directions, with a rest before each press."""
    rows = [(0.0, 0.0, 0.0, 0.0)]
    begin_s = first_rest_s
    for x_mm, y_mm in 8.0 * np.asarray(directions):
        for since_begin_s, force_N in ((0.0, 0.0), (0.1, 0.3), (end_of_press_s - 0.1, 0.3), (end_of_press_s, 0.0)):
            rows.append((begin_s + since_begin_s, x_mm, y_mm, force_N))
        begin_s += end_of_press_s + rest_s
    rows.append((begin_s + END_S, 0.0, 0.0, 0.0))
    return VirtualScript(presses=tuple(rows)).script(RATE_HZ)


def noise(charge_pC, rng):
    return charge_pC + rng.normal(0.0, 1.0, charge_pC.shape)


def sensor_with_wiring(charges, directions, wiring, gain=1.0, unit_pC=1.0, encode=encode_frame, **rests):
    """Return a virtual sensor, whose channel i is connected to electrode `wiring[i]`, and which sends units of pC."""
    wired = lambda contact: np.asarray(gain) * charges(contact)[:, list(wiring)]  # noqa: E731
    measure = lambda charge_pC, rng: noise(charge_pC, rng) / unit_pC  # noqa: E731
    offset = [20.0 / unit_pC] * len(wiring)
    return VirtualSensor(wired, press_script(directions, **rests), noise=measure, offset_pC=offset, encode=encode)


@pytest.fixture
def check(monkeypatch):
    """Return a function that checks the electrodes of a virtual sensor in simulated time."""

    def check_in_simulated_time(sensor, electrodes, unit="pC", rest_span=8.0, timeout_s=20.0):
        clock = SimpleNamespace(now_s=0.0)

        def arriving_chunks():
            frames = sensor.frames()
            while True:
                clock.now_s += FRAMES_AT_ONCE / RATE_HZ
                yield Chunk(b"".join(islice(frames, FRAMES_AT_ONCE)), 1e9 + clock.now_s, round(1e9 * clock.now_s))

        monkeypatch.setattr(electrode_check, "time", SimpleNamespace(monotonic=lambda: clock.now_s))
        channels = {electrode: str(number + 1) for number, electrode in enumerate(electrodes)}
        device = device_from_table({}, "test")
        requests = []
        result = check_electrodes(arriving_chunks(), device, channels, requests.append, unit, rest_span, timeout_s)
        assert requests[0].startswith("wait")
        presses = [sentence.split()[3].rstrip(",") for sentence in requests if sentence.startswith("press near")]
        assert [*dict.fromkeys(presses)] == [*electrodes]
        return result

    return check_in_simulated_time


@pytest.mark.parametrize(("unit", "unit_pC"), [("pC", 1.0), ("V", 1000.0), ("counts", 0.05)])
def test_swapped_channels_of_the_simulated_film(check, unit, unit_pC):
    """The charges are those of the simulator. The gains differ by a factor of two, and one gain is negative."""
    sensor = load_sensor("three-25um-biaxial")
    forward_map = kept(ForwardMap.build, sensor, Circle(1.0))
    places = np.array([electrode.centre for electrode in sensor.electrodes])
    directions = places / np.linalg.norm(places, axis=1, keepdims=True)
    board = sensor_with_wiring(film_charges(forward_map), 0.99 * directions, (0, 2, 1), (1.0, -2.0, 0.7), unit_pC)
    result = check(board, "ABC", unit, 8.0 / unit_pC)
    assert result.found == {"A": "1", "B": "3", "C": "2"}
    assert result.inverted == ("2",)
    assert "check the signs of the gain" in "\n".join(result.sentences)


@pytest.mark.parametrize("order", [*permutations(range(4))])
def test_channels_are_assigned_for_any_order_and_gain(order):
    gains = np.random.default_rng(0).uniform(0.2, 5.0, (2, 4))
    changes = (0.6 + np.eye(4))[:, list(order)] * np.outer(*gains)
    assert [order[column] for column in assign_channels(changes, "ABCD")] == [0, 1, 2, 3]
    assert assign_channels(np.array([[1.0, 2.0], [2.0, 1.0]]), "AB") == [1, 0]


def test_presses_that_do_not_distinguish_the_channels_raise_an_error():
    with pytest.raises(PressCheckError, match="changes two channels by almost the same amount; press closer"):
        assign_channels(np.ones((3, 3)), "ABC")


@pytest.mark.parametrize(("n_presses", "end_of_press_s", "electrode"), [(2, 0.6, "C"), (1, 60.0, "A")])
def test_press_that_does_not_come_or_does_not_end_raises_an_error(film, check, n_presses, end_of_press_s, electrode):
    directions = film.directions[:n_presses]
    sensor = sensor_with_wiring(film.charges, directions, (0, 1, 2), end_of_press_s=end_of_press_s)
    message = rf"electrode {electrode}: no press began and ended within 1\.8 s; take the finger away"
    with pytest.raises(PressCheckError, match=message):
        check(sensor, "ABC", timeout_s=1.8)


def encode_damaged(frame):
    """Return the bytes of a frame. Two frames before the first press are damaged."""
    if frame.seq in (500, 501):
        frame.values = (frame.values[0], frame.values[1] + 300.0, frame.values[2])
    return encode_frame(frame)


@pytest.mark.parametrize(
    ("presses", "wiring", "options"),
    [
        # The pause is shorter than the time in which the rest level is measured. A block may contain half of a release.
        *(((0, 1, 2), (1, 0, 2), {"rest_s": delay_s}) for delay_s in (0.1, 0.48, 0.5, 0.58)),
        ((2, 0, 1, 2), (0, 1, 2), {"first_rest_s": 0.1}),  # a finger is on the film at first
        ((0, 1, 2), (0, 1, 2), {"first_rest_s": 3.0, "encode": encode_damaged}),
    ],
)
def test_presses_near_the_electrodes_find_the_channels(film, check, presses, wiring, options):
    result = check(sensor_with_wiring(film.charges, film.directions[[*presses]], wiring, **options), "ABC")
    assert result.found == {"ABC"[electrode]: str(channel + 1) for channel, electrode in enumerate(wiring)}
    is_right = wiring == (0, 1, 2)
    assert ([*result.sentences][-1] == "every channel belongs to its electrode") == is_right


def test_settings_of_single_electrodes_move_with_their_channels():
    others = {"name": "board", "tare": {"frames": 50}}
    table = {
        "channels": {"A": "1", "B": "2", "C": "3"},
        "gain": {"pC_per_unit": {"A": 0.1, "B": 0.2, "C": 0.3}, "offset": 5},
    }
    found = {"A": "2", "B": "1", "C": "3"}
    assert corrected_table(others | table, ElectrodeCheck(table["channels"], found, ())) == others | {
        "channels": found,
        "gain": {"pC_per_unit": {"A": 0.2, "B": 0.1, "C": 0.3}, "offset": 5},
    }


def test_doctor_writes_the_order_of_the_channels_found_by_presses(film, models, command, tmp_path, monkeypatch):
    """The wires of two electrodes are swapped. The file that doctor writes assigns the right channels."""
    path = tmp_path / "board.toml"

    def find_channels(port, device, channels, ask, unit, rest_span):
        ask("press near electrode A")
        assert port.read(10.0).data
        assert (device.channels, unit) == (channels, "pC")
        assert 0.0 < rest_span < 20.0
        return ElectrodeCheck(channels, {"A": "2", "B": "1", "C": "3"}, ())

    monkeypatch.setattr(doctor, "check_electrodes", find_channels)
    with sensor_with_wiring(film.charges, film.directions, (1, 0, 2), first_rest_s=60.0) as sensor:
        words = ("--port", sensor.url, "--seconds", 1, "--check-electrodes", "--write", path)
        code, out, err = command("serve", "doctor", *words, "--model", "linear", "--models", models)
    assert code == 0, err
    assert "the channels of A, B are in another order" in out
    assert "press near electrode A" in err
    assert "use it with: isocharge serve stream linear --port " in err
    assert dict(load_device(path).channels) == {"A": "2", "B": "1", "C": "3"}


def test_doctor_does_not_write_a_file_from_a_touched_film(film, command, tmp_path):
    path = tmp_path / "board.toml"
    for first_rest_s in (0.5, 0.001):  # the press begins while doctor listens; it ends then
        with sensor_with_wiring(film.charges, film.directions, (0, 1, 2), first_rest_s=first_rest_s) as sensor:
            code, out, err = command("serve", "doctor", "--port", sensor.url, "--seconds", 3, "--write", path)
        assert code == 1
        assert "an untouched film: channel " in out
        assert "no device file can be written, because the film was touched: take the finger away, and try again" in err
        assert not path.exists()
