"""Messages to the user about settings and properties that a board needs before it can provide contacts."""

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from msgspec import structs

from isocharge.common.errors import ChargeError, shown
from isocharge.common.printable_text import printable
from isocharge.serve.examination.channel_health import MAINS_HZ, ChannelHealth
from isocharge.serve.examination.held_press import HeldPress
from isocharge.serve.examination.listening import Capture
from isocharge.serve.flags import DRIFT
from isocharge.serve.live.device import Device
from isocharge.serve.live.fading import section_text
from isocharge.serve.port.serial_line import TELNET_ADVICE
from isocharge.serve.signal_chain.channels import Channels
from isocharge.serve.signal_chain.inflow import LeakSection
from isocharge.serve.signal_chain.memory import MemoryRule
from isocharge.serve.signal_chain.stage import Setup
from isocharge.serve.signal_chain.tare import TareRule
from isocharge.serve.signal_chain.touch import TouchRule

if TYPE_CHECKING:
    from isocharge.serve.examination.port_check import Examination

CLEAN_SHARE = 0.99
"""Smallest share of bytes in good frames with a good cable and the right baud rate, dimensionless."""

HUM_LIMIT_PC = 0.5
"""Largest harmless amplitude of hum, pC. It is below the noise of the film."""

DRIFT_LIMIT_PC_PER_S = 2.0
"""Largest harmless drift, pC/s."""

GAIN_REQUESTS = {
    "counts": "state the charge of one count in pC with --pc-per-unit NUMBER; the number is negative if the amplifier "
    "inverts, and 1 if the channels are already in pC",
    "V": "if the channels are volts, state the feedback capacitance of the amplifier with --v-per-unit 1 --feedback-pf "
    "NUMBER; otherwise state the charge of one unit in pC with --pc-per-unit NUMBER",
}
"""Request to the user for the gain, by the unit of the channels."""


def missing_sentences(
    examination: "Examination", capture: Capture, device: Device, electrodes: tuple[str, ...], *, uses_telnet: bool
) -> Iterator[str]:
    """Yield one sentence for each missing setting and for each problem that prevents the computation of contacts.

    Without bytes or without frames, there is only one sentence, because nothing else is known. Problems of charges,
    such as a large noise, are reported only if the unit of the channels is pC.

    Args:
        examination: The other results of the port check.
        capture: The frames.
        device: Settings of the board.
        electrodes: Electrodes of the model; empty for any model.
        uses_telnet: Whether more bytes are frames without the escapes of the telnet protocol.
    """
    if not capture.bytes_seen:
        yield (
            "no bytes were received: check the power and the cable; if the board sends only after a request, state the "
            "request with --request"
        )
        return
    if uses_telnet:
        yield TELNET_ADVICE
        return
    if not capture.frames and capture.parser.unread_line:
        yield (
            f"the lines of text are not understood, for example {shown(capture.parser.unread_line)}: send the numbers "
            "of all channels in each line, with the same text between them"
        )
        return
    if not capture.frames:
        yield (
            "bytes were received, but no frames were recognised: try another baud rate with --baud, or describe the "
            "format in a device file (--device); a board without noise shows its channels only while the film is "
            "touched"
        )
        return
    if examination.touch:
        yield examination.touch
    yield from _transmission_sentences(capture)
    yield from _channel_count_sentences(examination, capture, device, electrodes)
    unit = examination.unit
    if unit != "pC":
        yield GAIN_REQUESTS.get(unit) or (
            f"the names of the channels state {unit}: state the charge of one {unit} in pC with --pc-per-unit NUMBER"
        )
    tare_rule = device.rule(TareRule) or TareRule()  # the defaults if the device file has no tare
    if device.front_end == "current":  # a current of any size at rest is an offset
        tare_rule = structs.replace(tare_rule, offset_limit_pC=math.inf)
    for channel in examination.channels:
        if channel.unusable:
            yield (
                f"channel {printable(channel.name)} is {channel.unusable_value} in {channel.unusable} frames, which is "
                "not a charge: check the amplifier and the wire of this channel"
            )
        if channel.span_pC == 0.0:
            yield f"channel {printable(channel.name)} is dead: every value is {channel.offset_pC:g}"
        if unit == "pC":  # the limits of noise, offset, drift and hum are in pC
            yield from _charge_sentences(channel, tare_rule)
    if unit == "pC":
        yield from _drift_sentences(examination, device, tare_rule)


