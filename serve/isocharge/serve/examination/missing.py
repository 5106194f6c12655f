"""Messages to the user about settings and properties that a board needs before it can provide contacts."""

import math
from collections.abc import Iterator, Sequence

from msgspec import structs

from isocharge.common.errors import ChargeError, shown
from isocharge.common.printable_text import printable
from isocharge.serve.examination.channel_health import MAINS_HZ, ChannelHealth
from isocharge.serve.examination.held_press import HeldPress
from isocharge.serve.examination.listening import Capture
from isocharge.serve.live.device import Device
from isocharge.serve.port.serial_line import TELNET_ADVICE
from isocharge.serve.signal_chain.channels import Channels
from isocharge.serve.signal_chain.inflow import LeakRule
from isocharge.serve.signal_chain.stage import Setup
from isocharge.serve.signal_chain.tare import TareRule

CLEAN_SHARE = 0.99
"""Smallest share of bytes in good frames with a good cable and the right baud rate, dimensionless."""


def transmission_sentences(capture: Capture, *, uses_telnet: bool) -> Iterator[str]:
    """Yield one sentence if no frames were received, or for each fault of the transmission.

    Args:
        capture: The frames, with the share of intact bytes and the gaps in the frame numbers.
        uses_telnet: Whether more bytes are frames without the escapes of the telnet protocol.
    """
    unread_line = shown(capture.parser.unread_line) if capture.parser.unread_line else ""
    if not capture.bytes_seen:
        yield (
            "no bytes were received: check the power and the cable; if the board sends only after a request, state the "
            "request with --request"
        )
    elif uses_telnet:
        yield TELNET_ADVICE
    elif not capture.frames and unread_line:
        yield (
            f"the lines of text are not understood, for example {unread_line}: send the numbers of all channels in "
            "each line, with the same text between them"
        )
    elif not capture.frames:
        yield (
            "bytes were received, but no frames were recognised: try another baud rate with --baud, or describe the "
            "format in a device file (--device); a board without noise shows its channels only while the film is "
            "touched"
        )
    elif capture.intact_share < CLEAN_SHARE:
        damaged = f"{1.0 - capture.intact_share:.1%} of the bytes do not belong to good frames"
        if unread_line:
            damaged += (
                f", such as the line {unread_line}: send a number for each channel, and nan for a channel without a "
                "value; if the line is damaged"
            )
        yield f"{damaged}: check the cable, and whether the baud rate of the board is exact"
    if capture.gaps.lost and not uses_telnet:
        yield f"{capture.gaps.lost} frames were lost: send fewer frames per second, or use a faster link"


def channel_count_sentences(
    capture: Capture, device: Device, channel_count: int, electrodes: tuple[str, ...]
) -> Iterator[str]:
    """Yield a sentence if the board has more or fewer channels than the model has electrodes.

    No sentence is needed without a model, or if the device file assigns a channel to every electrode. If the names of
    the channels are nearly those of the electrodes, the sentence names the difference.

    Args:
        capture: The frames, at least one.
        device: Settings of the board.
        channel_count: Number of channels that are used.
        electrodes: Electrodes of the model; empty for any model.
    """
    if set(electrodes) <= set(device.channels):  # also without a model
        return
    try:
        Channels(Setup(electrodes, reader="the model"), any_unit=True).named_indices(capture.frames[-1])
    except ChargeError as error:
        yield str(error)
        return
    if channel_count != len(electrodes):
        yield (
            f"the board uses {channel_count} of {len(capture.names)} channels, but the model has the electrodes "
            f"{electrodes}: choose another model with --model, or assign the channels in the section [channels] of a "
            "device file"
        )


def unit_sentences(unit: str) -> Iterator[str]:
    """Yield a request for the charge of one unit, unless the channels are in pC."""
    if unit == "pC":
        return
    product = "; it is the product of the volts of one unit and the feedback capacitance in pF" if unit == "V" else ""
    yield (
        f"the channels seem to be in {unit}: state the charge of one unit in pC with --pc-per-unit NUMBER{product}; "
        "the number is negative if the amplifier inverts, and 1 if the channels are already in pC"
    )


