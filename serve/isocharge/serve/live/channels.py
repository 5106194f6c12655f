"""Which channel of a frame is which electrode."""

from collections.abc import Mapping
from operator import itemgetter

import numpy as np

from isocharge.arrays import Array
from isocharge.errors import ChargeError
from isocharge.serve.frames.frame import Frame


class ChannelPicker:
    """Picks an electrode's value out of each frame; how is found out once for each set of names.

    The device file's `[channels]` decides; without, channels named as the electrodes (`A`, `A_pC`, or `charge.A`), and
    without names, or with others, the order, if there are as many as electrodes.
    """

    def __init__(self, electrodes: tuple[str, ...], channels: Mapping[str, str], model: str) -> None:
        """Take notice.

        Args:
            electrodes: In the order of the model.
            channels: Electrode to the channel's name; empty for nothing known.
            model: For messages.
        """
        self._electrodes, self._channels, self._model = electrodes, channels, model
        self._names: tuple[str, ...] | None = None
        self._width = -1
        self._order: tuple[int, ...] = ()

    def pick(self, frame: Frame) -> Array:
        """Values in the order of the electrodes, shape (electrodes,), in the device's unit.

        Raises:
            ChargeError: If an electrode's value is not there.
        """
        if frame.names != self._names or len(frame.values) != self._width:
            self._order = self._find(frame)
            self._names, self._width = frame.names, len(frame.values)
        return np.array(itemgetter(*self._order)(frame.values), dtype=float).reshape(-1)

    def _find(self, frame: Frame) -> tuple[int, ...]:
        wanted = [self._channels.get(name, name) for name in self._electrodes]
        if self._channels and set(wanted) <= set(frame.names):
            return tuple(frame.names.index(name) for name in wanted)
        known = {_bare(name): at for at, name in enumerate(frame.names)}
        if not self._channels and set(self._electrodes) <= set(known):
            return tuple(known[name] for name in self._electrodes)
        if not self._channels and len(frame.values) == len(self._electrodes):
            return tuple(range(len(frame.values)))
        raise ChargeError(
            f"model {self._model} expects {len(self._electrodes)} charges {self._electrodes}, frame {frame.seq} has "
            f"{len(frame.values)} {frame.names}; choose the model of this sensor, or say in the device file which is "
            "which: [channels] " + ", ".join(f'{name} = "..."' for name in self._electrodes)
        )


def _bare(name: str) -> str:
    """`A` of `A`, `A_pC`, `charge.A` and `charge_raw_pC.A`."""
    return name.rpartition(".")[2].removesuffix("_pC")
