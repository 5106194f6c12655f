"""Frames of what was heard, read as a device file says."""

from dataclasses import dataclass, field

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.examination.listening import Heard
from isocharge.serve.frames.frame import Frame, Parser
from isocharge.serve.frames.sequence import SequenceGaps
from isocharge.serve.live.channels import channel_names
from isocharge.serve.live.device import Device
from isocharge.serve.port.device_clock import DeviceClock


@dataclass
class Capture:
    """What came through a port in a while.

    Attributes:
        parser: The parser, with its counters.
        frames: Good frames.
        times_s: Time of each frame, by the device's clock if it sends one, s.
        gaps: Counters of the frame numbers.
        bytes_seen: Number of bytes that came.
    """

    parser: Parser
    frames: list[Frame] = field(default_factory=list)
    times_s: list[float] = field(default_factory=list)
    gaps: SequenceGaps = field(default_factory=SequenceGaps)
    bytes_seen: int = 0

    @property
    def share(self) -> float:
        """Share of bytes that were part of a good frame, dimensionless."""
        return 1.0 - self.parser.counts.bytes_dropped / self.bytes_seen if self.frames else 0.0

    @property
    def rate_Hz(self) -> float:
        """Frames per second, Hz; 0 for fewer than two frames."""
        span_s = self.times_s[-1] - self.times_s[0] if self.times_s else 0.0
        return (len(self.frames) - 1) / span_s if span_s > 0.0 else 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the channels; empty without frames."""
        return channel_names(self.frames[-1]) if self.frames else ()

    def values(self) -> tuple[Array, Array]:
        """Values (n, channels) of the frames that have as many as the last one, and their times (n,), s."""
        width = len(self.frames[-1].values)
        alike = [k for k, frame in enumerate(self.frames) if len(frame.values) == width]
        times_s = np.array([self.times_s[k] for k in alike])
        return np.array([self.frames[k].values for k in alike], dtype=float), times_s - times_s[0]


def read_frames(heard: Heard, device: Device) -> Capture:
    """The frames of what was heard."""
    capture, clock = Capture(device.parser(), bytes_seen=heard.bytes_seen), DeviceClock()
    for chunk in heard.chunks:
        for frame in capture.parser.feed(chunk.data):
            when = clock.read(frame.t_us, capture.parser.t_us_modulus, chunk.timestamp)
            capture.frames.append(frame)
            capture.times_s.append(when.clock_s)
            capture.gaps.update(frame.seq, capture.parser.seq_modulus)
    return capture
