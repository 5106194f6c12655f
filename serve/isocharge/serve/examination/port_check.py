"""The port check: baud rate and format, rate, good and bad frames, the health of each channel, a device file that fits,
and what is missing to get a touch.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import IsochargeError
from isocharge.common.printable_text import printable
from isocharge.common.toml_text import to_toml
from isocharge.serve.examination.held_press import HeldPress, held_press
from isocharge.serve.examination.listening import BAUDS, Capture, Heard, listen, read_frames
from isocharge.serve.examination.proposal import Proposal, propose, unit_of
from isocharge.serve.frames.frame import Frame
from isocharge.serve.live.device import ANY_BOARD, Device, device_from_table
from isocharge.serve.live.reading_stream import ReadingStream, position_of
from isocharge.serve.port.serial_line import Request
from isocharge.serve.recognition.recognise import recognise
from isocharge.serve.signal_chain.chain import LARGEST_PC
from isocharge.serve.signal_chain.tare import TareRule

MAINS_HZ = (50.0, 60.0)
"""Frequencies at which hum is looked for, Hz."""

SAMPLES_PER_PERIOD = 2.2
"""Smallest rate for a hum, in samples per period, dimensionless: 10 % above the Nyquist rate."""

SHORTEST_S = 0.5
"""Shortest time from which hum is estimated, s: 5 Hz resolution separates 50 from 60 Hz."""


@dataclass(frozen=True)
class ChannelHealth:
    """One channel at rest, in pC after the gain; None where no value is a charge.

    Attributes:
        name: As the device calls it, or its number from 1.
        offset_pC: Mean.
        noise_pC: Standard deviation without drift and hum.
        drift_pC_per_s: Slope.
        hum_pC: Amplitude at 50 and at 60 Hz; None where the rate is too low, or the time too short, to tell.
        span_pC: Difference of the largest and the smallest value.
        unusable: Number of values that are no charges: not finite, or larger than any film's.
    """

    name: str
    offset_pC: float | None = None
    noise_pC: float | None = None
    drift_pC_per_s: float | None = None
    hum_pC: tuple[float | None, float | None] = (None, None)
    span_pC: float | None = None
    unusable: int = 0


def channel_health(name: str, charge_pC: Array, t_s: Array, rate_Hz: float) -> ChannelHealth:
    """Fit a constant, a slope and the hum to a channel.

    Args:
        name: The channel's name.
        charge_pC: Its values, shape (n,), pC.
        t_s: Their times from the first frame on, shape (n,), s.
        rate_Hz: Frames per second, Hz.
    """
    usable = np.abs(charge_pC) <= LARGEST_PC
    unusable = int(np.count_nonzero(~usable))
    if unusable == usable.size:
        return ChannelHealth(name, unusable=unusable)
    charge_pC, t_s = charge_pC[usable], t_s[usable]
    mains_Hz = [hum for hum in MAINS_HZ if rate_Hz > SAMPLES_PER_PERIOD * hum and t_s[-1] > SHORTEST_S]
    phases = [2.0 * np.pi * hum * t_s for hum in mains_Hz]
    columns = [np.ones_like(t_s), t_s, *(wave(phase) for phase in phases for wave in (np.cos, np.sin))]
    design = np.column_stack(columns)
    fit = np.linalg.lstsq(design, charge_pC, rcond=None)[0]
    amplitudes = {hum: float(np.hypot(*fit[2 + 2 * k : 4 + 2 * k])) for k, hum in enumerate(mains_Hz)}
    return ChannelHealth(
        name,
        offset_pC=float(charge_pC.mean()),
        noise_pC=float((charge_pC - design @ fit).std()),
        drift_pC_per_s=float(fit[1]),
        hum_pC=(amplitudes.get(50.0), amplitudes.get(60.0)),
        span_pC=float(np.ptp(charge_pC)),
        unusable=unusable,
    )


RIGHT_BAUD_SHARE = 0.5
"""Share of bytes in good frames, dimensionless, from which a baud rate is taken for right."""

CLEAN_SHARE = 0.99
"""Share of bytes in good frames, dimensionless, below which cable or baud rate are in doubt."""

HUM_LIMIT_PC = 0.5
"""Largest harmless amplitude of hum, pC: less than the film's own noise."""

