"""The device's clock against a device whose rate and jitter are known."""

import numpy as np
import pytest

from isocharge.serve.port.device_clock import DeviceClock

MODULUS, START_S = 2**32, 1_700_000_000.0


def follow(t_us, arrived_s, modulus=MODULUS):
    clock = DeviceClock()
    times = []
    for device, host in zip(t_us, arrived_s, strict=True):
        times.append(clock.read(int(device) % modulus, modulus, host))
        clock.arrived(host)
    return clock, times


def test_device_clock_unwraps():
    t_us = np.arange(2**32 - 50_000, 2**32 + 50_000, 1000)
    clock, times = follow(t_us, START_S + t_us * 1e-6)
    assert ([time.device_us for time in times], clock.restarts) == (t_us.tolist(), 0)
    assert [time.step_s for time in times] == pytest.approx([0.0] + [1e-3] * 99)


@pytest.mark.parametrize("ppm", [0.0, 150.0, -2000.0])
def test_fit_follows_the_rate_and_smooths_the_jitter(ppm):
    """Jitter of 1 ms; the fitted time has a fifth of it, and the rate is known to 20 ppm after two minutes."""
    t_s = np.arange(0.0, 120.0, 0.005)
    true_s = START_S + t_s * (1 + ppm * 1e-6)
    arrived_s = true_s + np.random.default_rng(0).normal(0.0, 1e-3, t_s.size)
    clock, times = follow(t_s * 1e6, arrived_s)
    fitted_s = np.array([time.host_s for time in times])
    late = slice(t_s.size // 2, None)
    assert np.std((fitted_s - true_s)[late]) < 0.2e-3
    assert abs(np.mean((fitted_s - true_s)[late])) < 0.1e-3
    assert (clock.rate - 1.0) * 1e6 == pytest.approx(ppm, abs=20.0)


def test_clock_of_a_device_that_restarts():
    t_us = np.concatenate([np.arange(1000) * 1000, np.arange(1000) * 1000])
    arrived_s = START_S + np.arange(2000) * 1e-3
    clock, times = follow(t_us, arrived_s)
    assert (clock.restarts, times[1000].step_s) == (1, 0.0)
    assert np.abs(np.array([time.host_s for time in times]) - arrived_s).max() < 1e-3


def test_clock_of_a_device_that_jumps_ahead():
    """By twelve minutes: the reading is as late as it arrived, and no step is as long."""
    t_us = np.arange(2000) * 1000
    t_us[1000:] += 700_000_000
    clock, times = follow(t_us, START_S + np.arange(2000) * 1e-3)
    np.testing.assert_allclose(np.diff([time.host_s for time in times]), 1e-3, atol=1e-3)
    assert (clock.restarts, max(time.step_s for time in times)) == (1, pytest.approx(1e-3))


def test_times_never_decrease():
    """However late chunks of one to eight readings are; and from a restart of the device on neither."""
    rng, clock, host_s = np.random.default_rng(0), DeviceClock(), []
    begins = np.cumsum(rng.integers(1, 9, 3000))
    for first, after, late_s in zip(begins, begins[1:], rng.exponential(0.05, begins.size), strict=False):
        arrived_s = START_S + 0.004 * after + late_s
        host_s += [clock.read(4000 * int(k % 7000), MODULUS, arrived_s).host_s for k in range(first, after)]
        clock.arrived(arrived_s)
    assert np.diff(host_s).min() >= 0.0
    assert clock.restarts == 1


def test_readings_of_one_chunk_are_spread_by_the_device_clock():
    clock, host_s = DeviceClock(), []
    for chunk in range(200):
        arrived_s = START_S + 0.016 * (chunk + 1)
        host_s += [clock.read(1000 * (16 * chunk + k), MODULUS, arrived_s).host_s for k in range(16)]
        clock.arrived(arrived_s)
    np.testing.assert_allclose(np.diff(host_s)[160:], 1e-3, rtol=1e-3)


def test_time_without_a_device_clock_is_the_arrival():
    clock = DeviceClock()
    times = [clock.read(None, MODULUS, START_S + host) for host in (0.0, 0.01, 0.03)]
    assert [time.device_us for time in times] == [None] * 3
    assert [time.host_s - START_S for time in times] == pytest.approx([0.0, 0.01, 0.03])
    assert [time.step_s for time in times] == pytest.approx([0.0, 0.01, 0.02])
