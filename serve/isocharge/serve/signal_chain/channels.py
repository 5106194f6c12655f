"""Assignment of the channels of a frame to the electrodes."""

import re
from collections.abc import Iterable
from json import dumps
from operator import itemgetter

import numpy as np

from isocharge.common.errors import ChargeError, cut, shown
from isocharge.serve.frames.frame import OTHER_CHARGE_UNITS, Frame
from isocharge.serve.signal_chain.gain import GainRule
from isocharge.serve.signal_chain.stage import Setup, Stage

MAX_CHANNEL_DIGITS = 4
"""Largest number of digits in a text that is recognised as the number of a channel."""

_UNITS = "|".join(["pC", *OTHER_CHARGE_UNITS])

_UNIT = re.compile(rf"(?:[_\s]({_UNITS})|\s*[\[(]\s*({_UNITS})\s*[\])])$")
"""Unit at the end of the name of a channel, such as `_nC` or `[nC]`."""

_NUMBERED = re.compile(rf"(\D*)(\d{{1,{MAX_CHANNEL_DIGITS}}})(\D*)", re.ASCII)
"""Name of a channel that contains one number, such as `ch2` or `adc0_raw`."""


class Channels(Stage):
    """Selects the values in a frame that belong to the electrodes.

    The section `[channels]` of the device file states the name or the number of the channel of each electrode. If the
    device file has no section `[channels]`, a channel belongs to the electrode with the same name. The name of a
    channel may have a unit, as in `A_pC`, may contain further words, as in `charge.A` or `A_raw`, and may differ by
    case. If no channel has the name of an electrode, or nearly so, the channels are assigned by their order, or by
    their numbers if the names differ only by a number, as `ch0` and `ch1` do: the first channel belongs to the first
    electrode, and so on. An assignment by order requires as many channels as electrodes.
    """

    is_required = True

    def __init__(self, setup: Setup, *, any_unit: bool = False) -> None:
        """Store which channel the device file assigns to each electrode.

        Args:
            setup: Settings of all stages.
            any_unit: Whether the names of the channels may contain any unit, even if the gain is not known.
        """
        self._allows_any_unit = any_unit or setup.rule(GainRule) is not None
        self._electrodes = setup.electrodes
        self._channels = setup.channels
        self._reader = setup.reader
        self._where = setup.where
        # Names, number of values and channel indices of the previous frame. `step` uses the indices again.
        self._previous_names: tuple[str, ...] | None = None  # None before the first frame
        self._previous_n_values = -1
        self._channel_indices: tuple[int, ...] = ()

    def step(self, frame: Frame) -> None:
        """Store the values of a frame in the order of the electrodes, in the unit of the device.

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
        frame.sent = np.array(values, dtype=float).reshape(-1)

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
        return _order_of_channels(channel_names(frame))

    def named_indices(self, frame: Frame) -> tuple[int, ...] | None:
        """Return, for each electrode, the index of the channel with its name in `frame.values`.

        The result is None if no channel has the name of an electrode, or nearly so.

        Raises:
            ChargeError: If the names of the channels are those of some electrodes only, or nearly those of electrodes,
                or if they state a unit other than pC and the gain is not known.
        """
        names = frame.names
        if not names:
            return None
        advice = [] if self._allows_any_unit else _unit_advice(names)
        indices = [_channels_of_electrode(electrode, names) for electrode in self._electrodes]
        if all(len(indices_of_electrode) == 1 for indices_of_electrode in indices) and not advice:
            return tuple(indices_of_electrode[0] for indices_of_electrode in indices)

        # Names of which some are those of electrodes, or nearly so, must not be assigned by their order.
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
    """Return the indices of the channels whose name is that of an electrode.

    Case matters only if both cases occur. Further words in the names of the channels are ignored only if no channel has
    the name of the electrode without them.

    Args:
        electrode: Name of the electrode.
        names: Names of the channels.
    """
    electrodes = [electrode_of(name) for name in names]
    equal = [index for index, name in enumerate(electrodes) if name == electrode]
    equal = equal or [index for index, name in enumerate(electrodes) if name.casefold() == electrode.casefold()]
    required_words = _words_of(electrode)
    if equal or not required_words:
        return equal
    return [index for index, name in enumerate(names) if required_words <= _words_of(name)]


def _words_of(text: str) -> set[str]:
    """Return the words of a text in lower case. All characters except letters and digits separate words."""
    return {word for word in re.split(r"[\W_]+", text.casefold()) if word}


def _order_of_channels(names: tuple[str, ...]) -> tuple[int, ...]:
    """Return the indices of channels by the numbers in their names, or in their order if there are no such numbers.

    The numbers are used only if the names differ by nothing else.

    Args:
        names: Names of the channels.
    """
    indices = range(len(names))
    matches = [match for name in names if (match := _NUMBERED.fullmatch(name)) is not None]
    texts_around_number = {(match[1], match[3]) for match in matches}
    if len(matches) < len(names) or len(texts_around_number) != 1:
        return tuple(indices)
    return tuple(sorted(indices, key=lambda index: int(matches[index][2])))


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
