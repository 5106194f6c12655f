"""Conversion of the values of a board to charges, and detection of presses in which an amplifier was at its limit.

The names or the order of the channels of a board determine which channel belongs to which electrode.
"""

import math
import re
from collections.abc import Sequence
from json import dumps
from operator import itemgetter
from os.path import commonprefix
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import ChargeError, DeviceError, cut, shown
from isocharge.common.structs import Finite, WrongKey
from isocharge.common.toml_text import toml_key
from isocharge.serve.flags import INVALID, SATURATED
from isocharge.serve.frames.frame import OTHER_CHARGE_UNITS, SATURATED_BIT, Frame
from isocharge.serve.signal_chain.stage import LARGEST, Rule, Setting, Setup, Stage

_CHANNEL_NUMBER = re.compile(r"(?:ch)?([1-9][0-9]{0,3})")
"""Number of a channel, such as `2` or `ch2`."""


class GainRule(Rule, frozen=True, kw_only=True):
    """Settings that convert the unit of a board to charge.

    Each setting is either a single number for all electrodes or a separate number for each electrode.

    Attributes:
        pC_per_unit: Charge of one unit, pC. For a board that sends volts, this charge is the feedback capacitance of
            the amplifiers in pF.
        offset: Value that the board sends without charge, in the unit of the board.
    """

    pC_per_unit: Finite | dict[str, Finite]
    offset: Finite | dict[str, Finite] = 0.0

    def __post_init__(self) -> None:
        """Check that the gain is not 0.

        Raises:
            WrongKey: If the gain of an electrode is 0.
        """
        gains = self.pC_per_unit.values() if isinstance(self.pC_per_unit, dict) else [self.pC_per_unit]
        if 0.0 in gains:
            raise WrongKey("pC_per_unit", "a finite number that is not 0, or one for each electrode", self.pC_per_unit)

    def charge_pC(self, electrode: str, values: Array) -> Array:
        """Convert an array of values of one electrode to charges, pC. The default gain is 1."""
        gain_pC = self.pC_per_unit.get(electrode, 1.0) if isinstance(self.pC_per_unit, dict) else self.pC_per_unit
        offset = self.offset.get(electrode, 0.0) if isinstance(self.offset, dict) else self.offset
        return (values - offset) * gain_pC


