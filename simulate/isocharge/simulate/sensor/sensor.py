"""What a sensor is: film, piezoelectric coefficients, electrodes, readout, calibration. mm, N, MPa and pC throughout.

Frame: origin at the film's centre, x along the drawn direction (1), y transverse (2), z the way the probe pushes.
"""

from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import SensorError, cut, shown
from isocharge.simulate.numerics.polygon import overlap
from isocharge.simulate.sensor.electrode import Calibration, Electrode, check_electrode
from isocharge.simulate.sensor.film import Film, Piezo, Surface

Readout = Literal["area", "edge"]

LONGEST_NAME = 100
"""Longest name of an electrode, characters."""

MOST_ELECTRODES = 64
"""Largest number of electrodes on a film; each is checked against all others."""


@dataclass(frozen=True)
class Sensor:
    """A film with electrodes; see `isocharge.simulate.sensor.sensor_file` for its file."""

    name: str
    film: Film
    piezo: Piezo
    electrodes: tuple[Electrode, ...]
    readout: Readout = "area"
    surface: Surface = "middle"
    calibration: Calibration = field(default_factory=Calibration)

    def __post_init__(self) -> None:
        for value, options in ((self.readout, get_args(Readout)), (self.surface, get_args(Surface))):
            if value not in options:
                raise SensorError(f"expected one of {options}, got {value!r}")
        names = self.electrode_names
        if len(names) > MOST_ELECTRODES:
            raise SensorError(f"electrodes: expected at most {MOST_ELECTRODES}, got {len(names)}")
        if len(set(names)) < len(names) or not all(names) or "side_mm" in names:
            raise SensorError(f"electrodes: expected different names, none empty or 'side_mm', got {cut(str(names))}")
        if max(map(len, names), default=0) > LONGEST_NAME:
            raise SensorError(f"electrodes: expected names of at most {LONGEST_NAME} characters, got {cut(str(names))}")
        if not all(np.isfinite(gain) and gain > 0.0 for gain in self.calibration.gain.values()):
            raise SensorError(f"calibration gain: expected positive numbers, got {shown(self.calibration.gain)}")
        if not self.electrodes:
            raise SensorError("electrodes: expected at least one, got none")
        for electrode in self.electrodes:
            check_electrode(electrode, self.film, self.calibration)
            if self.readout == "edge" and not electrode.square:
                raise SensorError(f"readout 'edge' needs square electrodes, but {electrode.name!r} is a polygon")
        for i, first in enumerate(self.electrodes):
            for second in self.electrodes[i + 1 :]:
                if overlap(np.array(first.corners), np.array(second.corners)):
                    raise SensorError(f"electrodes {first.name!r} and {second.name!r} overlap; move one of them")
        unknown = set(self.calibration.gain) - set(self.electrode_names)
        if unknown:
            raise SensorError(
                f"calibration gain: no electrode named {shown(sorted(unknown))}, have {cut(str(self.electrode_names))}"
            )

    @property
    def electrode_names(self) -> tuple[str, ...]:
        """Names in the order of the charges."""
        return tuple(electrode.name for electrode in self.electrodes)

    @property
    def gains(self) -> Array:
        """Calibrated gain of each electrode, shape (n_electrode,)."""
        return np.array([self.calibration.gain.get(name, 1.0) for name in self.electrode_names])


def electrode_index(sensor: Sensor, name: str) -> int:
    """Place of an electrode in the order of the charges.

    Raises:
        SensorError: If the sensor has no electrode of that name.
    """
    if name not in sensor.electrode_names:
        raise SensorError(f"no electrode {name!r} on {sensor.name}: it has {', '.join(sensor.electrode_names)}")
    return sensor.electrode_names.index(name)
