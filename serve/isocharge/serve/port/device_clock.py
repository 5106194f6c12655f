"""The device's clock: unwrapped, and fitted to the host's.

Arrival times jitter with the delays of kernel, cable and reader. The device's clock does not jitter, but its rate
differs from the host's. A delay-locked loop of second order (Adriaensen, "Using a DLL to filter time", 2005) follows
the arrivals with a small bandwidth and gives each reading a smooth host time. The bandwidth is larger in the first
seconds, so that the loop locks soon.
"""

import math
from typing import NamedTuple

BANDWIDTH_HZ = 0.05
"""Bandwidth of the loop, Hz: a jitter of 1 ms leaves 0.2 ms."""

FIRST_BANDWIDTH_HZ = 1.0
"""Bandwidth at the start, Hz; it falls as the inverse of the time."""

LOST_S = 1.0
"""Difference of arrival and prediction, s, from which the fit starts over: a clock was set or the device restarted."""


class ReadingTime(NamedTuple):
    """When a reading was taken.

    Attributes:
        host_s: Unix seconds: the device's clock fitted to the arrivals, or the arrival if the device sends no clock.
            It falls only where a new fit begins, because a clock was set.
        device_us: The device's clock without its wraps, us; None if the device sends none.
        step_s: Since the reading before, s; 0 for the first one after a start.
    """

    host_s: float
    device_us: int | None
    step_s: float

    @property
    def clock_s(self) -> float:
        """The device's clock if it sends one, or else the arrival, s: times of one stream on one clock."""
        return self.host_s if self.device_us is None else self.device_us * 1e-6


class DeviceClock:
    """Clock of one device; it must see every reading, in order.

    Attributes:
        rate: Host seconds per device second.
        restarts: Times that the device's clock jumped back, or ahead to what has not come yet.
    """

    def __init__(self) -> None:
        self.rate = 1.0
        self.restarts = 0
        self.forget()

    def forget(self) -> None:
        """The next reading is the first one of a new connection."""
        self._raw_us: int | None = None
        self._device_us = 0
        self._host_s = 0.0
        self._fitted_us: int | None = None
        self._age_s = 0.0
        self._last_s: float | None = None
        self._is_first, self._latest_s = True, -math.inf
        self._arrived_s: float | None = None

    def read(self, t_us: int | None, modulus: int, arrived_s: float) -> ReadingTime:
        """The time of the next reading.

        Args:
            t_us: The device's clock as sent, us; None if it sends none.
            modulus: The time at which it wraps to 0, us.
            arrived_s: When the reading's chunk arrived, unix s.
        """
        if t_us is None:
            step_s = 0.0 if self._last_s is None else max(0.0, arrived_s - self._last_s)
            self._last_s = arrived_s
            return ReadingTime(arrived_s, None, step_s)
        step_us = self._unwrap(t_us, modulus)
        is_later = self._arrived_s not in (None, arrived_s)  # not a chunk of a file
        if self._fitted_us is not None and is_later and self._predict(self._device_us) - arrived_s > LOST_S:
            self.restarts, self._fitted_us, step_us = self.restarts + 1, None, 0
        if self._fitted_us is None:
            self._host_s, self._fitted_us, self._is_first = max(arrived_s, self._latest_s), self._device_us, True
        self._latest_s = max(self._latest_s, self._predict(self._device_us))
        return ReadingTime(self._latest_s, self._device_us, step_us * 1e-6)

    def arrived(self, at_s: float) -> None:
        """Fit the clock to the arrival (unix s) of the chunk whose last reading was the latest one.

        The chunks of a file arrive all at once, which says nothing; so the first one alone says nothing either.
        """
        before_s, self._arrived_s = self._arrived_s, at_s
        if self._fitted_us is None or before_s in (None, at_s):
            return
        late_s = at_s - self._predict(self._device_us)
        is_lost = abs(late_s) > LOST_S
        if is_lost or self._is_first:
            self._host_s, self._fitted_us, self._age_s, self.rate = at_s, self._device_us, 0.0, 1.0
            self._latest_s, self._is_first = -math.inf if is_lost else self._latest_s, False
            return
        step_s = (self._device_us - self._fitted_us) * 1e-6
        self._age_s += step_s
        turn = min(0.5, 2.0 * math.pi * max(BANDWIDTH_HZ, FIRST_BANDWIDTH_HZ / (1.0 + self._age_s)) * step_s)
        self._host_s = self._predict(self._device_us) + math.sqrt(2.0) * turn * late_s
        self.rate += turn * turn * late_s / step_s if step_s > 0.0 else 0.0
        self._fitted_us = self._device_us

    def _predict(self, device_us: int) -> float:
        return self._host_s + self.rate * (device_us - (self._fitted_us or 0)) * 1e-6

    def _unwrap(self, t_us: int, modulus: int) -> int:
        """Step since the reading before, us; 0 where the clock jumped back or ahead by half its range."""
        last, self._raw_us = self._raw_us, t_us
        step = 0 if last is None else (t_us - last) % modulus
        if last is None or step >= modulus // 2:
            self.restarts += last is not None
            self._device_us, self._fitted_us = t_us, None
            return 0
        self._device_us += step
        return step