class Channels:
    """Assignment of the channels of a board to the electrodes.

    The section `[channels]` of the device file states the name or the number of the channel of each electrode. Without
    this section, the channels are assigned by the first rule in this list that applies:

    - A channel belongs to an electrode if the name of the electrode is one of the words in the name of the channel, as
      in `A_pC`, `charge.A` or `electrode a`. The name of the electrode may also be the part in which the names of the
      channels differ, as in `chA`, `chB` and `chC`.
    - If a line of text contains the names of all electrodes, as in `C,A,B: 3,1,2`, the values have the same order.
    - If there are as many channels as electrodes, both have the same order. Numbers in the names of the channels must
      then increase.
    """

    def __init__(self, setup: Setup, *, any_unit: bool = False) -> None:
        """Store which channel the device file assigns to each electrode.

        Args:
            setup: Settings of all stages.
            any_unit: Whether channels may have names with any unit, such as `A_mV`, although the device file states no
                gain that converts the unit to pC.

        Raises:
            DeviceError: If a key of `[channels]` is not the name of an electrode.
        """
        gain = setup.device.rule(GainRule)
        self._allows_any_unit = any_unit or gain is not None
        # Channels with different units need a gain of each electrode. A single number is the same gain for all.
        self._has_gain_per_electrode = gain is not None and isinstance(gain.pC_per_unit, dict)
        self._electrodes = setup.electrodes
        self._channels = setup.device.channels  # name or number of the channel of each electrode; may be empty
        for key in self._channels:
            if key not in setup.electrodes:
                # The message mentions other sections, because TOML adds a key at the end of a file to the last section.
                raise DeviceError(
                    f"{setup.device.where}: channels.{cut(key)}: expected one of the electrodes {setup.electrodes}; "
                    "correct or remove the key; a key outside of all sections belongs above the first section"
                )
        self._setup = setup

    def channel_indices(self, frame: Frame) -> tuple[int, ...]:
        """Return, for each electrode, the index of its channel in `frame.values`.

        The section `[channels]` of the device file assigns the channels. Without this section, the channels are
        assigned by their names. If no channel has the name of an electrode, the channels are assigned by their order.

        Raises:
            ChargeError: If the frame lacks a channel that the device file names, if two electrodes have the same
                channel, if the channels cannot be assigned by their names or by their order, or if they have different
                units and the same gain.
        """
        if self._channels:
            indices = tuple(self._assigned_index(electrode, frame) for electrode in self._electrodes)
        else:
            indices = self.indices_by_name_or_order(frame) or ()
        if not indices:  # no channel has the name of an electrode, and there are more or fewer channels
            raise self._assignment_error(frame)
        if len(set(indices)) < len(indices):
            raise self._assignment_error(frame, "; [channels] gives two electrodes the same channel")
        # A name without a unit counts as a name with the unit pC.
        units = {stated_unit(channel_names(frame)[index]) or "pC" for index in indices}
        if len(units) > 1 and not self._has_gain_per_electrode:
            raise self._assignment_error(frame, "; their units differ: state pC_per_unit of each electrode in [gain]")
        return indices

    def indices_by_name_or_order(self, frame: Frame) -> tuple[int, ...] | None:
        """Find the channel of each electrode by the names or the order of the channels, without the device file.

        The first rule in this list that applies is used:

        1. A channel with the name of an electrode belongs to this electrode.
        2. If a line of text names all electrodes, as in `C,A,B: 3,1,2`, the first name belongs to the first channel,
           the second name to the second channel, and so on.
        3. The first channel belongs to the first electrode, the second channel to the second electrode, and so on.

        Args:
            frame: A frame, whose channels may have names.

        Returns:
            For each electrode, the index of its channel in `frame.values`. None if no channel has the name of an
            electrode, and there are more or fewer channels than electrodes.

        Raises:
            ChargeError: If not exactly one channel has the name of each electrode, if a channel states a unit other
                than pC and the gain is not known, if it is not clear to which values the names in a line of text
                belong, or if the numbers in the names of the channels do not increase.
        """
        named_channels = self._matching_indices(frame.names)  # for each electrode, the channels that have its name
        is_each_named_once = all(len(channels_of_electrode) == 1 for channels_of_electrode in named_channels)
        # If the channels of the electrodes are known, the units of the other channels do not matter.
        names = [frame.names[index] for (index,) in named_channels] if is_each_named_once else frame.names
        unit_advice = "" if self._allows_any_unit else _unit_advice(names)  # empty if no unit is wrong
        if is_each_named_once and not unit_advice:
            return tuple(index for (index,) in named_channels)

        # A line of text may contain all names before or after the values, as in `C,A,B: 3,1,2`.
        words = tuple(word for text in frame.words for word in _words_of(text))
        word_places = self._matching_indices(words)  # for each electrode, the positions of its name among the words
        is_each_in_line_once = all(len(word_places_of_electrode) == 1 for word_places_of_electrode in word_places)
        counts_differ = len(frame.values) != len(self._electrodes)

        # The order decides only if nothing contradicts it. It is contradicted by a channel with the name of an
        # electrode, by a wrong unit, and by a line that names all electrodes but has more or fewer values.
        if any(named_channels) or unit_advice or (is_each_in_line_once and counts_differ):
            raise self._assignment_error(frame, unit_advice)
        if counts_differ:
            return None
        if is_each_in_line_once:  # the first name in the line belongs to the first value, and so on
            places_in_order = sorted(word_places)
            return tuple(places_in_order.index(place) for place in word_places)
        if not _are_in_order(frame.names):
            raise self._assignment_error(frame)
        return tuple(range(len(self._electrodes)))

    def _matching_indices(self, names: tuple[str, ...]) -> list[list[int]]:
        """Return, for each electrode, the indices of the names that belong to it.

        A name belongs to an electrode if all words of the electrode's name are among its words, as in `A_pC` for the
        electrode A. The part in which the given names differ also counts as a word, such as `A` in `chA` and `chB`.
        Capital and small letters are not distinguished. If each electrode has a name that equals the electrode's name,
        only these names count. For example, `temp_C` is then no name of the electrode C.

        Args:
            names: Names of channels, or words of a line of text.
        """
        if set(names).issuperset(self._electrodes):
            return [[names.index(electrode)] for electrode in self._electrodes]
        folded_names = [name.casefold() for name in names]
        distinctive_parts = _distinctive_parts(folded_names)
        words_of_names = [
            {*_words_of(name), distinctive_part}
            for name, distinctive_part in zip(folded_names, distinctive_parts, strict=True)
        ]
        matches = []
        for electrode in self._electrodes:
            electrode_words = _words_of(electrode.casefold())
            matches.append([index for index, words in enumerate(words_of_names) if words.issuperset(electrode_words)])
        return matches

    def _assignment_error(self, frame: Frame, advice: str = "") -> ChargeError:
        """Return the error for a frame whose channels cannot be assigned to the electrodes.

        Args:
            frame: The frame.
            advice: Part of a sentence about a channel, which begins with a semicolon; empty without advice.
        """
        number = "a frame" if frame.seq is None else f"frame {frame.seq}"
        example_keys = ", ".join(f'{toml_key(name)} = "..."' for name in self._electrodes)
        return ChargeError(
            f"{self._setup.reader} expects {len(self._electrodes)} charges {self._electrodes}, {number} has "
            f"{len(frame.values)} {channel_names(frame)}{advice}; choose the "
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
                f"{self._setup.device.where}: [channels] {electrode} = {dumps(cut(channel))}: no channel is called "
                "that; the frames have "
                f"{cut(', '.join(channel_names(frame)))}, or 1 to {len(frame.values)} in their order"
            )
        return index