DRIFT_LIMIT_PC_PER_S = 2.0
"""Largest harmless drift, pC/s."""

TO_ASK_FOR = {
    "counts": "the charge of one count, pC: --pc-per-unit NUMBER, negative where the amplifier inverts (1 if these are "
    "pC)",
    "V": "the amplifier's feedback capacitance, if these are volts: --v-per-unit 1 --feedback-pf NUMBER; or the charge "
    "of one unit, pC: --pc-per-unit NUMBER (1 if these are pC)",
}
"""What is missing of the gain, by the unit of the channels."""


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
        unit: Of the channels: "pC", or "counts" or "V" where the charge of one is not known.
        channels: Health of each channel that is used; empty without frames.
        unused: Channels that no electrode uses.
        held: What a press says that was held meanwhile, a sentence; empty without one.
        missing: One sentence for each thing that is missing to get a touch.
        works: Whether a film at rest is tared with this device file.
        device: Content of the device file: the one that was given, or else one that fits; empty without frames.
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
    unit: str
    channels: tuple[ChannelHealth, ...]
    unused: tuple[str, ...]
    held: str
    missing: tuple[str, ...]
    works: bool
    device: Mapping[str, Any]


def examine(
    url: str,
    *,
    bauds: tuple[int, ...] = BAUDS,
    seconds: float = 5.0,
    device: Device = ANY_BOARD,
    electrodes: tuple[str, ...] = (),
    gain: Mapping[str, Any] | None = None,
    request: Request | None = None,
    wait: float = 0.0,
) -> Examination:
    """Check a port. The film must not be touched meanwhile.

    Args:
        url: Device path or URL, as `Port` takes it.
        bauds: Baud rates to try, bit/s.
        seconds: Time of listening, s.
        device: What is known about the board; without it, what it sends is recognised.
        electrodes: Electrodes of the model that will be used; empty for any model.
        gain: What is known of the amplifier where nothing is known of the board: keys of the section `[gain]`.
        request: What the board has to be asked; by default what the device says.
        wait: Time to wait until the port can be opened, s.

    Raises:
        PortError: If the port cannot be opened.
        DeviceError: If the gain is wrong, or for other electrodes.
    """
    heard = listen(url, bauds, seconds, request or device.request, lambda part: _is_clear(part, device), wait)
    return findings(heard, device=device, electrodes=electrodes, gain=gain)


def _is_clear(heard: Heard, device: Device) -> bool:
    """Whether what was heard are frames, so that the speed is right."""
    if device is ANY_BOARD:
        frames = recognise(heard.data, heard.span_s, are_datagrams=heard.are_datagrams)
        device = device_from_table({"frames": frames or {}}, "board")
    return read_frames(heard, device).share > RIGHT_BAUD_SHARE