def channel_sentences(
    channels: Sequence[ChannelHealth],
    unit: str,
    device: Device,
    max_drift_pC_per_s: float = 2.0,
    max_hum_pC: float = 0.5,
) -> Iterator[str]:
    """Yield a sentence for each problem of a channel that prevents a tare or makes contacts inaccurate.

    A tare is the measurement of the charges at rest. It requires a small noise and a small offset of each channel. The
    limits of offset, noise, drift and hum are in pC.

    Args:
        channels: Offset, noise, drift and hum of each channel.
        unit: Unit of the channels.
        device: Settings of the board.
        max_drift_pC_per_s: Largest harmless drift, pC/s.
        max_hum_pC: Largest harmless amplitude of hum, pC. The default is below the noise of the film.
    """
    rule = device.rule(TareRule) or TareRule()  # the defaults if the device file has no tare
    if device.front_end == "current":  # a current of any size at rest is an offset
        rule = structs.replace(rule, offset_limit_pC=math.inf)
    for channel in channels:
        name = f"channel {printable(channel.name)}"
        if channel.unusable:
            yield (
                f"{name} is {channel.unusable_value} in {channel.unusable} frames, which is not a charge: check the "
                "amplifier and the wire of this channel"
            )
        if channel.span_pC == 0.0:
            yield f"{name} is dead: every value is {channel.offset_pC:g}"
        # Of a channel without a usable value, only the unusable values are reported.
        if unit != "pC" or channel.noise_pC is None or channel.offset_pC is None or channel.drift_pC_per_s is None:
            continue
        if channel.noise_pC > rule.noise_limit_pC:
            yield (
                f"{name} has a noise of {channel.noise_pC:.3g} pC rms, but a tare needs less than "
                f"{rule.noise_limit_pC:g} pC"
            )
        if abs(channel.offset_pC) > rule.offset_limit_pC:
            yield (
                f"{name} has {channel.offset_pC:.4g} pC at rest, but a tare accepts at most "
                f"{rule.offset_limit_pC:g} pC: remove what lies on the film; if the amplifier rests at this value, "
                "subtract it with [gain] offset, which --write puts into the device file"
            )
        if abs(channel.drift_pC_per_s) > max_drift_pC_per_s:
            yield (
                f"{name} drifts by {channel.drift_pC_per_s:.2g} pC/s, so that an untouched film may seem touched: "
                "let the amplifier warm up, or put [leak] with the time constants of the amplifiers into a device file"
            )
        for frequency_Hz, hum_pC in zip(MAINS_HZ, channel.hum_pC, strict=True):
            if hum_pC is not None and hum_pC > max_hum_pC:
                yield f"{name} has a hum of {hum_pC:.2g} pC: set [hum] frequency_Hz = {frequency_Hz:g} in a device file"


def held_press_sentences(capture: Capture, device: Device, held_press: HeldPress | None) -> Iterator[str]:
    """Yield one sentence for each missing setting or property without which the force of a held press seems to change.

    The force seems to change because the amplifiers leak. Touches are computed in any case.

    - If the device file contains time constants of a leak, each frame must contain the time of a clock of the device.
    - If no press was held, the time constants of the amplifiers are requested, unless the device file contains them.
      A press that was held shows whether they are needed, and its description states them.

    Args:
        capture: The frames, at least one.
        device: Settings of the board.
        held_press: Press that was held during the check; None if no press was held.
    """
    has_device_clock = capture.frames[0].t_us is not None
    if device.rule(LeakRule) is not None and not has_device_clock:
        yield (
            "send the time of a device clock in each frame (t_us, t_ms or t_s): without it the leak is corrected with "
            "the arrival times, which jitter"
        )
    if held_press is None and device.rule(LeakRule) is None and device.front_end != "current":
        yield (
            "state the time constants of the amplifiers in a device file ([leak] tau_s): without them the force of a "
            "held press seems to decrease. The time constants follow from the circuit. To measure them instead, listen "
            "for 20 s with --seconds 20, and hold a press with a weight from the third second on"
        )