def _transmission_sentences(capture: Capture) -> Iterator[str]:
    """Yield a sentence if bytes were damaged during the transmission, and another sentence if frames were lost.

    Args:
        capture: The frames, with the share of intact bytes and the gaps in the frame numbers.
    """
    if capture.intact_share < CLEAN_SHARE:
        damaged = f"{1.0 - capture.intact_share:.1%} of the bytes do not belong to good frames"
        if capture.parser.unread_line:
            damaged += (
                f", such as the line {shown(capture.parser.unread_line)}: send a number for each channel, "
                "and nan for a channel without a value; if the line is damaged"
            )
        yield f"{damaged}: check the cable, and whether the baud rate of the board is exact"
    if capture.gaps.lost:
        yield f"{capture.gaps.lost} frames were lost: send fewer frames per second, or use a faster link"


def _channel_count_sentences(
    examination: "Examination", capture: Capture, device: Device, electrodes: tuple[str, ...]
) -> Iterator[str]:
    """Yield a sentence if the board has more or fewer channels than the model has electrodes.

    No sentence is needed without a model, or if the device file assigns a channel to every electrode. If the names of
    the channels are nearly those of the electrodes, the sentence names the difference.

    Args:
        examination: The other results of the port check.
        capture: The frames.
        device: Settings of the board.
        electrodes: Electrodes of the model; empty for any model.
    """
    has_every_electrode_a_channel = set(electrodes) <= set(device.channels)  # also without a model
    if has_every_electrode_a_channel:
        return
    channel_count = len(examination.channels)
    try:
        Channels(Setup(electrodes, reader="the model"), any_unit=True).named_indices(capture.frames[-1])
    except ChargeError as error:
        yield str(error)
        return
    if channel_count == len(electrodes):
        return
    used_channels = f"{channel_count} channels"
    if examination.unused:
        used_channels = f"{channel_count} of {len(capture.names)} channels"
    yield (
        f"the board uses {used_channels}, but the model has the electrodes {electrodes}: choose another model with "
        "--model, or assign the channels in the section [channels] of a device file"
    )


def _charge_sentences(channel: ChannelHealth, rule: TareRule) -> Iterator[str]:
    """Yield a sentence for each problem of a channel that prevents a tare or makes contacts inaccurate.

    A tare is the measurement of the charges at rest. It requires a small noise and a small offset of each channel.

    Args:
        channel: Offset, noise, drift and hum of the channel, pC.
        rule: Conditions of the tare.
    """
    name = printable(channel.name)
    # A channel without a usable value has no noise, offset or drift. Only its unusable values are then reported.
    noise_pC = channel.noise_pC or 0.0
    offset_pC = channel.offset_pC or 0.0
    drift_pC_per_s = channel.drift_pC_per_s or 0.0
    if noise_pC > rule.noise_limit_pC:
        yield (
            f"channel {name} has a noise of {noise_pC:.3g} pC rms, but a tare needs less than "
            f"{rule.noise_limit_pC:g} pC"
        )
    if abs(offset_pC) > rule.offset_limit_pC:
        yield (
            f"channel {name} has {offset_pC:.4g} pC at rest, but a tare accepts at most {rule.offset_limit_pC:g} pC: "
            "remove what lies on the film; if the amplifier rests at this value, subtract it with [gain] offset, which "
            "--write puts into the device file"
        )
    if abs(drift_pC_per_s) > DRIFT_LIMIT_PC_PER_S:
        yield f"channel {name} drifts by {drift_pC_per_s:.2g} pC/s: let the amplifier warm up, and check its leak"
    for frequency_Hz, hum_pC in zip(MAINS_HZ, channel.hum_pC, strict=True):
        if hum_pC is not None and hum_pC > HUM_LIMIT_PC:
            yield (
                f"channel {name} has a hum of {hum_pC:.2g} pC: put [hum] frequency_Hz = {frequency_Hz:g} into a device "
                "file"
            )


