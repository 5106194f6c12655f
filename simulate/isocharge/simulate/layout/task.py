"""What is asked of a design, and the checks that come before the search."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
from scipy.optimize import minimize

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError, SceneError
from isocharge.simulate.forward.checks import check_determined
from isocharge.simulate.layout.goal import Goal
from isocharge.simulate.layout.placing import MILLIMETRE, TOUCHING, Parameters, Rules, Zone, axial_choices
from isocharge.simulate.layout.scene import DesignScene, Nuisances
from isocharge.simulate.measuring_chain.levels import NOISE_LEVELS
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.sensor.electrode import Calibration, Electrode
from isocharge.simulate.sensor.probe import Circle, Probe
from isocharge.simulate.sensor.sensor import Sensor, electrode_index

MOST_ELECTRODES = 8
"""Largest number of electrodes of a design."""

SIDE = 3e-3
"""Side of new squares where the sensor has none, m."""

TRIES = 12
"""Random layouts from which one that keeps to the rules is looked for before the search."""

NAMES = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
"""Names of new electrodes: the first letters that are free."""


@dataclass(frozen=True)
class DesignTask:
    """What is asked of a design; all lengths in m, forces in N, pretensions in Pa.

    Attributes:
        sensor: Film, coefficients and readout, and the electrodes that may stay.
        electrodes: Number of electrodes, those that stay included.
        radius: Largest distance of a press from the film's centre.
        goal: What is made small.
        keep: Names of the sensor's electrodes that stay where they are.
        probes: Footprints, round.
        forces: Forces of the presses.
        pretensions: Pretensions of the film; the sensor's own if empty.
        noise: Noise of the readings.
        nuisances: What nobody knows exactly.
        side: Smallest and largest side of the new squares; None for the side of the sensor's squares.
        gap: Smallest distance between two electrodes, along x or along y, or between their corners.
        rim: Smallest distance of an electrode from the film's rim.
        zones: Where no electrode lies.
        symmetry: "none", "mirror" in the x axis, or "2-fold" to "8-fold".
        seed: Of the random layouts that the search starts from.
    """

    sensor: Sensor
    electrodes: int
    radius: float
    goal: Goal = field(default_factory=lambda: Goal.of("worst"))
    keep: tuple[str, ...] = ()
    probes: tuple[Probe, ...] = (Circle(1e-3),)
    forces: tuple[float, ...] = (1.0,)
    pretensions: tuple[float, ...] = ()
    noise: NoiseModel = NOISE_LEVELS["reference"]
    nuisances: Nuisances = field(default_factory=Nuisances)
    side: tuple[float, float] | None = None
    gap: float = 0.5e-3
    rim: float = 1e-3
    zones: tuple[Zone, ...] = ()
    symmetry: str = "none"
    seed: int = 0

    @property
    def sides(self) -> tuple[float, float]:
        """Smallest and largest side of the new squares, m."""
        squares = [e.corners[1][0] - e.corners[0][0] for e in self.sensor.electrodes if e.square]
        return self.side or ((float(squares[0]),) * 2 if squares else (SIDE, SIDE))

    @property
    def stay(self) -> tuple[Electrode, ...]:
        """The electrodes that stay."""
        return tuple(self.sensor.electrodes[electrode_index(self.sensor, name)] for name in self.keep)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the new electrodes."""
        free = [name for name in NAMES if name not in self.keep]
        return tuple(free[: self.electrodes - len(self.keep)])

    @property
    def rules(self) -> Rules:
        """What a layout must keep to."""
        return Rules(self.sensor.film.radius, self.gap, self.rim, self.zones, self.stay)

    @property
    def parameters(self) -> tuple[Parameters, ...]:
        """Free numbers of layouts: one kind for each number of electrodes that a symmetry may have on its axis."""
        count = self.electrodes - len(self.keep)
        return tuple(
            Parameters.of(count, self.sides, self.symmetry, axial) for axial in axial_choices(count, self.symmetry)
        )

    @property
    def scenes(self) -> tuple[DesignScene, ...]:
        """All combinations of probe, force and pretension.

        Raises:
            SceneError: If some presses cannot exist, or a probe is not round.
        """
        film = self.sensor.film
        combinations = product(self.probes, self.forces, self.pretensions or (film.pretension,))
        return tuple(
            DesignScene.of(film, probe, force, self.radius).with_pretension(pretension)
            for probe, force, pretension in combinations
        )

    def check(self) -> None:
        """Refuse what cannot be designed, before anything is solved.

        Raises:
            InputError: If a number is impossible, the electrodes do not fit, or nothing is left to place.
            SceneError: If some presses cannot be solved.
            SensorError: If an electrode that stays does not exist.
        """
        self._check_numbers()
        self._check_electrodes()
        assert self.scenes
        if not self.parameters:
            raise InputError(f"symmetry {self.symmetry!r} cannot hold {self.electrodes} electrodes")
        if not any(_fit(parameters, self.rules, self.seed) for parameters in self.parameters):
            raise InputError(self._crowded())

    def layout(self, centres: Array, sides: Array, name: str) -> Sensor:
        """The sensor with new squares, centres (n, 2) and sides (n,), beside the electrodes that stay."""
        squares = tuple(
            Electrode.of_square(label, (float(x), float(y)), float(side))
            for label, (x, y), side in zip(self.names, centres, sides, strict=True)
        )
        electrodes = tuple(sorted((*self.stay, *squares), key=lambda electrode: electrode.name))
        film = self.sensor.film
        return Sensor(
            name, film, self.sensor.piezo, electrodes, self.sensor.readout, self.sensor.surface, Calibration()
        )

    def to_dict(self) -> dict[str, Any]:
        """For JSON: everything that the design depends on, beside the sensor."""
        return {
            "electrodes": self.electrodes,
            "radius_mm": _mm(self.radius),
            "goal": self.goal.name,
            "keep": list(self.keep),
            "probes": [probe.notation for probe in self.probes],
            "force_N": list(self.forces),
            "pretension_MPa": [1e-6 * scene for scene in self.pretensions or (self.sensor.film.pretension,)],
            "noise": self.noise.to_dict(),
            "nuisances": {
                "probe_radius_mm": 1e3 * self.nuisances.probe_radius,
                "profile": self.nuisances.profile,
                "pretension_MPa": 1e-6 * self.nuisances.pretension,
                "gain": self.nuisances.gain,
            },
            "side_mm": [_mm(side) for side in self.sides],
            "gap_mm": _mm(self.gap),
            "rim_mm": _mm(self.rim),
            "keep_out_mm": [[_mm(value) for value in (*zone.centre, zone.radius)] for zone in self.zones],
            "symmetry": self.symmetry,
            "seed": self.seed,
        }

    def _check_numbers(self) -> None:
        limits: Mapping[str, float] = {"gap": self.gap, "rim": self.rim}
        for name, value in limits.items():
            if not (np.isfinite(value) and value >= 0.0):
                raise InputError(f"{name}: expected a length from 0 mm, got {value * 1e3} mm")
        low, high = self.sides
        if not (np.isfinite([low, high]).all() and 0.0 < low <= high):
            raise InputError(f"side: expected 0 < MIN <= MAX in mm, got {low * 1e3:g} to {high * 1e3:g}")
        for pretension in self.pretensions:
            if not (np.isfinite(pretension) and pretension >= 0.0):
                raise InputError(f"pretension: expected a number from 0 MPa, got {pretension * 1e-6}")
        if not (self.probes and self.forces):
            raise InputError("expected at least one probe and one force")
        if not self.noise.white > 0.0:
            raise InputError(
                f"noise {self.noise.name!r}: expected white noise above 0: without it errors have no limit"
            )

    def _check_electrodes(self) -> None:
        if self.electrodes < 3:
            check_determined_with_words(self.electrodes)
        if self.electrodes > MOST_ELECTRODES:
            raise InputError(f"electrodes: expected 3 to {MOST_ELECTRODES}, got {self.electrodes}")
        if len(set(self.keep)) < len(self.keep):
            raise InputError(f"keep: expected different names, got {', '.join(self.keep)}")
        if self.stay and self.sensor.calibration != Calibration():
            raise InputError(f"keep: {self.sensor.name} is calibrated; start from its layout without [calibration]")
        if len(self.keep) >= self.electrodes:
            raise InputError(
                f"keep: {len(self.keep)} of {self.electrodes} electrodes stay, so there is nothing to place; ask for "
                "more electrodes or keep fewer"
            )
        for electrode in self.stay:
            if self.rules.in_zone(electrode):
                raise InputError(f"keep: electrode {electrode.name!r} lies in a keep-out zone")
        self._check_sides()

    def _check_sides(self) -> None:
        """With the edge readout a sensor file has one side for all squares."""
        stay = [electrode.corners[1][0] - electrode.corners[0][0] for electrode in self.stay]
        if self.sensor.readout == "edge" and np.ptp([*self.sides, *stay]) > TOUCHING:
            words = ", ".join(f"{1e3 * side:g}" for side in sorted({*self.sides, *stay}))
            raise InputError(
                f"side: with the readout 'edge' all squares have one side, those that stay too; got {words} mm; give "
                "one side"
            )

    def _crowded(self) -> str:
        count, side = self.electrodes - len(self.keep), self.sides[0]
        zones = f", outside {len(self.zones)} keep-out zones" if self.zones else ""
        return (
            f"{count} new squares of {side * 1e3:g} mm do not fit on the film of {self.sensor.film.radius * 1e3:g} mm "
            f"radius with gaps of {self.gap * 1e3:g} mm and {self.rim * 1e3:g} mm to the rim{zones}; ask for fewer, "
            "smaller or nearer electrodes, or smaller zones"
        )


