"""Conversion of the clock of a device to the time of the host.

Many devices send a counter that wraps to 0 when it overflows. The wraps are removed before the conversion.

The arrival times of readings at the host fluctuate with the delays of the kernel, the cable and the reading program.
The clock of the device does not fluctuate, but it runs at a slightly different rate than the clock of the host. A
second-order delay-locked loop (Adriaensen, "Using a DLL to filter time", 2005) fits the clock of the device to the
arrival times, and computes a smooth host time for each reading. The bandwidth of the loop is small, so that the loop
averages over many arrivals. In the first seconds, the bandwidth is larger, so that the fit converges quickly.

The wall clock of the host may be set while a stream runs. The time between two readings is therefore never computed
from the wall clock. If the device sends no clock, the time between two readings is computed from the monotonic arrival
times of the chunks.
"""

import math
from collections.abc import Sequence

from isocharge.serve.frames.frame import Frame
from isocharge.serve.port.file_source import Chunk
from isocharge.serve.port.serial_line import MAX_READ_BYTES

BANDWIDTH_Hz = 0.05
"""Bandwidth of the loop, Hz. A jitter of 1 ms is reduced to 0.2 ms."""

FIRST_BANDWIDTH_Hz = 1.0
"""Bandwidth when a fit begins, Hz. The bandwidth then decreases in inverse proportion to the age of the fit."""

MAX_LOOP_GAIN = 0.5
"""Largest gain of the loop in one correction, dimensionless. This limit keeps the loop stable if readings are rare."""

MAX_DELAY_s = 1.0
"""Largest time by which an arrival may be later than predicted, s.

After a longer delay, the fit starts again, because the device was reset, or one of the two clocks was set.
"""

MAX_LEAD_s = 0.3
"""Largest time by which an arrival may be earlier than predicted, s.

A reading cannot arrive before it was taken, so this limit is smaller than the limit of a delay.
"""


def elapsed_s(previous: Chunk, chunk: Chunk) -> float:
    """Return the time between the arrivals of two chunks of one source, at least 0 s.

    A chunk contains the bytes that arrived together, and the two times of their arrival: `timestamp` on the wall clock
    and `clock_ns` on a monotonic clock. The wall clock may be set at any time, so the monotonic clock is used, with two
    exceptions:

    - All chunks of a file have the same `timestamp`. The result is then 0.
    - If a source does not state a monotonic time, all its chunks have the same `clock_ns`. The wall clock is then used.

    Args:
        previous: The earlier chunk.
        chunk: The later chunk.
    """
    wall_s = chunk.timestamp - previous.timestamp
    monotonic_ns = chunk.clock_ns - previous.clock_ns
    if wall_s == 0.0 or monotonic_ns == 0:
        return max(0.0, wall_s)
    return max(0.0, monotonic_ns * 1e-9)


