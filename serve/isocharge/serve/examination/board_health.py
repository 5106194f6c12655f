"""Health of the channels of a board at rest, and messages about what a board needs before it can provide contacts."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import ChargeError, printable, shown
from isocharge.serve.examination.held_press import HeldPress
from isocharge.serve.examination.listening import Capture, elapsed_times
from isocharge.serve.port.source import has_speed
from isocharge.serve.signal_chain.channels import Channels
from isocharge.serve.signal_chain.hum import HumRule
from isocharge.serve.signal_chain.leak import LeakRule
from isocharge.serve.signal_chain.stage import LARGEST, Device, Setup
from isocharge.serve.signal_chain.tare import TareRule

MAINS_HZ = (50.0, 60.0)
"""Frequencies at which hum is searched for, Hz."""


@dataclass(frozen=True)
class ChannelHealth:
    """Health of one channel.

    The results are in pC if the gain of the channel is known, and otherwise in the unit of the board. Offset, noise,
    drift, hum and span are None if no value of the channel is usable.

    Attributes:
        name: Name that the device uses, or the number of the channel, counted from 1.
        electrode: Electrode to which the channel is assumed to belong; the name of the channel if the electrode is not
            clear.
        offset_pC: Mean charge.
        noise_pC: Standard deviation of the charge without drift and hum.
        drift_pC_per_s: Slope of the charge.
        hum_pC: Amplitudes of the hum at 50 and at 60 Hz. An amplitude is None if the frame rate is too low or the time
            is too short to estimate it.
        span_pC: Difference between the largest and the smallest value.
        unusable: Number of values that are not finite, or whose magnitude is larger than any charge of a film.
        unusable_value: The first unusable value as a text, such as "nan"; empty if all values are usable.
    """

    name: str
    electrode: str
    offset_pC: float | None = None
    noise_pC: float | None = None
    drift_pC_per_s: float | None = None
    hum_pC: tuple[float | None, float | None] = (None, None)
    span_pC: float | None = None
    unusable: int = 0
    unusable_value: str = ""


def measure_channel_health(
    name: str, electrode: str, charge_pC: Array, times_s: Array, rate_Hz: float
) -> ChannelHealth:
    """Measure the offset, the noise, the drift and the hum of a channel while the film is at rest.

    The function ignores NaN and values whose magnitude is larger than `LARGEST`.

    Args:
        name: Name of the channel.
        electrode: Electrode to which the channel is assumed to belong.
        charge_pC: Values, shape (n,), pC, or in the unit of the board if the gain is not known.
        times_s: Times since the first frame, shape (n,), s.
        rate_Hz: Frames per second, Hz.

    Returns:
        The health of the channel. If no value is usable, the result contains only the number of unusable values and the
        first of them.
    """
    is_usable = np.abs(charge_pC) <= LARGEST  # false for NaN
    unusable_pC = charge_pC[~is_usable]
    unusable_value = f"{unusable_pC[0]:g}" if len(unusable_pC) else ""
    health = ChannelHealth(name, electrode, unusable=len(unusable_pC), unusable_value=unusable_value)
    if not is_usable.any():
        return health
    usable_pC = charge_pC[is_usable]
    drift_pC_per_s, hum_pC, noise_pC = _fit_drift_and_hum(usable_pC, times_s[is_usable], rate_Hz)
    return replace(
        health,
        offset_pC=float(usable_pC.mean()),
        noise_pC=noise_pC,
        drift_pC_per_s=drift_pC_per_s,
        hum_pC=hum_pC,
        span_pC=float(np.ptp(usable_pC)),  # largest minus smallest value
    )


def _fit_drift_and_hum(
    charge_pC: Array,
    times_s: Array,
    rate_Hz: float,
    min_samples_per_period: float = 2.2,
    min_hum_time_s: float = 0.5,
) -> tuple[float, tuple[float | None, float | None], float]:
    """Fit a constant, a slope (the drift) and the hum at each mains frequency to a charge by least squares.

    In a short time, a hum cannot be distinguished from a drift. At a low frame rate, a hum cannot be sampled. In both
    cases, the hum is left out.

    Args:
        charge_pC: Charge, shape (n,), pC.
        times_s: Times since the first frame, shape (n,), s.
        rate_Hz: Frames per second, Hz.
        min_samples_per_period: Smallest number of frames per period of a hum for which the hum is estimated. The
            default is 10 % above the Nyquist rate.
        min_hum_time_s: Shortest time of measurement for which a hum is estimated, s. The default gives a resolution of
            2 Hz, which separates 50 Hz from 60 Hz.

    Returns:
        The slope, pC/s; the amplitudes of the hum at 50 and at 60 Hz, pC, each None if it is left out; and the standard
        deviation of the residuals, which is the noise, pC.
    """
    is_long = times_s[-1] > min_hum_time_s
    fitted_Hz = [hum_Hz for hum_Hz in MAINS_HZ if is_long and rate_Hz > min_samples_per_period * hum_Hz]
    phases = 2.0 * np.pi * np.outer(times_s, fitted_Hz)  # shape (n, frequencies)
    design_matrix = np.column_stack([np.ones_like(times_s), times_s, np.cos(phases), np.sin(phases)])
    coefficients = np.linalg.lstsq(design_matrix, charge_pC, rcond=None)[0]
    _constant, drift_pC_per_s, *factors = coefficients.tolist()
    cosines, sines = np.reshape(factors, (2, -1))  # factors of the cosines and of the sines, shape (frequencies,)
    hum_pC = dict(zip(fitted_Hz, np.hypot(cosines, sines).tolist(), strict=True))
    noise_pC = float((charge_pC - design_matrix @ coefficients).std())
    return drift_pC_per_s, (hum_pC.get(50.0), hum_pC.get(60.0)), noise_pC


LIVE_TIME_s = 0.5
"""Shortest time in which the frames of a board arrive, s. Frames from a file arrive within a shorter time."""

CLEAN_SHARE = 0.99
"""Smallest share of bytes that belong to good frames if the cable and the baud rate are right, dimensionless."""


def transmission_sentences(capture: Capture) -> Iterator[str]:
    """Yield a sentence for each fault of the transmission, or only one sentence if no frames were received.

    Args:
        capture: The frames, with their bytes, the share of intact bytes and the gaps in the frame numbers.
    """
    received = capture.received
    unread_line = shown(capture.parser.unread_line) if capture.parser.unread_line else ""

    # State at most one of these faults: no bytes, no frames, or damaged frames.
    if has_speed(received.url):  # only a serial port has a baud rate
        advice = "check the cable, and whether the baud rate of the board is exact"
    else:
        advice = (
            "if a serial server uses the telnet protocol, which doubles each byte 0xFF, set the port of the server to "
            'raw TCP (also called "raw", "TCP server" or "TCP socket")'
        )
    if not received.bytes_seen:
        yield (
            "no bytes were received: check the power and the cable; if the board sends only after a request, state the "
            "request with --request"
        )
    elif not capture.frames and unread_line:
        yield (
            f"the lines of text are not understood, for example {unread_line}: send the numbers of all channels in "
            "each line, with the same text between them, decimal points instead of commas, and 0x before hexadecimal "
            "numbers; a line that begins with # is a comment"
        )
    elif not capture.frames:
        yield (  # with the latest chunk of bytes as an example
            f"bytes were received, such as {shown(received.data[-1])}, but no frames were recognised: try another baud "
            "rate with --baud, end each line of text with a line feed, or describe the format in a device file "
            f"(--device); {advice}; a board without noise shows its channels only while the film is touched"
        )
    # The bytes of one frame are added to the intact bytes, because the first frame is often incomplete.
    elif capture.intact_share + 1.0 / len(capture.frames) < CLEAN_SHARE:
        damaged = f"{1.0 - capture.intact_share:.1%} of the bytes do not belong to good frames"
        if unread_line:
            damaged += (
                f", such as the line {unread_line}: send a number for each channel, and nan for a channel without a "
                "value; if the line is damaged"
            )
        yield f"{damaged}: {advice}"

    # Compare the clock of the board with the arrival times, unless the frames come from a file, whose bytes all arrive
    # within less than `LIVE_TIME_s`.
    has_clock = capture.frames and all(frame.t_us is not None for frame in capture.frames)
    if has_clock and received.span_s > LIVE_TIME_s:
        clock_span_s = float(elapsed_times(capture.frames)[-1])
        if not 0.5 < clock_span_s / received.span_s < 2.0:
            yield (
                f"the frames took {clock_span_s:.3g} s by the clock of the board, but arrived within "
                f"{received.span_s:.3g} s: send a clock that runs, in the unit that its name states (t_us, t_ms or t_s)"
            )
    if capture.parser.counts.lost:
        yield f"{capture.parser.counts.lost} frames were lost: send fewer frames per second, or use a faster link"


def channel_count_sentences(
    capture: Capture, device: Device, channel_count: int, electrodes: tuple[str, ...]
) -> Iterator[str]:
    """Yield a sentence if the channels of the board do not fit the device file or the model.

    The sentence names a channel of the device file that the board does not send, or states that the board sends more or
    fewer channels than the model has electrodes. If the names of the channels are nearly those of the electrodes, the
    sentence names the difference. The channels are not compared with the model if there is no model, or if the device
    file assigns a channel to every electrode.

    The function searches for the channels in the same way as a stream, with two methods of `Channels`. If one of the
    methods raises an error, the message of the error is the sentence. The results of the methods are not used.

    Args:
        capture: The frames, at least one.
        device: Settings of the board.
        channel_count: Number of channels that are used.
        electrodes: Electrodes of the model; empty for any model.
    """
    try:
        # Raise an error if the board lacks a channel that the device file names.
        if device.channels:
            Channels(Setup(tuple(device.channels), device)).channel_indices(capture.frames[-1])
        # Do not compare the channels with the model if the device file already assigns a channel to every electrode of
        # the model. This is also the case without a model, because there are then no electrodes.
        if set(electrodes) <= set(device.channels):
            return
        # Raise an error if the names of the channels are nearly those of the electrodes. The error calls the model the
        # `reader` of the channels. The units in the names are not checked here.
        Channels(Setup(electrodes, reader="the model"), any_unit=True).indices_by_name_or_order(capture.frames[-1])
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
    """Yield a sentence if the charge of one unit of the channels is not known.

    Args:
        unit: Unit of the channels, such as "pC" or "counts".
    """
    if unit != "pC":
        yield (
            f"the channels seem to be in {unit}: state the charge of one unit in pC with --pc-per-unit NUMBER; "
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

    A tare is the measurement of the charges at rest. A tare requires that the noise and the offset of each channel are
    small. The limits of offset, noise, drift and hum are in pC.

    Args:
        channels: Offset, noise, drift and hum of each channel.
        unit: Unit of the channels.
        device: Settings of the board.
        max_drift_pC_per_s: Largest harmless drift, pC/s.
        max_hum_pC: Largest harmless amplitude of hum, pC. The default is below the noise of the film.
    """
    tare_rule = device.rule(TareRule) or TareRule()  # the defaults if the device file has no tare
    hum_rule = device.rule(HumRule)
    removed_Hz = None if hum_rule is None else hum_rule.frequency_Hz  # frequency of the hum that the stream removes
    # A current of any size at rest is an offset.
    offset_limit_pC = math.inf if device.has_currents else tare_rule.offset_limit_pC
    for channel in channels:
        name = f"channel {printable(channel.name)}"
        if channel.unusable:
            yield (
                f"{name} is {channel.unusable_value} in {channel.unusable} frames, which is not a charge: check the "
                "amplifier and the wire of this channel"
            )
        if channel.span_pC == 0.0:
            yield (
                f"{name} is dead: every value is {channel.offset_pC:g}; check the amplifier and the wire of this "
                "channel, or send more digits"
            )
        # The limits below are in pC. Of a channel without a usable value, only the unusable values are reported.
        if unit != "pC" or channel.noise_pC is None or channel.offset_pC is None or channel.drift_pC_per_s is None:
            continue
        if channel.noise_pC > tare_rule.noise_limit_pC:
            yield (
                f"{name} has a noise of {channel.noise_pC:.3g} pC rms, but a tare needs less than "
                f"{tare_rule.noise_limit_pC:g} pC"
            )
        if abs(channel.offset_pC) > offset_limit_pC:
            yield (
                f"{name} has {channel.offset_pC:.4g} pC at rest, but a tare accepts at most "
                f"{offset_limit_pC:g} pC: remove what lies on the film; if the amplifier rests at this value, "
                "subtract it with [gain] offset, which --write puts into the device file"
            )
        if abs(channel.drift_pC_per_s) > max_drift_pC_per_s and device.rule(LeakRule) is None:
            yield (
                f"{name} drifts by {channel.drift_pC_per_s:.2g} pC/s, so that an untouched film may seem touched: "
                "let the amplifier warm up, or put [leak] with the time constants of the amplifiers into a device file"
            )
        for frequency_Hz, hum_pC in zip(MAINS_HZ, channel.hum_pC, strict=True):
            if hum_pC is not None and hum_pC > max_hum_pC and frequency_Hz != removed_Hz:
                yield f"{name} has a hum of {hum_pC:.2g} pC: set [hum] frequency_Hz = {frequency_Hz:g} in a device file"


