"""The port check: baud rate and format, rate, good and bad frames, the health of each channel, and what is missing to
get a touch.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from isocharge.errors import PortError
from isocharge.serve.frames.frame import Frame, Parser
from isocharge.serve.frames.sequence import SequenceGaps
from isocharge.serve.live.channel_health import MAINS_HZ, ChannelHealth, channel_health
from isocharge.serve.live.device import ANY_BOARD, Device
from isocharge.serve.port.device_clock import DeviceClock
from isocharge.serve.port.serial_port import Port
from isocharge.serve.signal_chain.tare import TareRule

BAUDS = (115200, 921600, 1000000, 2000000, 460800, 230400, 57600, 38400, 19200, 9600)
"""Baud rates to try, in this order, bit/s."""

TRY_S = 1.0
"""Time of listening at each baud rate, s."""

RIGHT_BAUD_SHARE = 0.5
"""Share of bytes in good frames, dimensionless, from which a baud rate is taken for right."""

CLEAN_SHARE = 0.99
"""Share of bytes in good frames, dimensionless, below which cable or baud rate are in doubt."""

HUM_LIMIT_PC = 0.5
"""Largest harmless amplitude of hum, pC: less than the film's own noise."""

DRIFT_LIMIT_PC_PER_S = 2.0
"""Largest harmless drift, pC/s."""


@dataclass(frozen=True)
class Examination:
    """The result of a port check.

    Attributes:
        url: The port.
        baud: Bits per second at which most bytes were frames.
        format: Name of the format, for people.
        bytes_seen: Number of bytes that came.
        seconds: Time of listening, s.
        rate_Hz: Frames per second, Hz.
        good, bad: Number of frames, and of pieces that were no frame.
        lost, repeated: Number of frames, by the frame numbers; None if frames have no numbers.
        device_clock: Whether the device sends a clock.
        channels: Health of each channel; empty without frames.
        missing: One sentence for each thing that is missing to get a touch.
    """

    url: str
    baud: int
    format: str
    bytes_seen: int
    seconds: float
    rate_Hz: float
    good: int
    bad: int
    lost: int | None
    repeated: int | None
    device_clock: bool
    channels: tuple[ChannelHealth, ...]
    missing: tuple[str, ...]


@dataclass
class Capture:
    """What came through a port in a while.

    Attributes:
        parser: The parser, with its counters.
        frames: Good frames.
        times_s: Time of each frame, by the device's clock if it sends one, s.
        gaps: Counters of the frame numbers.
        bytes_seen: Number of bytes that came.
        seconds: Time of listening, s.
    """

    parser: Parser
    frames: list[Frame] = field(default_factory=list)
    times_s: list[float] = field(default_factory=list)
    gaps: SequenceGaps = field(default_factory=SequenceGaps)
    bytes_seen: int = 0
    seconds: float = 0.0

    @property
    def share(self) -> float:
        """Share of bytes that were part of a good frame, dimensionless."""
        return 1.0 - self.parser.counts.bytes_dropped / self.bytes_seen if self.frames else 0.0

    @property
    def rate_Hz(self) -> float:
        """Frames per second, Hz; 0 for fewer than two frames."""
        span_s = self.times_s[-1] - self.times_s[0] if self.times_s else 0.0
        return (len(self.frames) - 1) / span_s if span_s > 0.0 else 0.0


def examine(
    url: str,
    *,
    bauds: tuple[int, ...] = BAUDS,
    seconds: float = 5.0,
    device: Device = ANY_BOARD,
    electrodes: tuple[str, ...] = (),
) -> Examination:
    """Check a port. The film must not be touched meanwhile.

    Args:
        url: Device path or pyserial URL.
        bauds: Baud rates to try, bit/s.
        seconds: Time of listening, s.
        device: What is known about the board.
        electrodes: Electrodes of the model that will be used; empty for any model.

    Raises:
        PortError: If the port cannot be opened.
    """
    baud = _find_baud(url, bauds, device)
    capture = _capture(url, baud, seconds, device)
    channels = tuple(_channels(capture, device))
    numbered = bool(capture.frames) and capture.frames[0].seq is not None
    counts = capture.parser.counts
    return Examination(
        url=url,
        baud=baud,
        format=capture.parser.format,
        bytes_seen=capture.bytes_seen,
        seconds=capture.seconds,
        rate_Hz=capture.rate_Hz,
        good=len(capture.frames),
        bad=counts.crc_errors + counts.malformed,
        lost=capture.gaps.lost if numbered else None,
        repeated=capture.gaps.repeated if numbered else None,
        device_clock=bool(capture.frames) and capture.frames[0].t_us is not None,
        channels=channels,
        missing=tuple(_missing(capture, channels, device, electrodes)),
    )


