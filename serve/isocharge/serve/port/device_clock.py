"""Conversion of the clock of a device to the time of the host. The wraps of the clock are removed first.

Arrival times jitter with the delays of the kernel, the cable and the reading program. The clock of the device does not
jitter, but its rate differs from the rate of the clock of the host. A delay-locked loop of second order (Adriaensen,
"Using a DLL to filter time", 2005) follows the arrivals with a small bandwidth. The loop computes a smooth host time
for each reading. The bandwidth is larger in the first seconds, so that the loop locks soon.
"""

import math
from typing import NamedTuple

BANDWIDTH_Hz = 0.05
"""Bandwidth of the loop, Hz. A jitter of 1 ms is reduced to 0.2 ms."""

FIRST_BANDWIDTH_Hz = 1.0
"""Bandwidth at the start, Hz. The bandwidth falls in inverse proportion to the time."""

MAX_LOOP_GAIN = 0.5
"""Largest gain of the loop in an update, dimensionless. It keeps the loop stable if readings are rare."""

MAX_DEVIATION_s = 1.0
"""Largest difference between an arrival and its prediction, s.

After a larger difference, the fit starts again, because a clock was set or the device was reset.
"""


class ReadingTime(NamedTuple):
    """Time at which a reading was taken.

    Attributes:
        host_s: Time of the host, unix seconds. It is computed from the clock of the device, or is the arrival time if
            the device sends no clock. It decreases only if a new fit begins because a clock was set.
        device_us: Clock of the device without its wraps, us; None if the device sends no clock.
        step_s: Time since the previous reading, s; 0 for the first reading after a start.
    """

    host_s: float
    device_us: int | None
    step_s: float

    @property
    def clock_s(self) -> float:
        """Clock of the device if it sends one, otherwise the arrival, s.

        All readings of a stream use the same clock.
        """
        return self.host_s if self.device_us is None else self.device_us * 1e-6


