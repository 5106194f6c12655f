"""Clock of a device, compared with simulated devices of known rate and jitter."""

import math

import numpy as np
import pytest

from isocharge.serve import Frame
from isocharge.serve.frames.device_clock import DeviceClock
from isocharge.serve.port.file_source import Chunk
from isocharge.serve.port.serial_line import MAX_READ_BYTES

MODULUS = 2**32
START_S = 1_700_000_000.0


def chunk_at(monotonic_s, wall_s=None):
    """Return a chunk that arrives at a monotonic time; the wall clock shows another time only if it is given."""
    return Chunk(b"x", START_S + (monotonic_s if wall_s is None else wall_s), round(monotonic_s * 1e9))


def read(clock, chunk, t_us, modulus=MODULUS):
    """Return frames with the clock values of a device, after the clock has stamped them."""
    frames = [Frame(None, device_us, ()) for device_us in t_us]
    clock.stamp(chunk, frames, modulus)
    return frames


def follow(t_us, arrived_s):
    """Read times of a device that arrive one by one, and return the clock and the times of the readings."""
    clock = DeviceClock()
    times = []
    for device_us, arrival_s in zip(t_us, arrived_s, strict=True):
        times += read(clock, chunk_at(arrival_s - START_S), [int(device_us) % MODULUS])
    return clock, times


