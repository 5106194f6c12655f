"""Clock of a device, compared with simulated devices of known rate and jitter."""

import numpy as np
import pytest

from isocharge.serve.port.device_clock import DeviceClock

MODULUS = 2**32
START_S = 1_700_000_000.0


def follow(t_us, arrived_s):
    """Read times of a device that arrive one by one, and return the clock and the times of the readings."""
    clock = DeviceClock()
    times = []
    for device_us, arrival_s in zip(t_us, arrived_s, strict=True):
        times.append(clock.read(int(device_us) % MODULUS, MODULUS, arrival_s))
        clock.arrived(arrival_s)
    return clock, times


def test_device_clock_unwraps():
    t_us = np.arange(2**32 - 50_000, 2**32 + 50_000, 1000)
    clock, times = follow(t_us, START_S + t_us * 1e-6)
    assert [time.device_us for time in times] == t_us.tolist()
    assert clock.restarts == 0
    assert [time.step_s for time in times] == pytest.approx([0.0] + [1e-3] * 99)


@pytest.mark.parametrize("ppm", [0.0, 150.0, -2000.0])
def test_fit_follows_the_rate_and_smooths_the_jitter(ppm):
    """With a jitter of 1 ms, the fitted time has a fifth of the jitter, and the error of the rate is below 20 ppm."""
    t_s = np.arange(0.0, 120.0, 0.005)
    true_s = START_S + t_s * (1 + ppm * 1e-6)
    arrived_s = true_s + np.random.default_rng(0).normal(0.0, 1e-3, t_s.size)
    clock, times = follow(t_s * 1e6, arrived_s)
    fitted_s = np.array([time.host_s for time in times])
    error_s = (fitted_s - true_s)[t_s.size // 2 :]  # of the second minute
    assert np.std(error_s) < 0.2e-3
    assert abs(np.mean(error_s)) < 0.1e-3
    assert (clock.rate - 1.0) * 1e6 == pytest.approx(ppm, abs=20.0)


def test_clock_of_a_device_that_restarts():
    t_us = np.concatenate([np.arange(1000) * 1000, np.arange(1000) * 1000])
    arrived_s = START_S + np.arange(2000) * 1e-3
    clock, times = follow(t_us, arrived_s)
    host_s = np.array([time.host_s for time in times])
    assert clock.restarts == 1
    assert times[1000].step_s == 0.0
    assert np.abs(host_s - arrived_s).max() < 1e-3


def test_clock_of_a_device_that_jumps_ahead():
    """After a jump by twelve minutes, the host time follows the arrivals, and no step is longer than the others."""
    t_us = np.arange(2000) * 1000
    t_us[1000:] += 700_000_000
    clock, times = follow(t_us, START_S + np.arange(2000) * 1e-3)
    np.testing.assert_allclose(np.diff([time.host_s for time in times]), 1e-3, atol=1e-3)
    assert clock.restarts == 1
    assert max(time.step_s for time in times) == pytest.approx(1e-3)


def test_times_never_decrease():
    """Chunks of one to eight readings arrive with random delays. The device restarts once, after 7000 readings."""
    rng = np.random.default_rng(0)
    clock = DeviceClock()
    host_s = []
    starts = np.cumsum(rng.integers(1, 9, 3000))
    delays_s = rng.exponential(0.05, starts.size)
    for start, stop, delay_s in zip(starts, starts[1:], delays_s, strict=False):
        arrived_s = START_S + 0.004 * stop + delay_s
        for number in range(start, stop):
            t_us = 4000 * int(number % 7000)
            host_s.append(clock.read(t_us, MODULUS, arrived_s).host_s)
        clock.arrived(arrived_s)
    assert np.diff(host_s).min() >= 0.0
    assert clock.restarts == 1


def test_readings_of_one_chunk_are_spread_by_the_device_clock():
    clock = DeviceClock()
    host_s = []
    for chunk in range(200):
        arrived_s = START_S + 0.016 * (chunk + 1)
        numbers = range(16 * chunk, 16 * chunk + 16)
        host_s += [clock.read(1000 * number, MODULUS, arrived_s).host_s for number in numbers]
        clock.arrived(arrived_s)
    np.testing.assert_allclose(np.diff(host_s)[160:], 1e-3, rtol=1e-3)


def test_time_without_a_device_clock_is_the_arrival():
    clock = DeviceClock()
    times = [clock.read(None, MODULUS, START_S + arrival_s) for arrival_s in (0.0, 0.01, 0.03)]
    assert [time.device_us for time in times] == [None] * 3
    assert [time.host_s - START_S for time in times] == pytest.approx([0.0, 0.01, 0.03])
    assert [time.step_s for time in times] == pytest.approx([0.0, 0.01, 0.02])