class DeviceClock:
    """Clock of one device, which is fitted to the time of the host.

    Call the method `stamp` for every chunk in order. A chunk consists of the bytes that arrived together.

    Attributes:
        rate: Seconds of the host per second of the device.
    """

    FILE_INTERVAL_s = 0.005
    """Assumed time between frames without a clock in a file, and in the first chunk of a port, s."""

    def __init__(self) -> None:
        """Start without a reading."""
        self.rate = 1.0
        self._latest_chunk: Chunk | None = None  # latest chunk with the end of a frame
        self._monotonic_s: float | None = None  # `clock_s` of the latest frame without a clock; never decreases
        self.reset()

    def reset(self) -> None:
        """Treat the next reading as the first reading of a new connection.

        The fit is a straight line that converts the clock of the device to the time of the host. The slope of the line
        is `rate`. The fit begins with the first reading.
        """
        self._device_us = 0  # clock of the latest reading after the wraps were removed
        self._latest_arrival_s: float | None = None  # arrival of the latest chunk that did not wait to be read
        self._is_new_arrival = False  # whether the present chunk arrived at another time than that chunk

        self._has_fit = False  # whether a reading with a clock has arrived
        # The line passes through this point: the host time was `_anchor_host_s` when the device clock was `_anchor_us`.
        self._anchor_us = 0
        self._anchor_host_s = 0.0
        self._fit_age_s = 0.0  # time since the beginning of the fit
        self._is_fit_provisional = True  # whether the fit relies on the arrival of only one chunk
        self._predicted_host_s = 0.0  # host time of the latest reading according to the line
        self._latest_host_s = -math.inf  # host time in the latest frame; does not decrease if the line is corrected

    def stamp(self, chunk: Chunk, frames: Sequence[Frame], modulus: int) -> None:
        """Write the times at which the frames of a chunk were taken into the frames, and adjust the clock to the chunk.

        Args:
            chunk: The bytes that contain the ends of the frames.
            frames: The frames, which are changed in place.
            modulus: Time at which the clock of the device wraps to 0, us.
        """
        if not frames:  # the time since the previous frames is divided when the next frame has ended
            return
        previous_chunk = self._latest_chunk or chunk  # the interval before the first chunk is 0
        self._latest_chunk = chunk
        interval_s = elapsed_s(previous_chunk, chunk)

        # All chunks of a file have the same arrival time, to which the clock must not be fitted. The arrival time of a
        # chunk is therefore new only if there was an earlier chunk, and if this chunk had another arrival time.
        self._is_new_arrival = self._latest_arrival_s not in (None, chunk.timestamp)

        # If the first frame has no clock, the times of all frames are estimated. Later frames of the chunk may have a
        # clock, because a header between lines of text can name it.
        if frames[0].t_us is None:
            self._estimate_times(interval_s, chunk.timestamp, frames)
        for frame in frames:
            if frame.t_us is not None:
                self._stamp_with_device(frame, frame.t_us, modulus, chunk.timestamp)

        # The bytes of a chunk of the largest size may have waited to be read. The time of such a chunk is not an
        # arrival time.
        is_read_at_once = len(chunk.data) < MAX_READ_BYTES
        if is_read_at_once:
            self._latest_arrival_s = chunk.timestamp
            if self._is_new_arrival and self._has_fit:  # without a clock of the device, there is no fit
                self._fit_arrival(chunk.timestamp)

    def _estimate_times(self, interval_s: float, arrival_s: float, frames: Sequence[Frame]) -> None:
        """Write times into the frames of a chunk. The times of frames with a clock are replaced afterwards.

        Each frame gets its unix time `host_s`, the time `dt_s` since the previous frame, and a time `clock_s` that does
        not jump when the wall clock is set. There are two cases:

        - The time since the previous chunk is divided evenly among the frames, and the last frame has the arrival time.
        - The time since the previous chunk is unknown (0) for the first chunk of a connection, and for all chunks of a
          file, which arrive at the same time. All frames of such a chunk have the same `host_s`. For `dt_s` and
          `clock_s`, the interval between two frames is assumed to be `FILE_INTERVAL_s`.

        Args:
            interval_s: Time since the previous chunk, s; 0 if it is unknown.
            arrival_s: Arrival of the chunk, unix seconds.
            frames: The frames of the chunk, which are changed in place.
        """
        if self._monotonic_s is None:
            self._monotonic_s = arrival_s
        else:
            self._monotonic_s += interval_s or len(frames) * self.FILE_INTERVAL_s
        # After a reset, the interval contains the outage of the port, and is not divided among the frames.
        frame_interval_s = 0.0 if self._latest_arrival_s is None else interval_s / len(frames)  # 0 if it is unknown
        for later_count, frame in enumerate(reversed(frames)):  # number of frames after the frame in the chunk
            frame.host_s = arrival_s - later_count * frame_interval_s
            frame.dt_s = frame_interval_s or self.FILE_INTERVAL_s
            frame.clock_s = self._monotonic_s - later_count * frame.dt_s

    def _stamp_with_device(self, frame: Frame, t_us: int, modulus: int, arrival_s: float) -> None:
        """Compute the time of a frame from the clock of the device, and write it into the frame.

        A straight line, which was fitted to the arrivals of earlier readings, converts the clock without its wraps
        (`_device_us`) to the time of the host (`_predicted_host_s`). A new fit begins if there is no fit yet, if the
        device has restarted, if the clock without its wraps would be below 0, or if the predicted time is far after the
        arrival.

        The clock may be lower than at the previous reading for three reasons. The size of the decrease shows the
        reason:

        - At most `MAX_DELAY_s`: the reading arrived late, for example because another datagram has overtaken it.
        - At least half of the range of the clock: the clock has wrapped to 0. If the range is so small that a late
          reading could not be distinguished from a wrap, any lower clock has wrapped.
        - Any other difference: the device has restarted.

        Args:
            frame: The frame, which is changed in place.
            t_us: Clock as the device sent it, us.
            modulus: Time at which the clock wraps to 0, us.
            arrival_s: Arrival of the chunk that contains the reading, unix seconds.
        """
        step_us = 0  # time since the previous reading, which is negative if the clock is lower without a wrap
        if self._has_fit:
            # The modulo gives the step that is nearest to 0. If the clock has wrapped, this is a step forwards. A small
            # range, such as 65.536 ms, leaves no room for a step back.
            largest_step_back_us = modulus // 2 if modulus > MAX_DELAY_s * 1e6 else 0
            step_us = (t_us - self._device_us + largest_step_back_us) % modulus - largest_step_back_us
        frame.is_clock_reset = step_us < -MAX_DELAY_s * 1e6
        # An unsigned clock is never below 0, where it would be before the start of the device. A signed clock may be.
        is_before_zero = t_us >= 0 and self._device_us + step_us < 0
        if not self._has_fit or frame.is_clock_reset or is_before_zero:
            step_us = 0
            self._begin_fit(t_us, arrival_s)
        else:
            self._device_us += step_us
        elapsed_us = max(0, step_us)
        self._predicted_host_s = self._anchor_host_s + self.rate * (self._device_us - self._anchor_us) * 1e-6

        if self._is_prediction_too_late(arrival_s):
            # If the clock is smaller than its step, it has passed 0 since the previous reading, which was taken for a
            # wrap. Because the prediction is wrong, the device has restarted instead.
            has_restarted = t_us < elapsed_us
            if has_restarted:
                frame.is_clock_reset = True
                self._device_us = t_us
                elapsed_us = 0
            self._begin_fit(self._device_us, arrival_s)

        # The host time must not decrease, even if a correction of the fit has moved the predicted host time back.
        self._latest_host_s = max(self._latest_host_s, self._predicted_host_s)
        frame.host_s = self._latest_host_s
        frame.device_us = self._device_us
        frame.dt_s = elapsed_us * 1e-6
        frame.clock_s = self._device_us * 1e-6

    def _is_prediction_too_late(self, arrival_s: float) -> bool:
        """Return whether the predicted time of a reading is much later than its arrival, so that the fit is wrong.

        A reading is taken before it arrives. The fit is wrong if the clock of the host or of the device was set. The
        fit is also wrong after the program has paused. During the pause, some readings waited for the program, so that
        the fit was adjusted to their late arrivals, and further readings were lost. A provisional fit is never
        considered wrong, because its times may be wrong by the length of a chunk.

        Args:
            arrival_s: Arrival of the chunk that contains the reading, unix seconds.
        """
        is_examined = self._is_new_arrival and not self._is_fit_provisional
        return is_examined and self._predicted_host_s - arrival_s > MAX_LEAD_s

    def _begin_fit(self, device_us: int, arrival_s: float) -> None:
        """Begin the line that converts the clock of the device to the time of the host, with the present reading.

        The host time of the reading is its arrival time, or the host time of the previous reading if that is later. The
        fit is provisional until `_fit_arrival` replaces it, because the first reading of a chunk may have been taken
        some time before the chunk arrived.

        Args:
            device_us: Clock of the device at the reading, us.
            arrival_s: Arrival of the chunk that contains the reading, unix seconds.
        """
        self._device_us = device_us
        self._anchor_us = device_us
        self._anchor_host_s = max(arrival_s, self._latest_host_s)
        self._predicted_host_s = self._anchor_host_s
        self._has_fit = True
        self._is_fit_provisional = True

    def _fit_arrival(self, arrival_s: float) -> None:
        """Fit the clock of the device to the arrival time of a chunk after its readings have been processed.

        The fit is a straight line: the host time is `_anchor_host_s` when the clock of the device is `_anchor_us`, and
        then advances by `rate` seconds per second of the device. The latest reading has the clock `_device_us`, for
        which the line predicts the host time `_predicted_host_s`.

        The fit is corrected with one step of a second-order delay-locked loop (Adriaensen 2005). Two numbers determine
        the correction: the time since_fit_s since the previous correction, and the difference delay_s between the
        arrival time and the predicted time. The gain of the loop is w = 2 pi * bandwidth * since_fit_s, but at most
        `MAX_LOOP_GAIN`, because a larger gain would make the loop unstable. The correction adds sqrt(2) w delay_s to
        the predicted host time, and w^2 delay_s / since_fit_s to the rate of the clock. The bandwidth decreases with
        the age of the fit.

        Args:
            arrival_s: Arrival of the chunk, unix seconds.
        """
        # If a board sends readings that it stored before the connection, their clock advances faster than time passes,
        # and moves the host time of the latest reading far ahead of the arrivals. The lead is therefore limited.
        self._latest_host_s = min(self._latest_host_s, arrival_s + MAX_LEAD_s)

        delay_s = arrival_s - self._predicted_host_s  # positive if the chunk arrived later than predicted
        since_fit_s = (self._device_us - self._anchor_us) * 1e-6  # since the previous correction of the fit
        self._anchor_us = self._device_us

        # A provisional fit relies on the arrival of only one chunk. A fit that begins at this arrival replaces it.
        if abs(delay_s) > MAX_DELAY_s or self._is_fit_provisional:
            self._anchor_host_s = arrival_s
            self._fit_age_s = 0.0
            self.rate = 1.0
            self._is_fit_provisional = False
            return

        self._fit_age_s += since_fit_s
        # The bandwidth begins with `FIRST_BANDWIDTH_Hz`, is half of it after 1 s, and falls to `BANDWIDTH_Hz`.
        bandwidth_Hz = max(BANDWIDTH_Hz, FIRST_BANDWIDTH_Hz / (1.0 + self._fit_age_s))
        loop_gain = min(MAX_LOOP_GAIN, 2.0 * math.pi * bandwidth_Hz * since_fit_s)
        self._anchor_host_s = self._predicted_host_s + math.sqrt(2.0) * loop_gain * delay_s
        if since_fit_s > 0.0:  # otherwise, the rate is not corrected
            self.rate += loop_gain**2 * delay_s / since_fit_s
