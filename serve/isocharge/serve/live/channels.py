"""Which channel of a frame is which electrode."""

from collections.abc import Mapping
from operator import itemgetter

import numpy as np

from isocharge.arrays import Array
from isocharge.errors import ChargeError
from isocharge.serve.frames.frame import Frame


class ChannelPicker:
    """Picks the value of each electrode out of frames; the order is looked up again only when a frame's names change.

    The device file's `[channels]` decides. Without it, channels are matched by the names of the electrodes (`A`, `A_pC`
    or `charge.A`); without such names by their order, if their number is that of the electrodes.
    """

    def __init__(self, electrodes: tuple[str, ...], channels: Mapping[str, str], reader: str) -> None:
        """Set up the look-up.

        Args:
            electrodes: Names of the electrodes, in the order of the charges.
            channels: Electrode to the channel's name; empty where nothing is known.
            reader: Who expects these electrodes, for messages: "model three/1".
        """
        self._electrodes, self._channels, self._reader = electrodes, channels, reader
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
        names = [self._channels.get(name, name) for name in self._electrodes]
        if self._channels and set(names) <= set(frame.names):
            return tuple(frame.names.index(name) for name in names)
        positions = {_electrode(name): position for position, name in enumerate(frame.names)}
        if not self._channels and set(self._electrodes) <= set(positions):
            return tuple(positions[name] for name in self._electrodes)
        if not self._channels and len(frame.values) == len(self._electrodes):
            return tuple(range(len(frame.values)))
        raise ChargeError(
            f"{self._reader} expects {len(self._electrodes)} charges {self._electrodes}, frame {frame.seq} has "
            f"{len(frame.values)} {frame.names}; choose the model of this sensor, or say in the device file which is "
            "which: [channels] " + ", ".join(f'{name} = "..."' for name in self._electrodes)
        )


def _electrode(name: str) -> str:
    """`A` of `A`, `A_pC`, `charge.A` and `charge_raw_pC.A`."""
    return name.rpartition(".")[2].removesuffix("_pC")