def _find_baud(url: str, bauds: tuple[int, ...], device: Device) -> int:
    """The baud rate at which most bytes are part of frames; the first one if no rate gives a frame."""
    if len(bauds) == 1:
        return bauds[0]
    best, share = bauds[0], 0.0
    for baud in bauds:
        capture = _capture(url, baud, TRY_S, device)
        if capture.share > share:
            best, share = baud, capture.share
        if share > RIGHT_BAUD_SHARE or not capture.bytes_seen:  # silence is silence at any rate
            break
    return best


def _capture(url: str, baud: int, seconds: float, device: Device) -> Capture:
    capture, clock, began = Capture(device.parser()), DeviceClock(), time.monotonic()
    with Port(url, baud=baud, silence_s=min(1.0, seconds)) as port:
        try:
            for chunk in port:
                capture.bytes_seen += len(chunk.data)
                for frame in capture.parser.feed(chunk.data):
                    when = clock.read(frame.t_us, capture.parser.t_us_modulus, chunk.timestamp)
                    capture.frames.append(frame)
                    capture.times_s.append(when.clock_s)
                    capture.gaps.update(frame.seq, capture.parser.seq_modulus)
                if time.monotonic() - began > seconds:
                    break
        except PortError:
            pass  # the port fell silent or went away: the check uses what came before
    capture.seconds = time.monotonic() - began
    return capture


def _channels(capture: Capture, device: Device) -> Iterator[ChannelHealth]:
    """The health of each channel, from the frames that have as many values as the last one."""
    if not capture.frames:
        return
    last = capture.frames[-1]
    same_width = [k for k, frame in enumerate(capture.frames) if len(frame.values) == len(last.values)]
    values = np.array([capture.frames[k].values for k in same_width])
    times_s = np.array([capture.times_s[k] for k in same_width])
    names = last.names or tuple(str(k + 1) for k in range(values.shape[1]))
    for name, column in zip(names, values.T, strict=True):
        with np.errstate(over="ignore"):
            charge_pC = column * _gain_pC(device, name)
        yield channel_health(name, charge_pC, times_s - times_s[0], capture.rate_Hz)


def _gain_pC(device: Device, channel: str) -> float:
    """Charge per unit of a channel, pC; 1 where the device file has none."""
    electrode = next((name for name, its_channel in device.channels.items() if its_channel == channel), channel)
    return 1.0 if device.gain_pC is None else device.gain_pC.of(electrode, 1.0)


def _missing(
    capture: Capture, channels: tuple[ChannelHealth, ...], device: Device, electrodes: tuple[str, ...]
) -> Iterator[str]:
    """One sentence for each thing that is missing to get a touch."""
    if not capture.bytes_seen:
        yield "not one byte came: check power and cable, and whether the board sends unasked"
        return
    if not capture.frames:
        yield "bytes come, but no frames: another baud rate (--baud), or a format for a device file (--device)"
        return
    if capture.share < CLEAN_SHARE:
        yield f"{1 - capture.share:.1%} of the bytes are no good frames: a bad cable, or a rate that is a little off"
    if capture.gaps.lost:
        yield f"{capture.gaps.lost} frames lost: a slower rate, or a faster link"
    if electrodes and len(channels) != len(electrodes) and not set(device.channels) >= set(electrodes):
        yield f"{len(channels)} channels, but the model has the electrodes {electrodes}: [channels] in a device file"
    yield from _missing_in_channels(channels, TareRule())
    if capture.frames[0].t_us is None and device.leak is not None:
        yield "a device clock (t_us, t_ms or t_s): without it the leak is undone by arrival times, which jitter"
    if device.leak is None:
        yield "the amplifier's time constants ([leak] tau_s in a device file): without them held presses fade"


def _missing_in_channels(channels: tuple[ChannelHealth, ...], rule: TareRule) -> Iterator[str]:
    for channel in channels:
        if channel.unusable:
            yield f"charges on channel {channel.name}: {channel.unusable} values are no numbers, or absurd"
        if (noise_pC := channel.noise_pC or 0.0) > rule.noise_limit_pC:
            yield f"quiet on channel {channel.name}: {noise_pC:.3g} pC rms, for a tare {rule.noise_limit_pC:g}"
        if abs(channel.offset_pC or 0.0) > rule.offset_limit_pC:
            yield (
                f"rest near zero on channel {channel.name}: {channel.offset_pC:.4g} pC, a tare takes "
                f"{rule.offset_limit_pC:g} (is something lying on the film? are these counts? then [gain])"
            )
        if channel.span_pC == 0.0:
            yield f"life on channel {channel.name}: every value is {channel.offset_pC:g}"
        if abs(drift := channel.drift_pC_per_s or 0.0) > DRIFT_LIMIT_PC_PER_S:
            yield f"a steady channel {channel.name}: it drifts by {drift:.2g} pC/s"
        for frequency, hum in zip(MAINS_HZ, channel.hum_pC, strict=True):
            if hum is not None and hum > HUM_LIMIT_PC:
                yield f"[hum] frequency_Hz = {frequency:g} (device file): channel {channel.name} hums by {hum:.2g} pC"