def findings(
    heard: Heard,
    *,
    device: Device = ANY_BOARD,
    electrodes: tuple[str, ...] = (),
    gain: Mapping[str, Any] | None = None,
) -> Examination:
    """What the bytes of a port say; the other arguments are those of `examine`.

    Raises:
        DeviceError: If the gain is wrong, or for other electrodes.
    """
    proposal = Proposal(dict(device.table), electrodes)
    if device is ANY_BOARD:
        proposal = propose(heard, electrodes, gain or {})
        known = {key: value for key, value in proposal.table.items() if gain or key != "gain"}
        device = device_from_table(known, "board")
        device.check_gain(proposal.electrodes)
    capture = read_frames(heard, device)
    unit = "pC" if device.gain is not None else unit_of(capture)
    used = _used(capture, device)
    held = held_press(*capture.values()) if capture.frames else None
    for name, section in (held.sections if held is not None else {}).items():
        proposal.table.setdefault(name, section)
    channels = tuple(_channels(capture, device, used, math.inf if held is None else held.begin_s))
    first = capture.frames[0] if capture.frames else Frame(None, None, ())
    counts, is_numbered = capture.parser.counts, first.seq is not None
    unused = tuple(name for position, name in enumerate(capture.names) if position not in used)
    return Examination(
        url=heard.url,
        baud=heard.baud,
        format=capture.parser.format,
        bytes_seen=heard.bytes_seen,
        seconds=heard.seconds,
        rate_Hz=capture.rate_Hz,
        good=len(capture.frames),
        bad=counts.crc_errors + counts.malformed,
        lost=capture.gaps.lost if is_numbered else None,
        repeated=capture.gaps.repeated if is_numbered else None,
        device_clock=first.t_us is not None,
        unit=unit,
        channels=channels,
        unused=unused,
        held="" if held is None else held.says,
        missing=tuple(_missing(capture, channels, unused, device, proposal.electrodes, unit, held)),
        works=bool(used) and _works(heard, proposal.table, proposal.electrodes or tuple(used.values())),
        device=proposal.table,
    )


def _works(heard: Heard, table: Mapping[str, Any], electrodes: tuple[str, ...]) -> bool:
    """Whether the film is tared with a device file, as far as that can be told: from the frames of two tares."""
    count = 0
    try:
        device = device_from_table(table, "board")
        stream = ReadingStream(electrodes, device)
        for timed in (timed for chunk in heard.chunks for timed in stream.feed(chunk)):
            count += 1
            if timed.reading.tare is not None or device.tare is None:
                return True
    except IsochargeError:
        return False
    return device.tare is not None and 0 < count < 2 * device.tare.frames


def _used(capture: Capture, device: Device) -> dict[int, str]:
    """Electrodes by the positions of their channels; all channels under their own names where the device names none."""
    if not device.channels or not capture.frames:
        return dict(enumerate(capture.names))
    positions = {position_of(name, capture.frames[-1]): electrode for electrode, name in device.channels.items()}
    return {position: electrode for position, electrode in positions.items() if position is not None}


def _channels(capture: Capture, device: Device, used: Mapping[int, str], until_s: float) -> Iterator[ChannelHealth]:
    """The health of each channel that is used, from the frames at rest that have as many values as the last one."""
    if not capture.frames:
        return
    values, times_s = capture.values()
    values, times_s = values[times_s < until_s], times_s[times_s < until_s]
    for position, electrode in used.items():
        charge_pC = values[:, position]
        if device.gain is not None:
            with np.errstate(over="ignore"):
                charge_pC = device.gain.charge_pC(electrode, charge_pC)
        yield channel_health(capture.names[position], charge_pC, times_s, capture.rate_Hz)


