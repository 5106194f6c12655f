"""Computation of touch charges from chunks of bytes.

A parser finds the frames in the bytes, and a clock computes the time of each frame. The channels of each frame are
assigned to the electrodes, and the signal chain computes the touch charges.

The touch charges do not depend on a model of the film, unless the signal chain estimates warming.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from json import dumps
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import ChargeError, NoFramesError, TareError, cut, shown
from isocharge.common.tables.header_advice import OTHER_UNITS, header_advice
from isocharge.common.tables.number_table import CHARGE_RULE
from isocharge.serve.flags import RECONNECTED
from isocharge.serve.frames.frame import SATURATED_BIT, Frame, Parser, SequenceGaps
from isocharge.serve.frames.frame_layout import FrameLayout
from isocharge.serve.live.device import ANY_BOARD, Device
from isocharge.serve.port.device_clock import DeviceClock, ReadingTime
from isocharge.serve.port.serial_line import TELNET_ADVICE, without_telnet
from isocharge.serve.port.source import Chunk
from isocharge.serve.signal_chain.chain import Chain, Reading, SignalChain
from isocharge.serve.signal_chain.thermal import Misfit

MAX_CHANNEL_DIGITS = 4
"""Largest number of digits in a text that is recognised as the number of a channel."""

BYTES_TO_RECOGNISE = 8192
"""If a stream contains no intact frame in more than this number of bytes, an error is raised."""

_UNITS = "|".join(["pC", *OTHER_UNITS["pC"]])

_UNIT = re.compile(rf"(?:_({_UNITS})|\s*[\[(]\s*({_UNITS})\s*[\])])$")
"""Unit at the end of the name of a channel, such as `_nC` or `[nC]`."""


class ChannelPicker:
    """Selector of the values in a frame that belong to the electrodes.

    The section `[channels]` of the device file states the name or the number of the channel of each electrode. If the
    device file has no section `[channels]`, a channel belongs to the electrode with the same name. The name of a
    channel may have a prefix or a suffix, as in `A_pC` or `charge.A`, and may differ by case. If no channel has the
    name of an electrode, or nearly so, the channels are assigned by their order, or by their numbers if all names are
    numbers such as `ch2`: the first channel belongs to the first electrode, and so on. An assignment by order requires
    as many channels as electrodes.
    """

    def __init__(
        self,
        electrodes: tuple[str, ...],
        channels: Mapping[str, str],
        reader: str,
        where: str = "device file",
        *,
        has_gain: bool = False,
    ) -> None:
        """Store which channel the device file assigns to each electrode.

        Args:
            electrodes: Names of the electrodes, in the order of the charges.
            channels: Name or number of the channel by electrode name. It is empty if the device file has no section
                `[channels]`.
            reader: Name of the program part that needs these electrodes, for messages, such as "model three/1".
            where: Name of the device file, for messages.
            has_gain: Whether the device file states the gain, so that names of channels may contain any unit.
        """
        self._has_gain = has_gain
        self._electrodes = electrodes
        self._channels = channels
        self._reader = reader
        self._where = where
        # Names, number of values and channel indices of the previous frame. `pick` uses the indices again.
        self._previous_names: tuple[str, ...] | None = None  # None before the first frame
        self._previous_n_values = -1
        self._channel_indices: tuple[int, ...] = ()

    def pick(self, frame: Frame) -> Array:
        """Return the values of a frame in the order of the electrodes, shape (n_electrode,), in the unit of the device.

        If the previous frame had the same names and the same number of values, its channel indices are used again.

        Raises:
            ChargeError: If the frame has no value for an electrode.
        """
        if frame.names != self._previous_names or len(frame.values) != self._previous_n_values:
            self._channel_indices = self.channel_indices(frame)
            self._previous_names = frame.names
            self._previous_n_values = len(frame.values)
        # With several indices, `itemgetter` returns a tuple. With a single index, it returns a number, which `reshape`
        # converts to an array with one element.
        values = itemgetter(*self._channel_indices)(frame.values)
        return np.array(values, dtype=float).reshape(-1)

    def channel_indices(self, frame: Frame) -> tuple[int, ...]:
        """Return, for each electrode, the index of its channel in `frame.values`.

        The section `[channels]` of the device file assigns the channels. Without this section, they are assigned by
        their names, and otherwise by their order.

        Raises:
            ChargeError: If the frame lacks a channel that the device file names, or if the channels cannot be assigned
                by their names or by their order.
        """
        if self._channels:
            return tuple(self._assigned_index(electrode, frame) for electrode in self._electrodes)
        indices = self.named_indices(frame)
        if indices is not None:
            return indices
        if len(frame.values) != len(self._electrodes):
            raise self._assignment_error(frame)
        numbers = [number for name in channel_names(frame) if (number := channel_number(name)) is not None]
        order = range(len(frame.values))
        return tuple(sorted(order, key=numbers.__getitem__) if len(numbers) == len(order) else order)

    def named_indices(self, frame: Frame) -> tuple[int, ...] | None:
        """Return, for each electrode, the index of the channel with its name in `frame.values`.

        The result is None if no channel has the name of an electrode, or nearly so.

        Raises:
            ChargeError: If the names of the channels are those of some electrodes only, or nearly those of electrodes,
                or if they state a unit other than pC and the gain is not known.
        """
        names = frame.names
        advice = [] if self._has_gain else _unit_advice(names)
        indices = [_channels_of_electrode(electrode, names) for electrode in self._electrodes]
        if all(len(indices_of_electrode) == 1 for indices_of_electrode in indices) and not advice:
            return tuple(indices_of_electrode[0] for indices_of_electrode in indices)

        # Names of which some are those of electrodes, or nearly so, must not be assigned by their order.
        absent = [name for name, found in zip(self._electrodes, indices, strict=True) if len(found) != 1]
        unused = [name for index, name in enumerate(names) if [index] not in indices]
        advice = advice or list(header_advice(unused, dict.fromkeys(absent, CHARGE_RULE.meaning)))
        if any(indices) or advice:
            raise self._assignment_error(frame, advice)
        return None

    def _assignment_error(self, frame: Frame, advice: Iterable[str] = ()) -> ChargeError:
        """Return the error for a frame whose channels cannot be assigned to the electrodes.

        Args:
            frame: The frame.
            advice: Sentences about single channels.
        """
        number = "a frame" if frame.seq is None else f"frame {frame.seq}"
        example_keys = ", ".join(f'{electrode} = "..."' for electrode in self._electrodes)
        return ChargeError(
            f"{self._reader} expects {len(self._electrodes)} charges {self._electrodes}, {number} has "
            f"{len(frame.values)} {channel_names(frame)}{''.join(f'; {sentence}' for sentence in advice)}; choose the "
            f"model of this sensor, or say in the device file which is which: [channels] {example_keys}"
        )

    def _assigned_index(self, electrode: str, frame: Frame) -> int:
        """Return the index in `frame.values` of the channel that the device file assigns to an electrode.

        If the section `[channels]` does not contain the electrode, its channel has the name of the electrode.

        Args:
            electrode: Name of the electrode.
            frame: A frame of the board.

        Raises:
            ChargeError: If the frame has no such channel.
        """
        channel = self._channels.get(electrode, electrode)
        index = channel_index(channel, frame)
        if index is None:
            raise ChargeError(
                f"{self._where}: [channels] {electrode} = {dumps(cut(channel))}: no channel is called that; the frames "
                f"have {cut(', '.join(channel_names(frame)))}, or 1 to {len(frame.values)} in their order"
            )
        return index


def check_channels(device: Device, electrodes: tuple[str, ...], reader: str) -> None:
    """Check before the first frame arrives that each electrode has a channel.

    If the device file describes the layout of binary frames, the channels are already known. They are assigned to the
    electrodes in the same way as in a received frame.

    Otherwise, the channels are determined from the first frame. Only the section `[channels]` can then be checked: if
    the device file has this section, it must contain a key for each electrode.

    Args:
        device: Settings of the board.
        electrodes: Names of the electrodes, in the order of the charges.
        reader: Name of the program part that needs these electrodes, for messages, such as "model three/1".

    Raises:
        ChargeError: If an electrode has no channel.
    """
    if isinstance(device.frames, FrameLayout):
        picker = ChannelPicker(electrodes, device.channels, reader, device.where, has_gain=device.gain is not None)
        picker.channel_indices(device.frames.frame_of_zeros())  # raises an error if an electrode has no channel
        return
    missing = [name for name in electrodes if name not in device.channels]
    if device.channels and missing:
        raise ChargeError(
            f"{device.where}: [channels] {missing[0]}: {reader} expects a channel for each of the electrodes "
            f"{electrodes}, got {', '.join(device.channels)}; add the electrode, or choose the model of this sensor"
        )


def channel_names(frame: Frame) -> tuple[str, ...]:
    """Return the names of the channels of a frame, or their numbers from 1 as texts if the frame contains no names."""
    if frame.names:
        return frame.names
    return tuple(str(number) for number in range(1, len(frame.values) + 1))


def channel_index(name: str, frame: Frame) -> int | None:
    """Return the index of a channel in the values of a frame, or None if the frame has no such channel.

    Args:
        name: Name of the channel, or its number, such as `2` or `ch2`. The numbers begin with 1.
        frame: A frame of the board.
    """
    if name in frame.names:
        return frame.names.index(name)
    number = channel_number(name)
    if number is None or number > len(frame.values):
        return None
    return number - 1  # indices begin with 0


def channel_number(name: str) -> int | None:
    """Return the channel number in a name such as `2` or `ch2`.

    The channels are counted from 1. The function returns None for the number 0, for a number of more than
    `MAX_CHANNEL_DIGITS` digits, and for a name of any other form.
    """
    digits = name.removeprefix("ch")
    is_number = digits.isascii() and digits.isdigit() and len(digits) <= MAX_CHANNEL_DIGITS
    if is_number and int(digits) > 0:
        return int(digits)
    return None


def _channels_of_electrode(electrode: str, names: tuple[str, ...]) -> list[int]:
    """Return the indices of the channels with the name of an electrode. Case matters only if both cases occur.

    Args:
        electrode: Name of the electrode.
        names: Names of the channels.
    """
    electrodes = [electrode_of(name) for name in names]
    equal = [index for index, name in enumerate(electrodes) if name == electrode]
    return equal or [index for index, name in enumerate(electrodes) if name.casefold() == electrode.casefold()]


def electrode_of(name: str) -> str:
    """Extract the name of the electrode from the name of a channel.

    For example, the function returns `A` if the channel is called `A`, `A_pC`, `A [nC]`, `charge.A` or
    `charge_raw_pC.A`.
    """
    _, _, last_part = name.rpartition(".")
    return _UNIT.sub("", last_part)


def stated_unit(name: str) -> str:
    """Return the unit in the name of a channel, such as nC for `A_nC`; empty if the name states no unit.

    A final `_C` is no unit, because C may be the name of an electrode.
    """
    match = _UNIT.search(name)
    return (match[1] or match[2]) if match is not None and match[1] != "C" else ""


def _unit_advice(names: tuple[str, ...]) -> list[str]:
    """Return advice for the first channel whose name states a unit other than pC; empty without such a channel."""
    for name in names:
        unit = stated_unit(name)
        if unit not in ("", "pC"):
            return [f"channel {shown(name)} is in {unit}: convert it to pC, or state the charge of a unit in [gain]"]
    return []


class TimedReading(NamedTuple):
    """Touch charges that the signal chain has computed from a frame, and the time of the frame."""

    reading: Reading
    time: ReadingTime


class ReadingStream:
    """Stream that computes touch charges from chunks of bytes, and stores the state of the computation.

    Each object may be used by only one thread.

    Attributes:
        parser: Parser that finds the frames in the bytes and counts them.
        gaps: Counter of missing frame numbers.
        clock: Clock of the device.
    """

    def __init__(
        self,
        electrodes: tuple[str, ...],
        device: Device = ANY_BOARD,
        *,
        chain: Chain | None = None,
        parser: Parser | None = None,
        gaps: SequenceGaps | None = None,
        misfit: Misfit | None = None,
        reader: str = "the sensor",
    ) -> None:
        """Create the parser, the counters, the clock and the signal chain.

        Args:
            electrodes: Names of the electrodes, in the order of the charges.
            device: Settings of the board.
            chain: Settings of the signal chain. By default, the settings in the device file are used.
            parser: Parser of the frames. By default, the parser that the device file describes is used.
            gaps: Counter of missing frame numbers. By default, a new counter is created.
            misfit: Function that returns the difference between given charges and those of the nearest contact of a
                model, in standard deviations of the noise. It is only needed if the signal chain estimates warming.
            reader: Name of the program part that needs these electrodes, for messages, such as "model three/1".

        Raises:
            DeviceError: If the device file contains settings for other electrodes.
        """
        self.parser = parser or device.parser()
        self.gaps = gaps or SequenceGaps()
        self.clock = DeviceClock()
        self._device = device
        self._electrodes = electrodes
        self._settings = chain or device.chain(electrodes)
        self._picker = ChannelPicker(
            electrodes, device.channels, reader, device.where, has_gain=device.gain is not None
        )
        self._misfit = misfit
        self._chain = self._new_chain()
        self._pending_flags: tuple[str, ...] = ()  # flags that the next frame gets
        self._unrecognised = b""  # the bytes before the first frame

    @property
    def warming_ratio(self) -> Array | float:
        """Charge that warming adds to each electrode, relative to the mean magnitude over all electrodes.

        The result has the shape (n_electrode,), or is a single number for all electrodes.
        """
        return self._settings.warming_ratios

    def _new_chain(self) -> SignalChain:
        """Return a new signal chain, which has not processed any frames."""
        return SignalChain(self._settings, len(self._electrodes), self._misfit)

    def tare(self) -> None:
        """Discard the tare, and measure it again from the next quiet frames."""
        self._chain.reset_tare()

    def restart(self) -> None:
        """Return to the initial state. The recognised format, the clock, the tare and all counters are discarded."""
        self.parser = self._device.parser()
        self.gaps = SequenceGaps()
        self.clock = DeviceClock()
        self._chain = self._new_chain()
        self._pending_flags = ()

    def feed(self, chunk: Chunk) -> Iterator[TimedReading]:
        """Process a chunk, and yield the touch charges of each frame whose last byte is in the chunk.

        Raises:
            ChargeError: If a frame has no value for an electrode.
            TareError: If the film is touched during the whole search for a tare.
            NoFramesError: If the stream has contained no intact frame in more than `BYTES_TO_RECOGNISE` bytes.
        """
        for frame, time in self.frames(chunk):
            yield self.advance(frame, time)

    def frames(self, chunk: Chunk) -> list[tuple[Frame, ReadingTime]]:
        """Parse a chunk, and return the frames whose last byte is in the chunk, with their times.

        If the chunk follows an outage of the port, the state before the outage is discarded first.

        Raises:
            NoFramesError: If the stream has contained no intact frame in more than `BYTES_TO_RECOGNISE` bytes.
        """
        if chunk.outage_s > 0.0:
            self._reconnect()
        frames = self.parser.feed(chunk.data)
        if not self.parser.counts.frames:
            self._unrecognised += chunk.data
            self._check_recognised()
        times = self.clock.read(chunk, [frame.t_us for frame in frames], self.parser.t_us_modulus)
        return list(zip(frames, times, strict=True))

    def advance(self, frame: Frame, time: ReadingTime) -> TimedReading:
        """Compute the touch charges of the next frame of a chunk.

        The counter of missing frames compares the frame number with the previous frame number. The signal chain
        converts the values of the electrodes to touch charges.

        Args:
            frame: The frame.
            time: Time of the frame.

        Returns:
            The touch charges with the flags of the frame, and the time of the frame.

        Raises:
            ChargeError: If the frame has no value for an electrode.
            TareError: If the film is touched during the whole search for a tare.
        """
        flags = self._pending_flags + self.gaps.update(frame.seq, self.parser.seq_modulus)
        self._pending_flags = ()
        values = self._picker.pick(frame)
        try:
            reading = self._chain.advance(
                values, time.clock_s, time.step_s, limited=bool(frame.flags & SATURATED_BIT), flags=flags
            )
        except TareError as error:
            # The search may have failed because the film is touched, or because the board has large offsets. In the
            # second case, the present values are the offsets. The message therefore states them as settings.
            value_of_electrode = dict(zip(self._electrodes, values.tolist(), strict=True))
            offsets = ", ".join(f"{name} = {value:.10g}" for name, value in value_of_electrode.items())
            setting = "[gain] offset = {" + offsets + "}"
            raise TareError(
                f"{error}; if the board rests there without a touch, say so in a device file: {setting}"
            ) from error
        return TimedReading(reading, time)

    def finish(self) -> None:
        """Finish the stream, for example at the end of a file.

        Raises:
            NoFramesError: If the whole stream has contained no intact frame.
        """
        self._check_recognised(max_bytes=-1)  # raises an error without a frame, even if no bytes have arrived

    def _check_recognised(self, max_bytes: int = BYTES_TO_RECOGNISE) -> None:
        """Raise an error if the parser has found no intact frame in more than `max_bytes` bytes.

        Raises:
            NoFramesError: If more than `max_bytes` bytes have arrived, and none of them belonged to an intact frame.
        """
        counts = self.parser.counts
        if counts.frames or counts.bytes_dropped <= max_bytes:
            return
        unescaped = without_telnet(self._unrecognised)
        uses_telnet = unescaped != self._unrecognised and self._device.parser().feed(unescaped)
        line = f", such as {shown(self.parser.unread_line)}" if self.parser.unread_line else ""
        raise NoFramesError(
            f"no intact frame among the first {counts.bytes_dropped} bytes ({counts.crc_errors} with a wrong CRC, "
            f"{counts.malformed} of another form{line}); {self.parser.format}: "
            f"{TELNET_ADVICE if uses_telnet else 'check baud rate and device'}"
        )

    def _reconnect(self) -> None:
        """Discard the state of the parser, the gap counter, the clock and the tare after an outage of the port.

        The state before the outage is no longer valid, because frames are missing and the film may have been touched
        during the outage. The next frame gets the flag `reconnected`.
        """
        self.parser.reset()
        self.gaps.reset()
        self.clock.reset()
        self.tare()
        self._pending_flags = (RECONNECTED,)
