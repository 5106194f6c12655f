"""Design case: the requirements of an electrode layout, and the rules for the electrode positions."""

import math
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.contact_domain import Domain
from isocharge.common.errors import InputError
from isocharge.simulate.forward.family import check_family
from isocharge.simulate.identifiability.cramer_rao import cramer_rao
from isocharge.simulate.noise import NOISE_LEVELS, NoiseModel
from isocharge.simulate.numerics.disk import sunflower
from isocharge.simulate.sensor.film import check_range
from isocharge.simulate.sensor.footprint import Probe
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.sensor.sensor import MIN_EXTENT, Calibration, Electrode, Sensor, electrode_index

MIN_ELECTRODES = 3
"""Smallest number of electrodes of a design."""

MAX_ELECTRODES = 8
"""Largest number of electrodes of a design."""

DEFAULT_SIDE = 3.0
"""Side of new squares if the sensor has no square electrodes, mm."""

GAP = 0.5
"""Smallest allowed gap between two electrodes, mm. The rule applies to the larger of the gaps along x and along y."""

RIM_DISTANCE = 1.0
"""Smallest allowed distance of an electrode from the rim of the film, mm."""

NAMES = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
"""Names of new electrodes. New electrodes get the first letters that no kept electrode uses."""

SEARCH_PRESSES = 150
"""Number of presses for which the search evaluates random layouts."""

FINE_PRESSES = 8000
"""Number of presses for which a finished layout is evaluated."""


@dataclass(frozen=True)
class Nuisances:
    """Prior standard deviations of parameters that are not known exactly when a press is measured.

    Attributes:
        probe_radius: Standard deviation of the probe radius, mm. This value also accounts for the unknown distribution
            of the contact pressure. Outside the footprint, replacing a uniform pressure by the pressure under a rigid
            flat punch has the same effect as changing the probe radius by 5 %.
        pretension: Standard deviation of the pretension after a calibration, MPa.
        gain: Standard deviation of the relative gain of each electrode, dimensionless.
    """

    probe_radius: float = 0.3
    pretension: float = 0.1
    gain: float = 2e-3

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            check_range(f"nuisance {name}", value, (0.0, np.inf), "", InputError)


NO_NUISANCES = Nuisances(probe_radius=0.0, pretension=0.0, gain=0.0)
"""Standard deviations of zero. Only the position and the force of a press are then unknown."""


Goal = Literal["worst", "rms"]
"""Quantity that a design minimises: the largest position error, or the root mean square of the position errors."""

DEFAULT_PROBE = Circle(1.0)
"""Default probe of a design case, which has a radius of 1 mm."""


