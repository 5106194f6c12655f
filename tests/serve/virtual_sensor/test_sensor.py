"""Virtual sensor: complete frames at their times, requested faults, and independence of readers.

Most tests examine the frames without a port and without waiting for their times.
"""

import threading
import time
from itertools import islice

import numpy as np
import pytest
import serial

from isocharge.common.errors import SceneError
from isocharge.serve import BinaryParser, Faults, Port, Script, VirtualSensor, encode_frame, wander


def steady(n=10, rate_Hz=200.0):
    return Script(np.tile([0.0, 0.0, 1.0], (n, 1)), rate_Hz)


def sent(sensor, count):
    """Return the next frames of a sensor without its port; None for a frame that is not sent."""
    return [next(iter(BinaryParser().feed(data)), None) for data in islice(sensor.frames(), count)]


def test_frames_contain_the_repeated_script_with_offset_and_amplifier(film):
    """The amplifier of this test counts the rows that it has received, in the order of time."""
    seen = []

    def noise(charge_pC, _):
        first = sum(map(len, seen))
        seen.append(charge_pC)
        return charge_pC + np.arange(first, first + len(charge_pC))[:, None]

    script = Script(np.array([[1.0, 2.0, 0.5], [np.nan, np.nan, 0.0]]), 1000.0)
    frames = sent(VirtualSensor(film.charges, script, noise=noise, offset_pC=[10.0, 20.0, 30.0]), 1200)
    clean = np.tile([film.charge_pC([1.0], [2.0], [0.5])[0] + [10.0, 20.0, 30.0], [10.0, 20.0, 30.0]], (600, 1))
    np.testing.assert_allclose([frame.values for frame in frames], clean + np.arange(1200)[:, None], rtol=1e-6)
    assert {len(block) for block in seen} == {500}  # half a second


def test_damaged_frames_are_counted(film):
    sensor = VirtualSensor(film.charges, steady(), faults=Faults(corrupt_share=0.001))
    frames = zip(sensor.frames(), VirtualSensor(film.charges, steady()).frames(), strict=True)
    damaged_count = sum(sent_bytes != undamaged for sent_bytes, undamaged in islice(frames, 2000))
    assert sensor.corrupted == damaged_count
    assert 10 < damaged_count < 200


def test_frame_number_and_clock_overflow(film):
    """The clock in us has 32 bits and wraps after 4294.97 s. The sensor sends one frame per second."""
    frames = []
    sensor = VirtualSensor(film.charges, steady(10, 1.0), encode=lambda frame: bytes(frames.append(frame) or 1))
    assert sum(map(len, islice(sensor.frames(), 65_540))) == 65_540
    assert (frames[65_535].seq, frames[65_536].seq) == (65_535, 0)
    assert frames[4295].t_us == 4_295_000_000 - 2**32


@pytest.mark.parametrize("charges", [np.zeros(3), np.zeros((2, 3)), np.full((10, 3), np.nan)])
def test_forward_map_with_wrong_charges_is_refused(charges):
    with pytest.raises(SceneError, match=r"forward map: expected finite charges of shape \(10, electrodes\)"):
        VirtualSensor(lambda *_: charges, steady())


def read(url, count):
    """Return the next frames from a port, and the counters of the parser."""
    parser = BinaryParser()
    with Port(url, silence_s=10.0) as port:
        frames = list(islice((frame for chunk in port for frame in parser.feed(chunk.data)), count))
    for frame in frames:
        parser.sequence_flags(frame.seq)
    return frames, parser.counts


class TimedEncoder:
    """Frame format that stores when each frame was encoded, s. The next frame is encoded after a frame was sent."""

    def __init__(self, stall_s=0.0):
        self.times_s = []
        self.stall_s = stall_s  # before frame 100

    def __call__(self, frame):
        if frame.seq == 100:
            time.sleep(self.stall_s)
        self.times_s.append(time.perf_counter())
        return encode_frame(frame)


def test_frames_are_sent_on_time(film):
    encode = TimedEncoder()
    with VirtualSensor(film.charges, wander(seed=3, seconds=2.0, rate_Hz=1000.0), encode=encode) as sensor:
        read(sensor.url, 1200)
    late_s = np.array(encode.times_s) - np.arange(len(encode.times_s)) / 1000.0
    drift_s = late_s[-300:].min() - late_s[:300].min() - sensor.paused_s  # a busy machine postpones the later frames
    assert drift_s < 0.02  # 0.05 if it slept for the time between two frames


def test_frames_after_a_stall_of_the_process_are_postponed_and_not_sent_in_a_burst(film):
    """The stall is as long as 200 frames. Without a pause, these frames would be sent within a few milliseconds."""
    encode = TimedEncoder(stall_s=0.4)
    with VirtualSensor(film.charges, steady(rate_Hz=500.0), encode=encode) as sensor:
        read(sensor.url, 300)
        assert sensor.paused_s > 0.3
    since_stall_s = np.array(encode.times_s[101:]) - encode.times_s[101]
    assert (since_stall_s > np.arange(len(since_stall_s)) / 500.0 - 0.06).all()  # a frame may be late by 0.05 s


def test_frames_are_withheld_without_a_reader(film):
    """Frames that do not fit into the buffer are withheld completely. A later reader receives no damaged frame.

    On a busy machine, the operating system may cut the first frame when it empties the buffer for a new reader. When
    the sensor plays again, its first frame waits until the counters have been read.
    """
    may_send = threading.Event()
    may_send.set()

    def encode(frame):
        may_send.wait()
        return encode_frame(frame)

    with VirtualSensor(film.charges, steady(rate_Hz=2000.0), encode=encode) as sensor:
        while sensor.withheld < 100:
            time.sleep(0.01)
        for _ in range(2):
            played_count = sensor.sent + sensor.withheld
            frames, counts = read(sensor.url, 200)
            assert frames[0].seq >= played_count  # frames that were sent before the port was opened are discarded
            assert counts.crc_errors + counts.malformed <= 1
            assert (counts.repeated, counts.restarts) == (0, 0)
        assert sensor.sent >= 400
    may_send.clear()
    with sensor:
        first_counts = (sensor.sent, sensor.withheld)
        may_send.set()
        assert first_counts == (0, 0)
        frames, _ = read(sensor.url, 3)
        assert frames[0].seq < sensor.sent + sensor.withheld  # the frame numbers begin at 0 again


def test_bytes_that_a_sensor_ignores_do_not_block_their_sender(film):
    sensor = VirtualSensor(film.charges, steady(rate_Hz=500.0))
    with sensor, serial.Serial(sensor.url, write_timeout=10.0) as line:
        for _ in range(100):
            line.write(b"?" * 2000)