def _missing(
    capture: Capture,
    channels: tuple[ChannelHealth, ...],
    unused: tuple[str, ...],
    device: Device,
    electrodes: tuple[str, ...],
    unit: str,
    held: HeldPress | None,
) -> Iterator[str]:
    """One sentence for each thing that is missing to get a touch."""
    if not capture.bytes_seen:
        yield "not one byte came: check power and cable, and whether the board sends unasked (if not: --request)"
        return
    if not capture.frames:
        yield (
            "bytes come, but no frames: another baud rate (--baud), or a format for a device file (--device); a board "
            "without noise shows its channels only while the film is touched"
        )
        return
    if capture.share < CLEAN_SHARE:
        yield f"{1 - capture.share:.1%} of the bytes are no good frames: a bad cable, or a rate that is a little off"
    if capture.gaps.lost:
        yield f"{capture.gaps.lost} frames lost: a slower rate, or a faster link"
    if electrodes and len(channels) != len(electrodes) and not set(device.channels) >= set(electrodes):
        alive = f"{len(channels)} channels" + (f" that live, of {len(capture.names)}" if unused else "")
        yield (
            f"{alive}, but the model has the electrodes {electrodes}: another model (--model), or [channels] in a "
            "device file"
        )
    if unit != "pC":
        yield TO_ASK_FOR[unit]
    for channel in channels:
        if channel.span_pC == 0.0:
            yield f"life on channel {printable(channel.name)}: every value is {channel.offset_pC:g}"
        if unit == "pC":
            yield from _missing_in(channel, device.tare or TareRule())
    if capture.frames[0].t_us is None and device.leak is not None:
        yield "a device clock (t_us, t_ms or t_s): without it the leak is undone by arrival times, which jitter"
    if device.leak is None and held is None:
        yield (
            "the amplifier's time constants ([leak] tau_s in a device file), of its circuit: without them held presses "
            "fade. To measure them, listen for 20 s (--seconds 20), and from the third on hold a press with a weight"
        )
    elif held is not None:
        for name, section in held.sections.items():
            if name not in device.table:
                yield f"[{name}] {', '.join(f'{key} = {value:g}' for key, value in section.items())} in a device file"


def _missing_in(channel: ChannelHealth, rule: TareRule) -> Iterator[str]:
    """What is wrong with the charges of a channel."""
    name = printable(channel.name)
    if channel.unusable:
        yield f"charges on channel {name}: {channel.unusable} values are no numbers, or absurd"
    if (noise_pC := channel.noise_pC or 0.0) > rule.noise_limit_pC:
        yield f"quiet on channel {name}: {noise_pC:.3g} pC rms, for a tare {rule.noise_limit_pC:g}"
    if abs(channel.offset_pC or 0.0) > rule.offset_limit_pC:
        yield (
            f"rest near zero on channel {name}: {channel.offset_pC:.4g} pC, a tare takes "
            f"{rule.offset_limit_pC:g} (is something lying on the film? or does the amplifier rest there? then "
            "[gain] offset, as --write has it)"
        )
    if abs(drift := channel.drift_pC_per_s or 0.0) > DRIFT_LIMIT_PC_PER_S:
        yield f"a steady channel {name}: it drifts by {drift:.2g} pC/s"
    for frequency, hum in zip(MAINS_HZ, channel.hum_pC, strict=True):
        if hum is not None and hum > HUM_LIMIT_PC:
            yield f"[hum] frequency_Hz = {frequency:g} (device file): channel {name} hums by {hum:.2g} pC"


HEAD = (
    "Written by `isocharge serve doctor` from what came through a port; the keys are in serve/docs/device_file.md.",
)

TO_FILL_IN = {
    "counts": ("# pC_per_unit = ?    # the charge of one count, pC; with a minus where the amplifier inverts",),
    "V": (
        "# V_per_unit = 1.0    # with a minus where the amplifier inverts",
        "# feedback_pF = ?     # the feedback capacitance of the amplifiers, pF",
    ),
}
"""Lines for the section `[gain]` by the unit of the channels."""


def device_text(examination: Examination) -> str:
    """The content of a device file, TOML; what is not known of the gain is a comment to fill in."""
    table = {key: value for key, value in examination.device.items() if key != "gain"}
    text = to_toml(table, (*HEAD, *_words(examination)))
    gain = examination.device.get("gain")
    lines = TO_FILL_IN.get(examination.unit, ())
    if gain is not None:
        text += "\n" + to_toml({"gain": gain})
    elif lines:
        text += "\n[gain]\n"
    return text + "".join(f"{line}\n" for line in lines)


def _words(examination: Examination) -> Iterator[str]:
    yield f"{examination.format}; {examination.rate_Hz:.4g} frames per second"
    if examination.unused:
        yield f"channels that no electrode uses: {printable(', '.join(examination.unused))}"
