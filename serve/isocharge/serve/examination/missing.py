"""Messages to the user about settings and properties that a board needs before it can provide contacts."""

from collections.abc import Iterator
from dataclasses import dataclass

from isocharge.common.printable_text import printable
from isocharge.serve.examination.channel_health import MAINS_HZ, ChannelHealth
from isocharge.serve.examination.held_press import HeldPress
from isocharge.serve.examination.listening import Capture
from isocharge.serve.live.device import Device
from isocharge.serve.live.fading import section_text
from isocharge.serve.signal_chain.tare import TareRule

CLEAN_SHARE = 0.99
"""Smallest share of bytes in good frames with a good cable and the right baud rate, dimensionless."""

HUM_LIMIT_PC = 0.5
"""Largest harmless amplitude of hum, pC. It is below the noise of the film."""

DRIFT_LIMIT_PC_PER_S = 2.0
"""Largest harmless drift, pC/s."""

GAIN_REQUESTS = {
    "counts": "the charge of one count, pC: --pc-per-unit NUMBER, negative where the amplifier inverts (1 if these are "
    "pC)",
    "V": "the amplifier's feedback capacitance, if these are volts: --v-per-unit 1 --feedback-pf NUMBER; or the charge "
    "of one unit, pC: --pc-per-unit NUMBER (1 if these are pC)",
}
"""Request to the user for the gain, by the unit of the channels."""


@dataclass(frozen=True)
class BoardFindings:
    """Results of the port check from which the missing settings and properties are derived.

    Attributes:
        capture: The frames.
        channels: Health of the channels that electrodes use.
        unused: Names of the other channels.
        device: Settings of the board.
        electrodes: Electrodes of the model; empty for any model.
        unit: Unit of the channels: "pC", "counts" or "V".
        held: Press that was held during the check; None if there was none.
        touch: Sentence about a touch of the film, which should be at rest; empty if there was none.
    """

    capture: Capture
    channels: tuple[ChannelHealth, ...]
    unused: tuple[str, ...]
    device: Device
    electrodes: tuple[str, ...]
    unit: str
    held: HeldPress | None
    touch: str


def missing_sentences(findings: BoardFindings) -> Iterator[str]:
    """Yield one sentence for each setting or property that is missing before contacts can be computed."""
    capture = findings.capture
    if not capture.bytes_seen:
        yield "not one byte came: check power and cable, and whether the board sends unasked (if not: --request)"
        return
    if not capture.frames:
        yield (
            "bytes come, but no frames: another baud rate (--baud), or a format for a device file (--device); a board "
            "without noise shows its channels only while the film is touched"
        )
        return
    if findings.touch:
        yield findings.touch
    yield from _transmission_sentences(capture)
    yield from _channel_count_sentences(findings)
    if findings.unit != "pC":
        yield GAIN_REQUESTS[findings.unit]
    for channel in findings.channels:
        if channel.span_pC == 0.0:
            yield f"life on channel {printable(channel.name)}: every value is {channel.offset_pC:g}"
        if findings.unit == "pC":
            yield from _charge_sentences(channel, findings.device.tare or TareRule())


def _transmission_sentences(capture: Capture) -> Iterator[str]:
    """Yield a sentence if bytes are damaged, and another sentence if frames are missing."""
    if capture.intact_share < CLEAN_SHARE:
        damaged_share = 1.0 - capture.intact_share
        yield f"{damaged_share:.1%} of the bytes are no good frames: a bad cable, or a rate that is a little off"
    if capture.gaps.lost:
        yield f"{capture.gaps.lost} frames lost: a slower rate, or a faster link"


def _channel_count_sentences(findings: BoardFindings) -> Iterator[str]:
    """Yield a sentence if the board has more or fewer channels than the model has electrodes."""
    electrodes = findings.electrodes
    channel_count = len(findings.channels)
    are_channels_assigned = set(findings.device.channels) >= set(electrodes)
    if not electrodes or channel_count == len(electrodes) or are_channels_assigned:
        return
    channels = f"{channel_count} channels"
    if findings.unused:
        channels += f" that live, of {len(findings.capture.names)}"
    yield (
        f"{channels}, but the model has the electrodes {electrodes}: another model (--model), or [channels] in a "
        "device file"
    )


def _charge_sentences(channel: ChannelHealth, rule: TareRule) -> Iterator[str]:
    """Yield a sentence for each property of the charges of a channel that prevents a tare or disturbs the contact.

    Args:
        channel: Health of the channel, whose unit is pC.
        rule: Conditions of the tare.
    """
    name = printable(channel.name)
    noise_pC = channel.noise_pC or 0.0
    offset_pC = channel.offset_pC or 0.0
    drift_pC_per_s = channel.drift_pC_per_s or 0.0
    if channel.unusable:
        yield f"charges on channel {name}: {channel.unusable} values are no numbers, or absurd"
    if noise_pC > rule.noise_limit_pC:
        yield f"quiet on channel {name}: {noise_pC:.3g} pC rms, for a tare {rule.noise_limit_pC:g}"
    if abs(offset_pC) > rule.offset_limit_pC:
        yield (
            f"rest near zero on channel {name}: {offset_pC:.4g} pC, a tare takes {rule.offset_limit_pC:g} (is "
            "something lying on the film? or does the amplifier rest there? then [gain] offset, as --write has it)"
        )
    if abs(drift_pC_per_s) > DRIFT_LIMIT_PC_PER_S:
        yield f"a steady channel {name}: it drifts by {drift_pC_per_s:.2g} pC/s"
    for frequency_Hz, hum_pC in zip(MAINS_HZ, channel.hum_pC, strict=True):
        if hum_pC is not None and hum_pC > HUM_LIMIT_PC:
            yield f"[hum] frequency_Hz = {frequency_Hz:g} (device file): channel {name} hums by {hum_pC:.2g} pC"


def held_press_sentences(findings: BoardFindings) -> Iterator[str]:
    """Yield a sentence for each setting or property that is missing before held presses keep their force.

    The settings correct the leak of the amplifiers. Touches are also computed without these settings.

    If the user has held a press during the check, the result of this press determines the settings. Otherwise a
    sentence asks for the time constants of the amplifiers, unless the device file contains the time constants.
    """
    if not findings.capture.frames:
        return
    device = findings.device
    held = findings.held
    if findings.capture.frames[0].t_us is None and device.leak is not None:
        yield "a device clock (t_us, t_ms or t_s): without it the leak is undone by arrival times, which jitter"
    if held is not None:
        for name, section in held.sections.items():
            if name not in device.table:
                yield f"{section_text(name, section)} in a device file"
    elif device.leak is None:
        yield (
            "the amplifier's time constants ([leak] tau_s in a device file), of its circuit: without them held presses "
            "fade. To measure them, listen for 20 s (--seconds 20), and from the third on hold a press with a weight"
        )