def _drift_sentences(examination: "Examination", device: Device, tare_rule: TareRule) -> Iterator[str]:
    """Yield a sentence if the charges of an untouched film drift faster than the tare can follow.

    The tare follows a drift with its time constant. The charges then differ from 0 by the drift times this time. If the
    size of this difference exceeds the touch threshold, a contact begins without a touch. This does not apply to
    a negative total drift, because a touch makes most charges positive.

    Args:
        examination: The other results of the port check.
        device: Settings of the board.
        tare_rule: Conditions of the tare, with its time constant.
    """
    touch_rule = device.rule(TouchRule)
    follows_drift = device.rule(LeakSection) or device.rule(MemoryRule) or device.front_end == "current"
    if touch_rule is None or follows_drift or not examination.channels:
        return
    drift_pC_per_s = np.array([channel.drift_pC_per_s or 0.0 for channel in examination.channels])
    total_pC_per_s = float(drift_pC_per_s.sum())
    noise_pC = np.array([channel.noise_pC or 0.0 for channel in examination.channels])
    threshold_pC = touch_rule.resolved(has_currents=False).threshold_pC(noise_pC)
    if total_pC_per_s > 0.0 and np.linalg.norm(drift_pC_per_s * tare_rule.relax_s / threshold_pC) > 1.0:
        yield (
            f"the charges drift by {total_pC_per_s:.2g} pC/s in total, which the tare cannot follow: an untouched film "
            f"seems to be touched, and the records have the flag {DRIFT}; let the amplifier warm up, or put [leak] "
            "with the time constants of the amplifiers into a device file, which also measures the drift at rest"
        )


def held_press_sentences(capture: Capture, device: Device, held_press: HeldPress | None) -> Iterator[str]:
    """Yield one sentence for each missing setting or property without which the force of a held press seems to change.

    The force seems to change because the amplifiers leak. Touches are computed in any case.

    - If the device file contains time constants of a leak, each frame must contain the time of a clock of the device.
    - If the user has held a press during the check, the settings that correct the press are requested, unless the
      device file contains them.
    - If no press was held, the time constants of the amplifiers are requested, unless the device file contains them.

    Args:
        capture: The frames.
        device: Settings of the board.
        held_press: Press that was held during the check; None if no press was held.
    """
    if not capture.frames:
        return
    has_device_clock = capture.frames[0].t_us is not None
    if device.rule(LeakSection) is not None and not has_device_clock:
        yield (
            "send the time of a device clock in each frame (t_us, t_ms or t_s): without it the leak is corrected with "
            "the arrival times, which jitter"
        )
    if held_press is not None:
        # The sections are parts of a device file that make the charge of this press constant.
        for section_name, settings in held_press.sections.items():
            if section_name not in device.table:  # the device file has no such section yet
                yield f"put {section_text(section_name, settings)} into a device file"
    elif device.front_end == "current":
        yield (
            "listen for 20 s with --seconds 20, press once after the third second, and release the press: the charge "
            "that remains then shows whether the integral of the currents needs a leak ([leak] tau_s)"
        )
    elif device.rule(LeakSection) is None:
        yield (
            "state the time constants of the amplifiers in a device file ([leak] tau_s): without them the force of a "
            "held press seems to decrease. The time constants follow from the circuit. To measure them instead, listen "
            "for 20 s with --seconds 20, and hold a press with a weight from the third second on"
        )