class DeviceClock:
    """Clock of one device. The method `read` must be called for every reading in order.

    Attributes:
        rate: Seconds of the host per second of the device.
        restarts: Number of times that the clock of the device jumped back, or ahead of the arrival.
    """

    def __init__(self) -> None:
        """Begin without a reading."""
        self.rate = 1.0
        self.restarts = 0
        self.reset()

    def reset(self) -> None:
        """Treat the next reading as the first reading of a new connection."""
        self._raw_us: int | None = None  # clock of the latest reading as it was sent
        self._device_us = 0  # clock of the latest reading without wraps
        self._last_arrival_s: float | None = None  # arrival of the latest reading without a clock
        self._chunk_arrival_s: float | None = None  # arrival of the latest chunk

        # In the fit, the time `_fitted_us` of the device is the host time `_fitted_host_s`.
        self._fitted_us: int | None = None
        self._fitted_host_s = 0.0
        self._fit_age_s = 0.0  # time since the beginning of the fit
        self._is_first_fit = True
        self._latest_host_s = -math.inf  # host time of the latest reading, which must not decrease

    def read(self, t_us: int | None, modulus: int, arrived_s: float) -> ReadingTime:
        """Return the time at which the next reading was taken, and the time since the previous reading.

        If the device sends a clock, the time is the clock converted to host time by the fit. Otherwise the time is the
        arrival of the chunk.

        Args:
            t_us: Clock as the device sent it, us; None if the device sends no clock.
            modulus: Time at which the clock wraps to 0, us.
            arrived_s: Arrival of the chunk that contains the reading, unix seconds.
        """
        # Without a clock, the time of the reading is the arrival.
        if t_us is None:
            step_s = 0.0  # for the first reading
            if self._last_arrival_s is not None:
                step_s = max(0.0, arrived_s - self._last_arrival_s)
            self._last_arrival_s = arrived_s
            return ReadingTime(arrived_s, None, step_s)

        step_us = self._advance(t_us, modulus)  # time since the previous reading
        if self._is_ahead_of(arrived_s):
            self.restarts += 1
            self._fitted_us = None  # the fit starts again from this reading
            step_us = 0

        # Without a fit, the arrival is the time of this reading until the next chunk arrives.
        if self._fitted_us is None:
            self._fitted_us = self._device_us
            self._fitted_host_s = max(arrived_s, self._latest_host_s)
            self._is_first_fit = True

        # The host time must not decrease, although a correction of the fit may move the prediction back.
        self._latest_host_s = max(self._latest_host_s, self._predict(self._device_us))
        return ReadingTime(self._latest_host_s, self._device_us, step_us * 1e-6)

    def _is_ahead_of(self, arrived_s: float) -> bool:
        """Return whether the fitted clock is so far ahead of an arrival that the clock must have been set.

        The chunks of a file all arrive at the same time, so their arrival contains no information about the clock.

        Args:
            arrived_s: Arrival of the chunk, unix seconds.
        """
        is_new_arrival = self._chunk_arrival_s not in (None, arrived_s)
        if self._fitted_us is None or not is_new_arrival:
            return False
        return self._predict(self._device_us) - arrived_s > MAX_DEVIATION_s

    def arrived(self, arrival_s: float) -> None:
        """Fit the clock to the arrival of a chunk, after `read` was called for the last reading of the chunk.

        If the readings come from a file, all chunks have the same arrival time. An arrival time is therefore used only
        if it differs from the previous one.

        Args:
            arrival_s: Arrival of the chunk, unix seconds.
        """
        previous_arrival_s = self._chunk_arrival_s
        self._chunk_arrival_s = arrival_s
        is_first_arrival = previous_arrival_s is None
        is_repeated = previous_arrival_s == arrival_s
        if self._fitted_us is None or is_first_arrival or is_repeated:
            return

        delay_s = arrival_s - self._predict(self._device_us)
        was_clock_set = abs(delay_s) > MAX_DEVIATION_s
        if was_clock_set:
            self._latest_host_s = -math.inf  # the host time may decrease here
        if was_clock_set or self._is_first_fit:
            self._begin_fit(arrival_s)
        else:
            step_s = (self._device_us - self._fitted_us) * 1e-6
            self._continue_fit(delay_s, step_s)
        self._fitted_us = self._device_us

    def _begin_fit(self, arrival_s: float) -> None:
        """Begin a new fit at the arrival of a chunk, unix seconds."""
        self._fitted_host_s = arrival_s
        self._fit_age_s = 0.0
        self.rate = 1.0
        self._is_first_fit = False

    def _continue_fit(self, delay_s: float, step_s: float) -> None:
        """Correct the fit by one step of a delay-locked loop of second order (Adriaensen 2005).

        With w = 2 pi bandwidth step_s, the fitted host time is predicted + sqrt(2) w delay_s, and the rate of the clock
        increases by w^2 delay_s / step_s. The bandwidth falls as the fit gets older. A large w is limited, because the
        loop would become unstable.

        Args:
            delay_s: Time of the arrival minus its prediction, s.
            step_s: Time of the device since the previous step, s.
        """
        self._fit_age_s += step_s
        bandwidth_Hz = max(BANDWIDTH_Hz, FIRST_BANDWIDTH_Hz / (1.0 + self._fit_age_s))
        loop_gain = min(MAX_LOOP_GAIN, 2.0 * math.pi * bandwidth_Hz * step_s)
        self._fitted_host_s = self._predict(self._device_us) + math.sqrt(2.0) * loop_gain * delay_s
        if step_s > 0.0:
            self.rate += loop_gain**2 * delay_s / step_s

    def _predict(self, device_us: int) -> float:
        """Return the host time, unix seconds, at a time of the device, us."""
        return self._fitted_host_s + self.rate * (device_us - (self._fitted_us or 0)) * 1e-6

    def _advance(self, t_us: int, modulus: int) -> int:
        """Advance the clock without wraps to the next reading, and return the time since the previous reading, us.

        The result is 0 for the first reading. If the clock jumped back, or ahead by more than half of its range, the
        device has restarted. The fit then starts again, and the result is also 0.

        Args:
            t_us: Clock of the device as it was sent, us.
            modulus: Time at which the clock wraps to 0, us.
        """
        previous_us = self._raw_us
        self._raw_us = t_us
        if previous_us is not None:
            step_us = (t_us - previous_us) % modulus
            if step_us < modulus // 2:
                self._device_us += step_us
                return step_us
            self.restarts += 1

        # This is the first reading after a start.
        self._device_us = t_us
        self._fitted_us = None
        return 0