@pytest.mark.parametrize("ppm", [150.0, -2000.0])
def test_fit_follows_the_rate_and_smooths_the_jitter(ppm):
    """With a jitter of 1 ms, the fitted time has a fifth of the jitter, and the error of the rate is below 20 ppm."""
    t_s = np.arange(0.0, 120.0, 0.005)
    true_s = START_S + t_s * (1 + ppm * 1e-6)
    clock, times = follow(t_s * 1e6, np.random.default_rng(0).normal(true_s, 1e-3))
    error_s = ([time.host_s for time in times] - true_s)[t_s.size // 2 :]  # of the second minute
    assert np.std(error_s) < 0.2e-3
    assert abs(np.mean(error_s)) < 0.1e-3
    assert (clock.rate - 1.0) * 1e6 == pytest.approx(ppm, abs=20.0)


def test_old_readings_in_the_first_chunk_do_not_freeze_the_time():
    """A board has stored readings ten minutes before the port was opened, and sends them first."""
    clock = DeviceClock()
    read(clock, chunk_at(0.0), [1_000_000, 1_005_000, 601_000_000])
    arrived_s = 0.005 * np.arange(1, 400)
    host_s = [read(clock, chunk_at(t), [601_000_000 + round(t * 1e6)])[0].host_s for t in arrived_s]
    assert np.max(host_s[1:] - (START_S + arrived_s[1:])) < 0.31
    np.testing.assert_allclose(host_s[100:], START_S + arrived_s[100:], atol=1e-3)


@pytest.mark.parametrize(
    ("jump_us", "n_resets"),
    # The first and the last jump are restarts, the last one after half of the range.
    [(-2_000_000, 1), (700_000_000, 0), (800_000, 0), (-3_000_000_000, 1)],
)
def test_clock_of_a_device_that_jumps(jump_us, n_resets):
    """After a jump, the host time follows the arrivals. Readings that were lost during a pause make a step longer."""
    t_us = 3_001_000_000 + np.arange(2000) * 1000
    t_us[1000:] += jump_us
    _, times = follow(t_us, START_S + np.arange(2000) * 1e-3)
    np.testing.assert_allclose(np.diff([time.host_s for time in times]), 1e-3, atol=1e-3)
    assert max(time.dt_s for time in times) == pytest.approx(1e-3 + max(jump_us, 0) * 1e-6)
    assert sum(time.is_clock_reset for time in times) == n_resets


def test_readings_that_waited_for_a_slow_program_have_the_times_at_which_they_were_taken():
    clock = DeviceClock()
    errors_s = []
    for number in range(120):
        late_s = 0.1 * max(0, number - 60)  # from then on, more bytes wait than a chunk can contain
        chunk = chunk_at(0.1 * number + late_s)._replace(data=bytes(MAX_READ_BYTES if late_s else 1))
        (frame,) = read(clock, chunk, [100_000 * number])
        errors_s.append(frame.host_s - START_S - 0.1 * number)
    np.testing.assert_allclose(errors_s, 0.0, atol=1e-3)


def test_late_reading_does_not_change_the_number_of_wraps():
    """Two readings after a wrap are swapped."""
    t_us = [MODULUS - 50_000 + 5000 * number for number in range(20)]
    t_us[15], t_us[16] = t_us[16], t_us[15]
    _, times = follow(t_us, START_S + 0.005 * np.arange(20))
    assert [time.device_us for time in times] == t_us
    assert min(time.dt_s for time in times) == 0.0
    assert not any(time.is_clock_reset for time in times)


@pytest.mark.parametrize(("start_us", "modulus"), [(0, 2**16), (-500_000, MODULUS)])
def test_clock_of_16_bits_in_us_may_wrap_at_each_reading_and_a_clock_with_a_sign_may_begin_below_zero(
    start_us, modulus
):
    """The first clock wraps after 65.536 ms. The readings have intervals of 50 ms."""
    clock = DeviceClock()
    for t_us in range(start_us, start_us + 1_000_000, 50_000):
        (time,) = read(clock, chunk_at(1e-6 * t_us), [int(math.fmod(t_us, modulus))], modulus)
        assert (time.device_us, time.dt_s) == (t_us, (t_us > start_us) * 50_000 * 1e-6)


def test_times_never_decrease():
    """Chunks of one to eight readings arrive with random delays. The device restarts once, after 7000 readings."""
    rng = np.random.default_rng(0)
    clock = DeviceClock()
    host_s = []
    stop = 0
    for n_readings, delay_s in zip(rng.integers(1, 9, 3000), rng.exponential(0.05, 3000), strict=True):
        t_us = [4000 * (number % 7000) for number in range(stop, stop + int(n_readings))]
        stop += len(t_us)
        host_s += [time.host_s for time in read(clock, chunk_at(0.004 * stop + delay_s), t_us)]
    assert np.diff(host_s).min() >= 0.0


def test_readings_without_a_device_clock_share_the_time_between_chunks():
    clock = DeviceClock()
    times = []
    for arrival_s, n_readings in ((0.0, 2), (0.01, 1), (0.015, 0), (1.01, 200)):
        times += read(clock, chunk_at(arrival_s), [None] * n_readings)
    assert {time.device_us for time in times} == {None}
    assert [time.dt_s for time in times] == pytest.approx([0.005, 0.005, 0.01] + [0.005] * 200)
    expected_s = START_S + np.arange(0.01, 1.0125, 0.005)
    for name in ("host_s", "clock_s"):
        np.testing.assert_allclose([getattr(time, name) for time in times[2:]], expected_s, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("jump_s", [3600.0, -0.5, 8e10])
@pytest.mark.parametrize("has_clock", [False, True])
def test_wall_clock_that_is_set_changes_no_step(jump_s, has_clock):
    """The time stamps of the records follow the wall clock, and the integration of the leak does not see the jump."""
    clock = DeviceClock()
    times = []
    for number in range(400):
        monotonic_s = 0.005 * number
        chunk = chunk_at(monotonic_s, monotonic_s + jump_s * (number >= 200))
        times += read(clock, chunk, [5000 * number if has_clock else None])
    assert [time.dt_s for time in times[1:]] == pytest.approx([0.005] * 399)
    np.testing.assert_allclose(np.diff([time.clock_s for time in times]), 0.005, atol=1e-6)
    assert times[-1].host_s - START_S == pytest.approx(1.995 + jump_s, abs=0.2)


def test_chunks_without_a_monotonic_time_are_timed_by_their_arrivals():
    clock = DeviceClock()
    times = []
    for arrival_s in (0.0, 0.01, 0.03, 0.02):
        times += read(clock, Chunk(b"x", START_S + arrival_s, 0), [None])
    expected_s = [0.01, 0.02, clock.FILE_INTERVAL_s]
    assert [time.dt_s for time in times[1:]] == pytest.approx(expected_s)
    assert np.diff([time.clock_s for time in times]) == pytest.approx(expected_s, abs=1e-6)
