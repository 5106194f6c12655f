"""What a layout is designed for: film, presses, what is made small, what nobody knows exactly, and rules."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np
import scipy  # loads a part when it is used

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError
from isocharge.common.files import read_whole
from isocharge.simulate.forward.charge_map import Domain
from isocharge.simulate.forward.family import check_family
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.measuring_chain.noise_file import NOISE_LEVELS
from isocharge.simulate.numerics.disk import lattice, square_grid
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.sensor.sensor import Calibration, Electrode, Sensor, electrode_index

FEWEST, MOST = 3, 8
"""Numbers of electrodes of a design."""

SIDE = 3.0
"""Side of new squares where the sensor has none, mm."""

NAMES = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
"""Names of new electrodes: the first letters that are free."""

PRESSES = 300
"""Presses of the search, at most; the last steps use a fine grid."""

CELLS = 50
"""Steps of the fine grid from the centre outwards."""

HEADER = "x_mm,y_mm,weight"
"""Columns of a map of what matters."""


@dataclass(frozen=True)
class Nuisances:
    """One standard deviation of each thing that nobody knows exactly when a press is read.

    Attributes:
        probe_radius: mm. A pressure between uniform and that of a rigid flat punch adds 0.05 times the radius to it:
            beyond the footprint only the second moment of the pressure matters.
        pretension: What a calibration leaves unknown, MPa.
        gain: Of every electrode by itself, dimensionless.
    """

    probe_radius: float = 0.3
    pretension: float = 0.1
    gain: float = 2e-3

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not (np.isfinite(value) and value >= 0.0):
                raise InputError(f"nuisance {name}: expected a number from 0, got {value}")


KNOWN = Nuisances(0.0, 0.0, 0.0)
"""Everything but the press is known."""


@dataclass(frozen=True)
class WeightMap:
    """How much the error at a place matters.

    Attributes:
        name: Of its file.
        table: Rows x, y (mm) and weight, shape (n, 3).
    """

    name: str
    table: Array

    def weigh(self, presses: Array) -> Array:
        """Weights of presses, shape (n, 2), mm: linear between the places, beyond them that of the nearest."""
        places, values = self.table[:, :2], self.table[:, 2]
        weights = scipy.interpolate.NearestNDInterpolator(places, values)(presses)
        if np.linalg.matrix_rank(places - places[0]) == 2:
            between = scipy.interpolate.LinearNDInterpolator(places, values)(presses)
            weights = np.where(np.isnan(between), weights, between)
        return np.asarray(weights)


Plain = Literal["worst", "rms"]

Goal = Plain | WeightMap
"""What is made small: the largest error, its root mean square, or that with weights."""


def read_goal(text: str) -> Goal:
    """A goal from `--goal`: "worst", "rms", or a map of what matters, a CSV file with the columns of `HEADER`.

    Raises:
        InputError: If it is no goal, or the map cannot be read.
    """
    if text in get_args(Plain):
        return cast(Plain, text)
    try:
        header, *lines = read_whole(Path(text)).decode("utf-8-sig").splitlines()
        if header.replace(" ", "") != HEADER:
            raise ValueError(f"the columns are {header!r}")
        table = np.loadtxt(lines, delimiter=",", ndmin=2)
        if table.shape[1:] != (3,) or not len(table) or not np.isfinite(table).all() or table[:, 2].min() < 0.0:
            raise ValueError("expected rows of three finite numbers, the weight from 0")
    except (OSError, ValueError) as error:
        raise InputError(f"goal {text!r}: expected 'worst', 'rms' or a CSV file {HEADER}: {error}") from error
    return WeightMap(Path(text).name, table)


PROBE = Circle(1.0)
"""The usual footprint."""


@dataclass(frozen=True)
class DesignCase:
    """What is asked of a design; lengths in mm, the force in N.

    Attributes:
        sensor: Film, coefficients and readout, and the electrodes that may stay.
        electrodes: Number of electrodes, those that stay included.
        radius: Largest distance of a press from the film's centre.
        goal: What is made small.
        keep: Names of the sensor's electrodes that stay where they are.
        probe: Footprint, round.
        force: Of the presses.
        noise: Of the readings.
        nuisances: What nobody knows exactly.
        side: Of the new squares; None for that of the sensor's squares.
        gap: Smallest distance between two electrodes, along x or along y.
        rim: Smallest distance of an electrode from the film's rim.
        seed: Of the random layouts that the search starts from.

    Raises:
        InputError: If a number is impossible or nothing is left to place.
        SceneError: If some presses cannot exist.
        SensorError: If an electrode that stays does not exist.
    """

    sensor: Sensor
    electrodes: int
    radius: float
    goal: Goal = "worst"
    keep: tuple[str, ...] = ()
    probe: Circle = PROBE
    force: float = 1.0
    noise: NoiseModel = NOISE_LEVELS["reference"]
    nuisances: Nuisances = Nuisances()
    side: float | None = None
    gap: float = 0.5
    rim: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not FEWEST <= self.electrodes <= MOST:
            raise InputError(
                f"electrodes: expected {FEWEST} to {MOST}, got {self.electrodes}; x, y and the force of a press are "
                "three unknowns"
            )
        check_family(self.sensor.coated_film, self.probe, Domain(self.radius, (self.force, self.force)))
        for name, value, least in (("gap", self.gap, 0.0), ("rim", self.rim, 0.0), ("side", self.square_side, 1e-2)):
            if not (np.isfinite(value) and value >= least):
                raise InputError(f"{name}: expected a length from {least:g} mm, got {value} mm")
        if not self.noise.white > 0.0:
            raise InputError(
                f"noise {self.noise.name!r}: expected white noise above 0: without it errors have no limit"
            )
        if not self.weights(self.presses).max() > 0.0:
            raise InputError(f"goal {self.goal_name}: no place within the radius has a weight above 0")
        self._check_stay()

    def _check_stay(self) -> None:
        if len(set(self.keep)) < len(self.keep):
            raise InputError(f"keep: expected different names, got {', '.join(self.keep)}")
        if len(self.keep) >= self.electrodes:
            raise InputError(f"keep: {len(self.keep)} of {self.electrodes} electrodes stay: there is nothing to place")
        if self.stay and self.sensor.calibration != Calibration():
            raise InputError(f"keep: {self.sensor.name} is calibrated; start from its layout without [calibration]")
        sides = {e.corners[1][0] - e.corners[0][0] for e in self.stay if e.square}
        if self.sensor.readout == "edge" and any(abs(side - self.square_side) > 1e-6 for side in sides):
            raise InputError(f"side: with the readout 'edge' all squares have one side, got {self.square_side:g} mm")

    @property
    def square_side(self) -> float:
        """Side of the new squares, mm."""
        given = (e.corners[1][0] - e.corners[0][0] for e in self.sensor.electrodes if e.square)
        return float(self.side if self.side is not None else next(given, SIDE))

    @property
    def stay(self) -> tuple[Electrode, ...]:
        """The electrodes that stay."""
        return tuple(self.sensor.electrodes[electrode_index(self.sensor, name)] for name in self.keep)

    @property
    def new(self) -> int:
        """Number of electrodes that are placed."""
        return self.electrodes - len(self.keep)

    @property
    def goal_name(self) -> str:
        """The goal for people: "worst", "rms" or the name of a map's file."""
        return self.goal.name if isinstance(self.goal, WeightMap) else self.goal

    @property
    def presses(self) -> Array:
        """Places of the presses of the search, shape (n, 2), mm."""
        at = self.radius * lattice(PRESSES)
        return np.stack([at.real, at.imag], axis=1)

    @property
    def grid(self) -> Array:
        """A fine grid of presses, shape (n, 2), mm: the worst lies beside electrodes, and a coarse one hides it."""
        return square_grid(self.radius, self.radius / CELLS)

    def weights(self, presses: Array) -> Array:
        """What presses, shape (n, 2), count in the goal, shape (n,)."""
        return self.goal.weigh(presses) if isinstance(self.goal, WeightMap) else np.ones(len(presses))

    def room(self, places: Array) -> Array:
        """Distance to spare of single squares from the rim and the electrodes that stay, (n, 2) to (n,), mm."""
        half = 0.5 * self.square_side
        to_rim = self.sensor.film.radius - self.rim - np.hypot(*(np.abs(places) + half).T)
        boxes = (box for electrode in self.stay for box in zip(*electrode.boxes, strict=True))
        to_boxes = [(np.maximum(low - places, places - high) - half).max(axis=1) - self.gap for low, high in boxes]
        return np.asarray(np.min([to_rim, *to_boxes], axis=0))

    def apart(self, places: Array, others: Array) -> Array:
        """Distance to spare between squares at `places` (n, 2) and `others` (m, 2), shape (n, m), mm."""
        return np.asarray(np.abs(places[:, None] - others).max(axis=2) - self.square_side - self.gap)

    def spare(self, places: Array) -> Array:
        """All distances to spare of a layout, shape (n + n (n - 1) / 2,), mm: negative where a rule is broken."""
        pairs = self.apart(places, places)[np.triu_indices(len(places), 1)]
        return np.concatenate([self.room(places), pairs])

    def layout(self, places: Array) -> Sensor:
        """The sensor with new squares at places (n, 2), named anticlockwise, beside the electrodes that stay."""
        at = places[np.argsort(np.arctan2(places[:, 1], places[:, 0]) % (2.0 * np.pi))]
        free = [name for name in NAMES if name not in self.keep]
        squares = [
            Electrode.of_square(name, (x, y), self.square_side) for name, (x, y) in zip(free, at.tolist(), strict=False)
        ]
        electrodes = tuple(sorted((*self.stay, *squares), key=lambda electrode: electrode.name))
        name = f"{self.sensor.name}-{self.electrodes}-over-{self.radius:g}mm"
        return replace(self.sensor, name=name, electrodes=electrodes, calibration=Calibration())

    def to_dict(self) -> dict[str, Any]:
        """For JSON: everything that the design depends on, beside the sensor and the weights."""
        return {
            "electrodes": self.electrodes,
            "radius_mm": self.radius,
            "goal": self.goal_name,
            "keep": list(self.keep),
            "probe": self.probe.notation,
            "force_N": self.force,
            "noise": self.noise.to_dict(),
            "nuisances": {
                "probe_radius_mm": self.nuisances.probe_radius,
                "pretension_MPa": self.nuisances.pretension,
                "gain": self.nuisances.gain,
            },
            "side_mm": self.square_side,
            "gap_mm": self.gap,
            "rim_mm": self.rim,
            "seed": self.seed,
        }