def channel_names(frame: Frame) -> tuple[str, ...]:
    """Return the names of the channels of a frame. A channel without a name is named by its number, counted from 1."""
    names = frame.names or ("",) * len(frame.values)
    return tuple(name or str(number) for number, name in enumerate(names, 1))


def channel_index(name: str, frame: Frame) -> int | None:
    """Return the index of a channel in the values of a frame, or None if the frame has no such channel.

    Args:
        name: Name of the channel, or its number, such as `2` or `ch2`. The numbers begin with 1.
        frame: A frame of the board.
    """
    if name in frame.names:
        return frame.names.index(name)
    match = _CHANNEL_NUMBER.fullmatch(name)
    if match is None or int(match[1]) > len(frame.values):
        return None
    return int(match[1]) - 1  # indices begin with 0


def _words_of(text: str) -> list[str]:
    """Divide a text into words: before each unit, and at each character that is neither a letter nor a digit.

    A unit begins after a capital letter or a digit, as in `AnC`.
    """
    return [word for word in re.split(r"[\W_]+|(?<=[A-Z0-9])(?=(?:[fnpuµμ]C|[muµμ]V)\b)", text) if word]


def _distinctive_parts(names: list[str]) -> list[str]:
    """Return each name without the beginning and the end that all names have in common."""
    return _reversed_without_common_start(_reversed_without_common_start(names))


def _reversed_without_common_start(texts: list[str]) -> list[str]:
    """Remove the beginning that all texts have in common, and return the characters of each text in reversed order."""
    n_common = len(commonprefix(texts))  # noqa: RUF071  # the texts are no paths
    return [text[n_common:][::-1] for text in texts]


def _are_in_order(names: tuple[str, ...]) -> bool:
    """Return whether names are in the order of their numbers, as `ch1_v2`, `ch2_v2`; true if a name has no number."""
    numbers = [[int(digits[-9:]) for digits in re.findall("[0-9]+", name)] for name in names]
    return [] in numbers or numbers == sorted(numbers)


def stated_unit(name: str) -> str:
    """Return the unit at the end of the name of a channel, such as nC for `A_nC`; empty if the name states no unit.

    A final `C` is not a unit, because C may be the name of an electrode. The case of the unit does not matter.
    """
    *other_words, last_word = _words_of(name) or [""]
    units = {unit.casefold(): unit for unit in ("pC", *OTHER_CHARGE_UNITS) if unit != "C"}
    return units.get(last_word.casefold(), "") if other_words else ""


def _unit_advice(names: Sequence[str]) -> str:
    """Return advice for the first channel whose name states a unit other than pC; empty without such a channel.

    The advice is a part of an error message. `[gain]` is the section of the device file with the charge of each unit.
    """
    for name in names:
        unit = stated_unit(name)
        if unit not in ("", "pC"):  # the name states a unit, and not the right one
            return f"; channel {shown(name)} is in {unit}: convert it to pC, or state the charge of a unit in [gain]"
    return ""


