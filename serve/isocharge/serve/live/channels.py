"""Which channel of a frame is which electrode."""

from collections.abc import Mapping
from json import dumps
from operator import itemgetter

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import ChargeError, cut
from isocharge.serve.frames.frame import Frame


class ChannelPicker:
    """Picks the value of each electrode out of frames; the order is looked up again only when a frame's names change.

    The device file's `[channels]` decides, by the names or numbers of `channel_names`. Without it, channels are matched
    by the names of the electrodes (`A`, `A_pC` or `charge.A`); without such names by their order, if their number is
    that of the electrodes.
    """

    def __init__(
        self, electrodes: tuple[str, ...], channels: Mapping[str, str], reader: str, where: str = "device file"
    ) -> None:
        """Set up the look-up.

        Args:
            electrodes: Names of the electrodes, in the order of the charges.
            channels: Electrode to the channel's name; empty where nothing is known.
            reader: Who expects these electrodes, for messages: "model three/1".
            where: The device file, for messages.
        """
        self._electrodes, self._channels, self._reader, self._where = electrodes, channels, reader, where
        self._names: tuple[str, ...] | None = None
        self._width = -1
        self._order: tuple[int, ...] = ()

    def pick(self, frame: Frame) -> Array:
        """Values in the order of the electrodes, shape (electrodes,), in the device's unit.

        Raises:
            ChargeError: If a frame has no value for an electrode.
        """
        if frame.names != self._names or len(frame.values) != self._width:
            self._order = self._look_up(frame)
            self._names, self._width = frame.names, len(frame.values)
        return np.array(itemgetter(*self._order)(frame.values), dtype=float).reshape(-1)

    def _look_up(self, frame: Frame) -> tuple[int, ...]:
        if self._channels:
            return tuple(self._position(electrode, frame) for electrode in self._electrodes)
        positions = {electrode_of(name): position for position, name in enumerate(frame.names)}
        if set(self._electrodes) <= set(positions):
            return tuple(positions[name] for name in self._electrodes)
        if len(frame.values) == len(self._electrodes):
            return tuple(range(len(frame.values)))
        raise ChargeError(
            f"{self._reader} expects {len(self._electrodes)} charges {self._electrodes}, frame {frame.seq} has "
            f"{len(frame.values)} {channel_names(frame)}; choose the model of this sensor, or say in the device file "
            "which is which: [channels] " + ", ".join(f'{name} = "..."' for name in self._electrodes)
        )

    def _position(self, electrode: str, frame: Frame) -> int:
        """The position of an electrode's channel among the values of a frame."""
        name = self._channels.get(electrode, electrode)
        position = position_of(name, frame)
        if position is None:
            raise ChargeError(
                f"{self._where}: [channels] {electrode} = {dumps(cut(name))}: no channel is called that; the frames "
                f"have {cut(', '.join(channel_names(frame)))}, or 1 to {len(frame.values)} in their order"
            )
        return position


def channel_names(frame: Frame) -> tuple[str, ...]:
    """Names of the channels as `[channels]` takes them; their numbers from 1 on where the board gives none."""
    return frame.names or tuple(map(str, range(1, len(frame.values) + 1)))


def position_of(name: str, frame: Frame) -> int | None:
    """The position of a channel by its name, or by its number from 1 as `2` or `ch2`; None if there is none."""
    if name in frame.names:
        return frame.names.index(name)
    digits = name.removeprefix("ch")
    number = int(digits) if digits.isascii() and digits.isdigit() and len(digits) < 5 else 0
    return number - 1 if 1 <= number <= len(frame.values) else None


def electrode_of(name: str) -> str:
    """`A` of `A`, `A_pC`, `charge.A` and `charge_raw_pC.A`."""
    return name.rpartition(".")[2].removesuffix("_pC")