def held_press_sentences(capture: Capture, device: Device, held_press: HeldPress) -> Iterator[str]:
    """Yield one sentence for each missing setting or property that keeps the computed force of a held press constant.

    The charge amplifiers leak: the charge of a held press decays with a time constant, which the section `[leak]` of
    the device file states. The program corrects the leak with the times of the frames. Two things may be missing:

    - A device clock. If the leak is corrected, each frame should contain the time of a clock of the device.
    - The time constants. The user is asked for them if the device file contains no leak and no press was held during
      the check. If a press was held, its description already states the time constants. A board that sends currents
      instead of charges needs no time constants.

    Args:
        capture: The frames, at least one.
        device: Settings of the board.
        held_press: Press that was held during the check.
    """
    has_device_clock = capture.frames[0].t_us is not None
    is_leak_corrected = device.rule(LeakRule) is not None
    if is_leak_corrected and not has_device_clock:
        yield (
            "send the time of a device clock in each frame (t_us, t_ms or t_s): without it the leak is corrected with "
            "the arrival times, which jitter"
        )
    was_press_held = held_press.description != ""
    if not was_press_held and not is_leak_corrected and not device.has_currents:
        yield (
            "state the time constants of the amplifiers in a device file ([leak] tau_s): without them the force of a "
            "held press seems to decrease. The time constants follow from the circuit. To measure them instead, listen "
            "for 20 s with --seconds 20, and hold a press with a weight from the third second on"
        )