class Gain(Stage):
    """Converts the values of the electrodes to charges in pC, with the offset, the sign and the gain of each channel.

    A frame with a value that cannot be a charge gets the flag `invalid`, and no charges. After invalid frames, the time
    step of the next valid frame begins at the last valid frame.

    Attributes:
        gain_pC: Charge per unit of the device, with sign, shape (n_electrode,), pC.
        offset: Values of the device without charge, shape (n_electrode,), in the unit of the device.
        max_magnitude: Largest magnitude of a valid value, in the unit of the device.
    """

    section = "gain"
    is_required = True
    rule_class = GainRule

    def __init__(self, setup: Setup) -> None:
        """Prepare the conversion of the values of a board to charges. Without settings, the values are charges in pC.

        Raises:
            DeviceError: If the device file assigns a channel, a gain or an offset to something that is no electrode.
        """
        self._channels = Channels(setup)  # which channel belongs to which electrode
        self._layout: tuple[tuple[str, ...], int] | None = None  # names and number of the values of the previous frame
        # Function that selects from the values of such a frame those of the electrodes; the first frame replaces it.
        self._select: itemgetter[Any] = itemgetter(0)
        rule = setup.device.rule(GainRule) or GainRule(pC_per_unit=1.0)
        self.gain_pC = setup.for_each_electrode("gain.pC_per_unit", rule.pC_per_unit)
        self.offset = setup.for_each_electrode("gain.offset", rule.offset)
        # A valid charge is at most `LARGEST` pC. Without electrodes, there is no gain, and a tiny number avoids an
        # error. The limit is then so large that it has no effect.
        largest_gain_pC = float(np.abs(self.gain_pC).max(initial=np.finfo(float).tiny))
        self.max_magnitude = LARGEST / largest_gain_pC
        self._invalid_s = 0.0  # duration of the invalid frames since the last valid frame
        self._invalid_intervals = 0  # number of sampling intervals in this time

    def step(self, frame: Frame) -> None:
        """Convert the values of a frame to charges, and mark the frame as invalid if a value cannot be a charge.

        An invalid frame gets no charges. Its time step and its sampling intervals are added to those of the next valid
        frame.

        Raises:
            ChargeError: If the frame has no value for an electrode.
        """
        # The channels of the electrodes are searched only if the names or the number of the values have changed.
        layout = (frame.names, len(frame.values))
        if layout != self._layout:
            self._select = itemgetter(*self._channels.channel_indices(frame))
            self._layout = layout
        # With a single index, `itemgetter` returns a number, which `reshape` converts to an array with one element.
        # `sent` has one value for each electrode, in the unit of the board.
        frame.sent = np.array(self._select(frame.values), dtype=float).reshape(-1)
        with np.errstate(over="ignore"):  # a value may be so large that its conversion overflows
            frame.raw_pC = (frame.sent - self.offset) * self.gain_pC
        magnitude = math.hypot(*frame.sent.tolist())  # at least the largest absolute value; NaN if a value is NaN
        if not magnitude <= self.max_magnitude:  # the condition is negated, so that it is true for NaN
            self._invalid_s += frame.dt_s
            self._invalid_intervals += frame.intervals
            frame.is_valid = False
            frame.flags.append(INVALID)
            return
        frame.dt_s += self._invalid_s
        frame.intervals += self._invalid_intervals
        self._invalid_s = 0.0
        self._invalid_intervals = 0
        frame.charge_pC = frame.raw_pC

    @classmethod
    def c_settings(cls, setup: Setup) -> dict[str, Any]:
        """Return the offset and the gain of each channel, and the largest valid value, by name."""
        gain = cls(setup)
        return {"zero": gain.offset, "pC": gain.gain_pC, "largest": gain.max_magnitude}


class SaturationRule(Rule, frozen=True, kw_only=True):
    """Section `[saturation]` of a device file.

    Attributes:
        limit_pC: Largest charge that the converter can represent, pC.
    """

    limit_pC: Setting


class Saturation(Stage):
    """Adds the flag `saturated` to the frames of a press, from the first frame in which an amplifier is at its limit.

    An amplifier is at its limit if the device reports this, or if the magnitude of a charge reaches the limit of the
    converter. All later frames of the press keep the flag.
    """

    section = "saturation"
    is_required = True
    rule_class = SaturationRule

    def __init__(self, setup: Setup) -> None:
        """Begin without a press."""
        rule = setup.device.rule(SaturationRule)
        self._limit_pC = math.inf if rule is None else rule.limit_pC
        self._is_saturated = False

    def step(self, frame: Frame) -> None:
        """Add the flag `saturated` to a frame if an amplifier is at its limit, or was there earlier in the press.

        An invalid frame is not changed.
        """
        if not frame.is_valid:
            return
        largest_pC = max(map(abs, frame.raw_pC.tolist()))
        is_at_limit = bool(frame.bits & SATURATED_BIT) or largest_pC >= self._limit_pC
        self._is_saturated = is_at_limit or (self._is_saturated and frame.is_contact)
        if self._is_saturated:
            frame.flags.append(SATURATED)

    def reset(self) -> None:
        """Discard the press."""
        self._is_saturated = False