def check_determined_with_words(electrodes: int) -> None:
    """Refuse fewer than three electrodes, and say what so few can tell.

    Raises:
        InputError: Always.
    """
    tells = {
        1: "one electrode gives one number: the force of a press whose place is known, and no place",
        2: "two electrodes give two numbers: the force and how far a press on a known line is along it, and no more",
    }
    try:
        check_determined(electrodes)
    except SceneError as error:
        raise InputError(f"electrodes: expected 3 to {MOST_ELECTRODES}, got {electrodes}; "
                         f"{tells.get(electrodes, str(error))}") from error  # fmt: skip


def _mm(length: float) -> float:
    """A length in mm without the round-off of its unit."""
    return round(1e3 * length, 9)


def _fit(parameters: Parameters, rules: Rules, seed: int) -> bool:
    """Whether some layout keeps to the rules: the violations of random ones are made small."""
    rng = np.random.default_rng((seed, 1))
    limit = 1e3 * (rules.film_radius - rules.rim)
    low = parameters.side[0]
    smallest = Parameters(parameters.places, (low, low))

    def broken(free_mm: Array) -> tuple[float, Array]:
        values, slopes = rules.violations(*smallest.layout(free_mm * MILLIMETRE))
        excess = np.maximum(values / MILLIMETRE + 0.01, 0.0)
        return float((excess**2).sum()), smallest.back(np.einsum("r,red->ed", 2.0 * excess, slopes))

    for _ in range(TRIES):
        start = limit * rng.uniform(-0.7, 0.7, smallest.free)
        result = minimize(broken, start, jac=True, method="L-BFGS-B")
        if rules.violations(*smallest.layout(result.x * MILLIMETRE))[0].max() <= 0.0:
            return True
    return False