@dataclass(frozen=True)
class DesignCase:
    """Requirements of an electrode layout that is to be designed.

    Attributes:
        sensor: Sensor with the film, its piezoelectric coefficients and readout, and the electrodes that may be kept.
        electrodes: Number of electrodes of the new layout, including the kept electrodes.
        radius: Largest distance of a press from the centre of the film, mm.
        goal: Quantity that the design minimises.
        keep: Names of the electrodes of the sensor that keep their positions.
        probe: Circular probe that presses the film.
        force: Force of the presses, N.
        noise: Noise of the readings.
        nuisances: Standard deviations of the parameters that are not known exactly.
        side: Side of the new squares, mm; None for the same side as the existing squares of the sensor.
        seed: Seed of the random layouts from which the search starts.

    Raises:
        InputError: If a number is out of range, or no electrode is left to be placed.
        SceneError: If a press within the radius cannot exist, or if there is no white noise.
        SensorError: If a kept electrode does not exist.
    """

    sensor: Sensor
    electrodes: int
    radius: float
    goal: Goal = "worst"
    keep: tuple[str, ...] = ()
    probe: Probe = DEFAULT_PROBE
    force: float = 1.0
    noise: NoiseModel = NOISE_LEVELS["reference"]
    nuisances: Nuisances = Nuisances()
    side: float | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the requirements.

        The attribute `electrodes` is the number of electrodes of the new layout. A kept electrode is an electrode of
        the initial sensor that keeps its position.

        Raises:
            InputError: If a value is not allowed, or the kept electrodes do not satisfy the rules.
            SceneError: If a press within the radius cannot exist, or if there is no white noise.
            SensorError: If a kept electrode does not exist.
        """
        if not MIN_ELECTRODES <= self.electrodes <= MAX_ELECTRODES:
            raise InputError(
                f"electrodes: expected {MIN_ELECTRODES} to {MAX_ELECTRODES}, got {self.electrodes}; x, y and the force "
                "of a press are three unknowns"
            )
        if not isinstance(self.probe, Circle):
            raise InputError(
                f"probe: expected circle:RADIUS, for which layouts are designed, got {self.probe.notation}"
            )
        check_family(self.sensor.film, self.probe, Domain(self.radius, (self.force, self.force)))
        largest_side = 2.0**0.5 * (self.sensor.film.inner_radius - RIM_DISTANCE)  # of a square at the centre
        check_range("side", self.square_side, (MIN_EXTENT, largest_side), "mm", InputError)
        self.noise.check_white()
        if self.goal not in get_args(Goal):
            raise InputError(f"goal: expected {' or '.join(get_args(Goal))}, got {self.goal!r}")
        self._check_kept_electrodes()

    def _check_kept_electrodes(self) -> None:
        """Raise an error if the electrodes to be kept cannot be a part of the new layout.

        The attribute `keep` contains the names of electrodes of the sensor that keep their positions, and `electrodes`
        is the number of electrodes of the new layout. At least one electrode must be new. The sensor must not be
        calibrated, because a calibration moves its electrodes. With the readout 'edge', all squares must have the same
        side.

        Raises:
            InputError: If a rule is violated.
            SensorError: If a kept electrode does not exist.
        """
        if len(set(self.keep)) < len(self.keep):
            raise InputError(f"keep: expected different names, got {', '.join(self.keep)}")
        if len(self.keep) >= self.electrodes:
            raise InputError(
                f"keep: {len(self.keep)} of {self.electrodes} electrodes are kept, so there is nothing to place"
            )
        is_calibrated = self.sensor.calibration != Calibration()
        if self.kept_electrodes and is_calibrated:
            raise InputError(f"keep: {self.sensor.name} is calibrated; start from its layout without [calibration]")

        if self.sensor.readout != "edge":
            return
        rounding_error = 1e-6  # mm
        for electrode in self.kept_electrodes:
            if electrode.side is not None and abs(electrode.side - self.square_side) > rounding_error:
                raise InputError(
                    f"side: with the readout 'edge' all squares have one side, got {self.square_side:g} mm"
                )

    @property
    def square_side(self) -> float:
        """Side of the new squares, mm.

        If the attribute `side` is None, the new squares have the side of the first square of the sensor. If the sensor
        has no square, the side of the new squares is `DEFAULT_SIDE`.
        """
        if self.side is not None:
            return float(self.side)
        sides = (replace(electrode, more=(), back=()).side for electrode in self.sensor.electrodes)  # without traces
        return next((side for side in sides if side is not None), DEFAULT_SIDE)

    @property
    def kept_electrodes(self) -> tuple[Electrode, ...]:
        """Electrodes whose positions in the new layout are the same as in the initial sensor."""
        return tuple(self.sensor.electrodes[electrode_index(self.sensor, name)] for name in self.keep)

    @property
    def new_count(self) -> int:
        """Number of new electrodes. The design chooses their positions."""
        return self.electrodes - len(self.keep)

    @property
    def search_presses(self) -> Array:
        """Positions (x, y) of the presses for which the search evaluates random layouts, shape (n, 2), mm."""
        return self.radius * sunflower(SEARCH_PRESSES)

    @property
    def fine_presses(self) -> Array:
        """Positions (x, y) of many presses, shape (n, 2), mm.

        Many presses are needed, because the largest position error mostly occurs in a small region beside an electrode.
        """
        return self.radius * sunflower(FINE_PRESSES)

    def clearance(self, positions: Array) -> Array:
        """Compute the margin with which each square satisfies the distance rules.

        The distance between a square and the rim of the film must be at least `RIM_DISTANCE`. The gap between a square
        and the bounding box of each part of a kept electrode must be at least `GAP`.

        Args:
            positions: Centres (x, y) of the squares, shape (n, 2), mm.

        Returns:
            Smallest margin of each square, shape (n,), mm. A margin is the actual distance minus the required distance,
            and is negative if the square violates a rule.
        """
        # The outermost corner of a square determines its distance from the rim of the film.
        half_side = 0.5 * self.square_side
        corner_x, corner_y = (np.abs(positions) + half_side).T  # mirrored into the first quadrant
        corner_distance = np.hypot(corner_x, corner_y)  # from the centre of the film
        clearances = [self.sensor.film.inner_radius - RIM_DISTANCE - corner_distance]

        for electrode in self.kept_electrodes:
            for part in electrode.metal:
                # Compute the gaps along x and y, shape (n, 2). A gap is negative if the square and the part overlap
                # along this axis. One large gap is sufficient, so the larger gap counts.
                axis_gaps = np.maximum(part.min(axis=0) - positions, positions - part.max(axis=0)) - half_side
                clearances.append(axis_gaps.max(axis=1) - GAP)
        return np.asarray(np.min(clearances, axis=0))

    def pair_clearance(self, positions: Array, others: Array) -> Array:
        """Compute by how much the gap between each pair of new squares exceeds the smallest allowed gap.

        Args:
            positions: Centres (x, y) of the first squares, shape (n, 2), mm.
            others: Centres (x, y) of the second squares, shape (m, 2), mm.

        Returns:
            Actual gap minus required gap for each pair, shape (n, m), mm; negative for a pair that violates the rule.
        """
        # The gap between two squares along an axis is the distance of their centres along this axis, minus one side. It
        # is sufficient if the gap along x or the gap along y is large enough, so the larger distance counts.
        distance = np.abs(positions[:, None] - others).max(axis=2)
        return np.asarray(distance - self.square_side - GAP)

    def all_clearances(self, positions: Array) -> Array:
        """Compute the margins with which a layout satisfies all distance rules.

        Args:
            positions: Centres (x, y) of the new squares, shape (n, 2), mm.

        Returns:
            The margin of each square, followed by the margin of each pair of squares, shape (n + n (n - 1) / 2,), mm.
            A margin is negative if a rule is violated.
        """
        each_pair_once = np.triu_indices(len(positions), 1)
        pair_clearances = self.pair_clearance(positions, positions)[each_pair_once]
        return np.concatenate([self.clearance(positions), pair_clearances])

    def position_errors(self, charges: Array, nuisances: Nuisances) -> Array:
        """Compute the Cramer-Rao limit of the position error of each press if the nuisance parameters are uncertain.

        The parameters of a press are x, y, ln F, the probe radius and the pretension. The uncertainty of the gains is
        added to the noise.

        Args:
            charges: Charge of each electrode, followed by its derivatives with respect to the five parameters in the
                above order, shape (n_press, n_electrode, 6).
            nuisances: Standard deviations of the parameters that are not known exactly.

        Returns:
            Root mean square errors, shape (n_press,), mm.
        """
        charge = charges[..., 0]
        contact_derivatives = charges[..., 1:4]  # with respect to x, y and ln F
        nuisance_derivatives = charges[..., 4:]  # with respect to the probe radius and the pretension
        nuisance_changes = nuisance_derivatives * [nuisances.probe_radius, nuisances.pretension]  # by one deviation
        noise = replace(self.noise, gain=float(np.hypot(self.noise.gain, nuisances.gain)))
        return cramer_rao(charge, contact_derivatives, noise, nuisance_changes).position

    def layout(self, positions: Array) -> Sensor:
        """Create the sensor that has the kept electrodes and new squares at given positions.

        The new squares are named in anticlockwise order, beginning at the x axis. The electrodes of the sensor are
        sorted by their names. The sensor is not calibrated, because a calibration belongs to the initial layout. In the
        design case, `electrodes` is the number of all electrodes, and `keep` contains the names of the kept electrodes.

        Args:
            positions: Centres (x, y) of the new squares, shape (n, 2), mm.
        """
        angle = np.arctan2(positions[:, 1], positions[:, 0]) % math.tau
        anticlockwise = positions[np.argsort(angle)]
        unused_names = [name for name in NAMES if name not in self.keep]
        squares = [
            Electrode.of_square(name, (x, y), self.square_side)
            for name, (x, y) in zip(unused_names, anticlockwise.tolist(), strict=False)  # more names than squares
        ]
        all_electrodes = tuple(sorted((*self.kept_electrodes, *squares), key=lambda electrode: electrode.name))
        sensor_name = f"{self.sensor.name}-{self.electrodes}-over-{self.radius:g}mm"  # as in "film-4-over-8mm"
        return replace(self.sensor, name=sensor_name, electrodes=all_electrodes, calibration=Calibration())

    def to_dict(self) -> dict[str, Any]:
        """Return the requirements as a dictionary for JSON, without the sensor."""
        return {
            "electrodes": self.electrodes,
            "radius_mm": self.radius,
            "goal": self.goal,
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
            "gap_mm": GAP,
            "rim_mm": RIM_DISTANCE,
            "seed": self.seed,
        }
