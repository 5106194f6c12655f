"""What is on a port: baud rate and format, rate, good and bad frames, noise, offset, drift and hum of each channel, and
what is missing to get a touch.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from isocharge.arrays import Array
from isocharge.errors import PortError
from isocharge.serve.frames.frame import Frame, Parser
from isocharge.serve.frames.sequence import SequenceGaps
from isocharge.serve.live.device import ANY_BOARD, Device
from isocharge.serve.port.device_clock import DeviceClock
from isocharge.serve.port.serial_port import Port
from isocharge.serve.signal_chain.chain import LARGEST_PC
from isocharge.serve.signal_chain.tare import TareRule

BAUDS = (115200, 921600, 1000000, 2000000, 460800, 230400, 57600, 38400, 19200, 9600)
"""In the order in which they are tried."""

TRY_S = 1.0

HUMS_HZ = (50.0, 60.0)

HUM_LIMIT_PC = 0.5
"""Hum below this costs less than the film's own noise."""

DRIFT_LIMIT_PC_PER_S = 2.0

SURE = 0.5
"""Share of bytes in good frames above which a baud rate is right."""


@dataclass(frozen=True)
class ChannelHealth:
    """One channel at rest, in the device's unit after its gain, pC; None where not one value is a charge.

    Attributes:
        name: As the device calls it, or its place.
        offset_pC: Mean.
        noise_pC: Standard deviation without drift and hum.
        drift_pC_per_s: Slope.
        hum_pC: Amplitude at 50 and at 60 Hz; None where the rate is too low to tell.
        span_pC: From the smallest to the largest value.
        unusable: Values that are no charges: not finite, or larger than any film's.
    """

    name: str
    offset_pC: float | None = None
    noise_pC: float | None = None
    drift_pC_per_s: float | None = None
    hum_pC: tuple[float | None, float | None] = (None, None)
    span_pC: float | None = None
    unusable: int = 0


@dataclass(frozen=True)
class Examination:
    """What was found on a port.

    Attributes:
        url: The port.
        baud: The rate at which most bytes were frames.
        format: In words.
        bytes_seen: Bytes that came.
        seconds: For how long.
        rate_Hz: Frames per second.
        good, bad: Frames, and pieces that were none.
        lost, repeated: By their numbers; None if they have none.
        device_clock: Whether the device sends a clock.
        channels: Each channel's health; empty without frames.
        missing: What is missing to get a touch, in words; empty if nothing is.
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
        parser: What read it.
        frames: Good frames.
        times_s: When each was taken, by the device's clock where there is one, s.
        gaps: What the numbers say.
        bytes_seen: Bytes that came.
        seconds: For how long.
    """

    parser: Parser
    frames: list[Frame] = field(default_factory=list)
    times_s: list[float] = field(default_factory=list)
    gaps: SequenceGaps = field(default_factory=SequenceGaps)
    bytes_seen: int = 0
    seconds: float = 0.0

    @property
    def share(self) -> float:
        """Share of bytes that were part of a good frame."""
        return 1.0 - self.parser.counts.bytes_dropped / self.bytes_seen if self.frames else 0.0


def examine(
    url: str,
    *,
    bauds: tuple[int, ...] = BAUDS,
    seconds: float = 5.0,
    device: Device = ANY_BOARD,
    electrodes: tuple[str, ...] = (),
) -> Examination:
    """Listen to a port and say what is there. Leave the film alone meanwhile.

    Args:
        url: Device path or pyserial URL.
        bauds: Rates to try.
        seconds: How long to listen, s.
        device: What is known about the board.
        electrodes: Of the model that is meant; empty for any.

    Raises:
        PortError: If the port cannot be opened.
    """
    baud = _guess(url, bauds, device)
    heard = _capture(url, baud, seconds, device)
    channels = tuple(_channels(heard, device))
    numbered = bool(heard.frames) and heard.frames[0].seq is not None
    counts = heard.parser.counts
    return Examination(
        url=url,
        baud=baud,
        format=heard.parser.format,
        bytes_seen=heard.bytes_seen,
        seconds=heard.seconds,
        rate_Hz=_rate(heard),
        good=len(heard.frames),
        bad=counts.crc_errors + counts.malformed,
        lost=heard.gaps.lost if numbered else None,
        repeated=heard.gaps.repeated if numbered else None,
        device_clock=bool(heard.frames) and heard.frames[0].t_us is not None,
        channels=channels,
        missing=tuple(_missing(heard, channels, device, electrodes)),
    )


def _guess(url: str, bauds: tuple[int, ...], device: Device) -> int:
    """The rate at which most bytes are frames; the first if there are none at any."""
    if len(bauds) == 1:
        return bauds[0]
    best, share = bauds[0], 0.0
    for baud in bauds:
        heard = _capture(url, baud, TRY_S, device)
        if heard.share > share:
            best, share = baud, heard.share
        if share > SURE or not heard.bytes_seen:  # silence is silence at any rate
            break
    return best


