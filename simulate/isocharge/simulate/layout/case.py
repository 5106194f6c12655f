"""Design case of a layout: film, presses, goal of the minimisation, nuisances, and distance rules."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np
import scipy  # loads each of its subpackages on first use

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

MIN_ELECTRODES = 3
"""Smallest number of electrodes of a design."""

MAX_ELECTRODES = 8
"""Largest number of electrodes of a design."""

DEFAULT_SIDE = 3.0
"""Side of new squares if the sensor has no square electrodes, mm."""

NAMES = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
"""Names of new electrodes. The first names that the kept electrodes do not use are assigned."""

MAX_SEARCH_PRESSES = 300
"""Largest number of presses in the exchange. The refinement uses a fine grid."""

FINE_GRID_STEPS = 50
"""Number of steps of the fine grid from the centre outwards."""

WEIGHT_MAP_HEADER = "x_mm,y_mm,weight"
"""Header of the CSV file of a weight map."""


@dataclass(frozen=True)
class Nuisances:
    """Prior standard deviations of parameters that are not known exactly when a press is measured.

    Attributes:
        probe_radius: Standard deviation of the probe radius, mm. It includes an unknown distribution of the pressure.
            Outside the footprint, only the second moment of the pressure matters. Distributions between a uniform
            pressure and that of a rigid flat punch differ like probes whose radii differ by 5 %.
        pretension: Standard deviation of the pretension after a calibration, MPa.
        gain: Standard deviation of the relative gain of each electrode, dimensionless.
    """

    probe_radius: float = 0.3
    pretension: float = 0.1
    gain: float = 2e-3

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not (np.isfinite(value) and value >= 0.0):
                raise InputError(f"nuisance {name}: expected a number from 0, got {value}")


NO_NUISANCES = Nuisances(probe_radius=0.0, pretension=0.0, gain=0.0)
"""Nuisances of a press for which everything except the contact is known exactly."""


@dataclass(frozen=True)
class WeightMap:
    """Weights of the position error as a function of the position.

    Attributes:
        name: Name of the file.
        table: Rows of x, y (mm) and weight (dimensionless), shape (n, 3).
    """

    name: str
    table: Array

    def weigh(self, presses: Array) -> Array:
        """Compute the weights of presses by linear interpolation between the rows of the table.

        A press outside the area that the table covers has the weight of the nearest row.

        Args:
            presses: Positions (x, y), shape (n, 2), mm.

        Returns:
            Weights, shape (n,), dimensionless.
        """
        positions = self.table[:, :2]
        values = self.table[:, 2]
        nearest_weights = scipy.interpolate.NearestNDInterpolator(positions, values)(presses)
        spans_plane = np.linalg.matrix_rank(positions - positions[0]) == 2
        if not spans_plane:  # linear interpolation needs a triangulation of the positions
            return np.asarray(nearest_weights)
        linear_weights = scipy.interpolate.LinearNDInterpolator(positions, values)(presses)  # NaN outside
        return np.asarray(np.where(np.isnan(linear_weights), nearest_weights, linear_weights))


NamedGoal = Literal["worst", "rms"]

Goal = NamedGoal | WeightMap
"""Quantity that a design minimises: the largest error, the root mean square of the errors, or their weighted root mean
square."""


def read_goal(text: str) -> Goal:
    """Convert the value of the option `--goal` into a goal.

    Args:
        text: "worst", "rms", or the path of a CSV file with the header `WEIGHT_MAP_HEADER`.

    Returns:
        The name of the goal, or the weights in the file.

    Raises:
        InputError: If the text is not a goal, or the file cannot be read.
    """
    if text in get_args(NamedGoal):
        return cast(NamedGoal, text)
    try:
        # An empty file also results in a ValueError, because it has no header line.
        header, *lines = read_whole(Path(text)).decode("utf-8-sig").splitlines()
        if header.replace(" ", "") != WEIGHT_MAP_HEADER:
            raise ValueError(f"the columns are {header!r}")
        table = np.loadtxt(lines, delimiter=",", ndmin=2)
        has_three_columns = len(table) > 0 and table.shape[1] == 3
        if not has_three_columns or not np.isfinite(table).all() or table[:, 2].min() < 0.0:
            raise ValueError("expected rows of three finite numbers, the weight from 0")
    except (OSError, ValueError) as error:
        raise InputError(
            f"goal {text!r}: expected 'worst', 'rms' or a CSV file {WEIGHT_MAP_HEADER}: {error}"
        ) from error
    return WeightMap(Path(text).name, table)


DEFAULT_PROBE = Circle(1.0)
"""Default probe of a design case, mm."""


@dataclass(frozen=True)
class DesignCase:
    """Requirements of a design.

    Attributes:
        sensor: Sensor with the film, its coefficients and readout, and the electrodes that may be kept.
        electrodes: Number of electrodes, including those that are kept.
        radius: Largest distance of a press from the centre of the film, mm.
        goal: Quantity that is minimised.
        keep: Names of the electrodes of the sensor that keep their positions.
        probe: Circular probe.
        force: Force of the presses, N.
        noise: Noise of the readings.
        nuisances: Standard deviations of the parameters that are not known exactly.
        side: Side of the new squares, mm; None for the side of the squares of the sensor.
        gap: Smallest distance between two electrodes along x or along y, mm.
        rim: Smallest distance of an electrode from the rim of the film, mm.
        seed: Seed of the random layouts from which the search starts.

    Raises:
        InputError: If a number is out of range, or all electrodes are kept.
        SceneError: If the film cannot be pressed as required.
        SensorError: If a kept electrode does not exist.
    """

    sensor: Sensor
    electrodes: int
    radius: float
    goal: Goal = "worst"
    keep: tuple[str, ...] = ()
    probe: Circle = DEFAULT_PROBE
    force: float = 1.0
    noise: NoiseModel = NOISE_LEVELS["reference"]
    nuisances: Nuisances = Nuisances()
    side: float | None = None
    gap: float = 0.5
    rim: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        """Check that the electrodes can be placed.

        Raises:
            InputError: If a value is not allowed, or the kept electrodes are not part of the sensor.
        """
        if not MIN_ELECTRODES <= self.electrodes <= MAX_ELECTRODES:
            raise InputError(
                f"electrodes: expected {MIN_ELECTRODES} to {MAX_ELECTRODES}, got {self.electrodes}; x, y and the force "
                "of a press are three unknowns"
            )
        check_family(self.sensor.coated_film, self.probe, Domain(self.radius, (self.force, self.force)))
        _check_length("gap", self.gap, 0.0)
        _check_length("rim", self.rim, 0.0)
        _check_length("side", self.square_side, 1e-2)
        if not self.noise.white > 0.0:
            raise InputError(
                f"noise {self.noise.name!r}: expected white noise above 0, because errors have no lower limit "
                "without noise"
            )
        if not self.weights(self.search_presses).max() > 0.0:
            raise InputError(f"goal {self.goal_name}: no position within the radius has a weight above 0")
        self._check_kept_electrodes()

    def _check_kept_electrodes(self) -> None:
        """Check that the kept electrodes exist, leave room for a new one, and fit to the new squares.

        Kept electrodes must be at their nominal positions. With the readout 'edge', the new squares must have the same
        side as the kept squares.

        Raises:
            InputError: If the kept electrodes do not satisfy these rules.
        """
        if len(set(self.keep)) < len(self.keep):
            raise InputError(f"keep: expected different names, got {', '.join(self.keep)}")
        if len(self.keep) >= self.electrodes:
            raise InputError(
                f"keep: {len(self.keep)} of {self.electrodes} electrodes are kept, so there is nothing to place"
            )
        if self.kept_electrodes and self.sensor.calibration != Calibration():
            raise InputError(f"keep: {self.sensor.name} is calibrated; start from its layout without [calibration]")

        if self.sensor.readout != "edge":
            return
        for electrode in self.kept_electrodes:
            lower_left, lower_right, *_ = electrode.corners
            side = lower_right[0] - lower_left[0]
            if electrode.square and abs(side - self.square_side) > 1e-6:
                raise InputError(
                    f"side: with the readout 'edge' all squares have one side, got {self.square_side:g} mm"
                )

    @property
    def square_side(self) -> float:
        """Side of the new squares, mm.

        If the side is not given, it is the side of the first square of the sensor, or `DEFAULT_SIDE` if the sensor has
        no square.
        """
        if self.side is not None:
            return float(self.side)
        squares = [electrode for electrode in self.sensor.electrodes if electrode.square]
        if not squares:
            return DEFAULT_SIDE
        lower_left, lower_right, *_ = squares[0].corners
        return float(lower_right[0] - lower_left[0])

    @property
    def kept_electrodes(self) -> tuple[Electrode, ...]:
        """Electrodes of the sensor that keep their positions."""
        return tuple(self.sensor.electrodes[electrode_index(self.sensor, name)] for name in self.keep)

    @property
    def new_count(self) -> int:
        """Number of electrodes to place."""
        return self.electrodes - len(self.keep)

    @property
    def goal_name(self) -> str:
        """Name of the goal: "worst", "rms" or the file name of a weight map."""
        return self.goal.name if isinstance(self.goal, WeightMap) else self.goal

    @property
    def search_presses(self) -> Array:
        """Positions of the presses of the exchange, shape (n, 2), mm."""
        z = self.radius * lattice(MAX_SEARCH_PRESSES)
        return np.stack([z.real, z.imag], axis=1)

    @property
    def fine_grid(self) -> Array:
        """Positions of presses on a fine grid, shape (n, 2), mm.

        A coarse grid misses the largest error, which occurs mostly beside an electrode.
        """
        return square_grid(self.radius, self.radius / FINE_GRID_STEPS)

    def weights(self, presses: Array) -> Array:
        """Return the weights of presses in the minimised quantity, shape (n,), for positions of shape (n, 2), mm."""
        return self.goal.weigh(presses) if isinstance(self.goal, WeightMap) else np.ones(len(presses))

    def clearance(self, positions: Array) -> Array:
        """Compute by how much single squares satisfy the distance rules.

        A square must have the distance `rim` from the rim of the film, and the distance `gap` from the bounding boxes
        of the kept electrodes.

        Args:
            positions: Centres of the squares, shape (n, 2), mm.

        Returns:
            Smallest difference between an actual and a required distance, shape (n,), mm; negative if a rule is
            violated.
        """
        # The corner that is farthest from the centre of the film determines the distance from the rim.
        half_side = 0.5 * self.square_side
        corner_x, corner_y = (np.abs(positions) + half_side).T
        corner_distance = np.hypot(corner_x, corner_y)
        clearances = [self.sensor.film.radius - self.rim - corner_distance]

        for electrode in self.kept_electrodes:
            lower_left_corners, upper_right_corners = electrode.boxes
            for low, high in zip(lower_left_corners, upper_right_corners, strict=True):
                # Gaps along x and y, shape (n, 2). A gap is negative if square and box overlap along this axis.
                # One of the gaps must be large enough, so the larger gap counts.
                axis_gaps = np.maximum(low - positions, positions - high) - half_side
                clearances.append(axis_gaps.max(axis=1) - self.gap)
        return np.asarray(np.min(clearances, axis=0))

    def pair_clearance(self, positions: Array, others: Array) -> Array:
        """Compute by how much the distances between pairs of new squares exceed the required distance.

        Args:
            positions: Centres of the first squares, shape (n, 2), mm.
            others: Centres of the second squares, shape (m, 2), mm.

        Returns:
            Excess distance, shape (n, m), mm; negative if the rule is violated.
        """
        # The gap between two squares along an axis is the distance of their centres along this axis minus one side.
        # The rule must be satisfied along x or along y, so the larger distance counts.
        distance = np.abs(positions[:, None] - others).max(axis=2)
        return np.asarray(distance - self.square_side - self.gap)

    def all_clearances(self, positions: Array) -> Array:
        """Compute the excess distances of all rules for a layout, shape (n + n (n - 1) / 2,), mm.

        Args:
            positions: Centres of the new squares, shape (n, 2), mm.
        """
        pairs = np.triu_indices(len(positions), 1)
        return np.concatenate([self.clearance(positions), self.pair_clearance(positions, positions)[pairs]])

    def layout(self, positions: Array) -> Sensor:
        """Create the sensor with new squares and the kept electrodes. The new squares are named anticlockwise.

        Args:
            positions: Centres of the new squares, shape (n, 2), mm.
        """
        angle = np.arctan2(positions[:, 1], positions[:, 0]) % (2.0 * np.pi)
        anticlockwise = positions[np.argsort(angle)]
        unused_names = [name for name in NAMES if name not in self.keep]
        squares = [
            Electrode.of_square(name, (x, y), self.square_side)
            for name, (x, y) in zip(unused_names, anticlockwise.tolist(), strict=False)  # some names remain unused
        ]
        electrodes = tuple(sorted((*self.kept_electrodes, *squares), key=lambda electrode: electrode.name))
        name = f"{self.sensor.name}-{self.electrodes}-over-{self.radius:g}mm"
        return replace(self.sensor, name=name, electrodes=electrodes, calibration=Calibration())

    def to_dict(self) -> dict[str, Any]:
        """Return all parameters of the case except the sensor and the weights, as values for JSON."""
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


def _check_length(name: str, value: float, minimum: float) -> None:
    """Raise an InputError if a length (mm) is not finite, or if it is smaller than the minimum (mm)."""
    if not (np.isfinite(value) and value >= minimum):
        raise InputError(f"{name}: expected a length from {minimum:g} mm, got {value} mm")