def _capture(url: str, baud: int, seconds: float, device: Device) -> Capture:
    heard, clock, began = Capture(device.parser()), DeviceClock(), time.monotonic()
    with Port(url, baud=baud, silence_s=min(1.0, seconds)) as port:
        try:
            for chunk in port:
                heard.bytes_seen += len(chunk.data)
                for frame in heard.parser.feed(chunk.data):
                    when = clock.read(frame.t_us, heard.parser.t_us_modulus, chunk.timestamp)
                    heard.frames.append(frame)
                    heard.times_s.append(when.host_s if when.device_us is None else when.device_us * 1e-6)
                    heard.gaps.update(frame.seq, heard.parser.seq_modulus)
                if time.monotonic() - began > seconds:
                    break
        except PortError:
            pass  # it fell silent or went away: what came until then is what there is
    heard.seconds = time.monotonic() - began
    return heard


def _rate(heard: Capture) -> float:
    span_s = heard.times_s[-1] - heard.times_s[0] if heard.times_s else 0.0
    return (len(heard.frames) - 1) / span_s if span_s > 0.0 else 0.0


def _channels(heard: Capture, device: Device) -> Iterator[ChannelHealth]:
    """Each channel's health, from the frames that have as many values as the last one."""
    if not heard.frames:
        return
    last = heard.frames[-1]
    kept = [k for k, frame in enumerate(heard.frames) if len(frame.values) == len(last.values)]
    values = np.array([heard.frames[k].values for k in kept])
    times_s = np.array([heard.times_s[k] for k in kept])
    names = last.names or tuple(str(k + 1) for k in range(values.shape[1]))
    for name, column in zip(names, values.T, strict=True):
        with np.errstate(over="ignore"):
            charge_pC = column * _gain(device, name)
        yield _health(name, charge_pC, times_s - times_s[0], _rate(heard))


def _gain(device: Device, channel: str) -> float:
    """pC per unit of a channel; 1 where the device file says nothing."""
    electrode = next((name for name, given in device.channels.items() if given == channel), channel)
    return 1.0 if device.gain_pC is None else device.gain_pC.of(electrode, 1.0)


def _health(name: str, charge_pC: Array, t_s: Array, rate_Hz: float) -> ChannelHealth:
    """Offset, slope and hum by least squares, and what is left as noise."""
    good = np.abs(charge_pC) <= LARGEST_PC
    unusable = int(np.count_nonzero(~good))
    if unusable == good.size:
        return ChannelHealth(name, unusable=unusable)
    charge_pC, t_s = charge_pC[good], t_s[good]
    told = [hum for hum in HUMS_HZ if rate_Hz > 2.2 * hum and t_s.size and t_s[-1] > 0.5]
    turns = [2.0 * np.pi * hum * t_s for hum in told]
    columns = [np.ones_like(t_s), t_s, *(f(turn) for turn in turns for f in (np.cos, np.sin))]
    design = np.column_stack(columns)
    fit = np.linalg.lstsq(design, charge_pC, rcond=None)[0]
    amplitudes = {hum: float(np.hypot(*fit[2 + 2 * k : 4 + 2 * k])) for k, hum in enumerate(told)}
    return ChannelHealth(
        name,
        float(charge_pC.mean()),
        float((charge_pC - design @ fit).std()),
        float(fit[1]),
        (amplitudes.get(50.0), amplitudes.get(60.0)),
        float(np.ptp(charge_pC)),
        unusable,
    )


def _missing(
    heard: Capture, channels: tuple[ChannelHealth, ...], device: Device, electrodes: tuple[str, ...]
) -> Iterator[str]:
    """What is missing to get a touch."""
    if not heard.bytes_seen:
        yield "not one byte came: check power and cable, and whether the board sends unasked"
        return
    if not heard.frames:
        yield "bytes come, but no frames: another baud rate (--baud), or a format for a device file (--device)"
        return
    if heard.share < 0.99:
        yield f"{1 - heard.share:.1%} of the bytes are no good frames: a bad cable, or a rate that is a little off"
    if heard.gaps.lost:
        yield f"{heard.gaps.lost} frames lost: a slower rate, or a faster link"
    if electrodes and len(channels) != len(electrodes) and not set(device.channels) >= set(electrodes):
        yield f"{len(channels)} channels, but the model has the electrodes {electrodes}: [channels] in a device file"
    yield from _missing_in_channels(channels, TareRule())
    if heard.frames[0].t_us is None and device.leak is not None:
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
        for frequency, hum in zip(HUMS_HZ, channel.hum_pC, strict=True):
            if hum is not None and hum > HUM_LIMIT_PC:
                yield f"[hum] frequency_Hz = {frequency:g} (device file): channel {channel.name} hums by {hum:.2g} pC"
