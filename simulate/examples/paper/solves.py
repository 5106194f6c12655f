"""Everything that is solved for the page, once: forward maps and single presses, on all workers."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from time import process_time
from typing import Any

import numpy as np
from choices import CUBICS, FIG_8_DEG, Choices
from scipy.optimize import least_squares

from isocharge.common.arrays import Array
from isocharge.common.progress import track
from isocharge.simulate import (
    ChargeSpline,
    Equilibrium,
    Film,
    ForwardMap,
    Probe,
    Resolution,
    Sensor,
    SolveSettings,
    Theory,
    press,
    touch_charge,
)
from isocharge.simulate.contours.charge_curves import Curves, Mapping
from isocharge.simulate.execution.workers import in_order
from isocharge.simulate.numerics.disk import lattice

FORCE = 1.0
"""Force of the paper's presses, N."""

SLACK = 1.0 + 1e-6
"""Factor on the reach of a scheme, dimensionless: its outermost press then lies inside the forward map."""

MESHES = ((2, 6, 3, 1), (3, 8, 4, 1), (4, 8, 5, 1), (5, 8, 5, 1), (6, 8, 6, 1))

FINEST = (8, 12, 7, 2)
"""Order, around, rings and rim of the mesh that MESHES, whose entries have the same meaning, are compared with."""

CHAIN_ACCURACY = 2e-3
"""Relative error of a charge in the comparison of thicknesses, where some tenths of a percent cannot be seen."""

TAUT = 0.5
"""Pretension of the film that the contours assume to be slack, MPa."""

UNSUSPECTED = 24
"""Number of presses with each probe or film that the contours do not assume."""

Places = Sequence[tuple[float, float]]

Job = Callable[[], Any]


def call(job: Job) -> Any:
    """Run a job, which a worker process can receive."""
    return job()


def run_all(jobs: Sequence[Job], title: str, executor: Executor | None) -> list[Any]:
    """Results of jobs, in their order."""
    return list(track(in_order(executor, call, jobs), title, len(jobs)))


def solve_presses(
    sensor: Sensor, probe: Probe, places: Places, forces: Sequence[float], accuracy: float = 1e-3
) -> Array:
    """Touch charges at (x, y), mm, under forces, N; each is started from the one before; (n_press, n_electrode), pC."""
    start: Equilibrium | None = None
    charge = []
    for at, force in zip(places, forces, strict=True):
        start = press(sensor.film, probe, at, force, SolveSettings(accuracy=accuracy), start=start)
        charge.append(touch_charge(sensor, start))
    return np.array(charge)


def solve_mesh(
    sensor: Sensor, probe: Probe, at: tuple[float, float], mesh: tuple[int, int, int, int]
) -> tuple[Array, int, float]:
    """One press on one mesh: charges, unknowns and CPU seconds."""
    began = process_time()
    theory = Theory(stretching=True, bending=True, pretensioned=False)
    solved = press(sensor.film, probe, at, FORCE, SolveSettings(theory=theory, resolution=Resolution(*mesh)))
    return touch_charge(sensor, solved), 3 * solved.mesh.template.n_node, process_time() - began


@dataclass(frozen=True)
class Solves:
    """All that was solved for the page.

    Attributes:
        choices: What the paper leaves open.
        maps: Forward maps at 1 N by probe ("triangle", "rectangle", "circle"); any layout, film direction and readout
            shares them, since they hold the film's stress.
        eq_4: Position (x, y) of eq. 4's press, mm, and the ratio of our charges to the paper's at this position.
        chains: Charges of the films of `choices`, shape (n_thickness, n_pretension, n_force, 3), pC.
        meshes: Of MESHES and FINEST: charges, unknowns, CPU seconds.
        variants: Charges with other probes and films than our choice, by name, at `sample`, shape (n, 3), pC.
        shown: The film under one triangular press, for its mesh and stress.
    """

    choices: Choices
    maps: dict[str, ForwardMap]
    eq_4: tuple[tuple[float, float], float]
    chains: Array
    meshes: tuple[tuple[Array, int, float], ...]
    variants: dict[str, Array]
    shown: Equilibrium

    def forward_map(self, probe: str, sensor: Sensor) -> ForwardMap:
        """The forward map of a probe for any sensor with the same film."""
        return replace(self.maps[probe], sensor=sensor)

    def scheme(self, probe: str, sensor: Sensor) -> tuple[Curves, ...]:
        """Charge curves from every electrode, as far to both sides of the centre as contours need."""
        forward_map = self.forward_map(probe, sensor)
        lines = (Mapping.lines(sensor, name, length=self.choices.length) for name in sensor.electrode_names)
        return tuple(Curves.of(forward_map, mapping, FORCE) for mapping in lines)

    def charges(self, probe: str, sensor: Sensor, at: Array) -> Array:
        """Touch charges of presses of 1 N at (x, y), shape (n, 2), mm; (n, n_electrode), pC."""
        return self.forward_map(probe, sensor).charges(np.column_stack([at, np.full(len(at), FORCE)]))

    @property
    def places(self) -> Array:
        """Presses spread over the working area, shape (n, 2), mm."""
        return spread(self.choices.radius, self.choices.presses)

    def changes(self, name: str) -> Array:
        """Relative changes of the charges that a variation makes, over the presses of the variations, shape (n, 3)."""
        charge = self.charges("triangle", self.choices.sensor("three"), sample(self.choices))
        return self.variants[name] / charge - 1.0


def spread(radius: float, most: int) -> Array:
    """Places of a lattice off the lines of symmetry, shape (n, 2), mm."""
    z = radius * lattice(most) * np.exp(0.1j)
    return np.stack([z.real, z.imag], axis=1)


def sample(choices: Choices) -> Array:
    """Positions of the presses of the variations, shape (n, 2), mm."""
    return spread(0.9 * choices.radius, min(UNSUSPECTED, choices.presses))


def solve_all(choices: Choices, executor: Executor | None) -> Solves:
    """Solve everything."""
    sensor = choices.sensor("three")
    maps = _map_jobs(choices)
    variants = _variant_jobs(choices)
    meshes = [partial(solve_mesh, sensor, choices.triangle, choices.shown, mesh) for mesh in (*MESHES, FINEST)]
    solved = iter(run_all([*maps.values(), *variants.values(), *meshes], "solving", executor))
    forward_maps = {name: next(solved) for name in maps}
    varied = {name: next(solved) for name in variants}
    eq_4 = find_eq_4(forward_maps["triangle"], choices)
    films = [
        replace(sensor.film, thickness=thickness, pretension=pretension)
        for thickness in choices.thickness
        for pretension in choices.pretension
    ]
    places = (eq_4[0],) * len(choices.force)
    chains = [
        partial(solve_presses, replace(sensor, film=film), choices.triangle, places, choices.force, CHAIN_ACCURACY)
        for film in films
    ]
    charges = np.array(run_all(chains, "solving films", executor))
    charges = charges.reshape(len(choices.thickness), len(choices.pretension), *charges.shape[1:])
    shown = press(sensor.film, choices.triangle, choices.shown, FORCE)
    return Solves(choices, forward_maps, eq_4, charges, tuple(solved), varied, shown)


def _map_jobs(choices: Choices) -> dict[str, Job]:
    """Forward maps as far out as the schemes press."""
    sensor = choices.sensor("three")
    lines = [
        Mapping.lines(layout, name, length=choices.length)
        for layout in (sensor, choices.sensor("four"))
        for name in layout.electrode_names
    ]
    reach = max(mapping.radius for mapping in lines)
    first, last = np.deg2rad(FIG_8_DEG)
    printed = Mapping.lines(choices.as_printed(), "B", (first, last), length=choices.printed_length).radius
    return {
        name: partial(ForwardMap.build, sensor, probe, SLACK * radius, (FORCE, FORCE))
        for name, probe, radius in (
            ("rectangle", choices.rectangle, max(reach, printed)),
            ("triangle", choices.triangle, reach),
            ("circle", choices.circle, reach),
        )
    }


def _variant_jobs(choices: Choices) -> dict[str, Job]:
    """Presses with another probe or film than our choice, by name; at the same places, 1 N, paper's readout."""
    sensor = choices.sensor("three")
    places = [(float(x), float(y)) for x, y in sample(choices)]

    def presses(film: Film, probe: Probe) -> Job:
        return partial(solve_presses, replace(sensor, film=film), probe, places, [FORCE] * len(places))

    jobs = {f"probe {probe.notation}": presses(sensor.film, probe) for probe in choices.probes}
    jobs[f"pretension {TAUT:g} MPa"] = presses(replace(sensor.film, pretension=TAUT), choices.triangle)
    for young in choices.young:
        jobs[f"E {young * 1e-3:g} GPa"] = presses(replace(sensor.film, young=young), choices.triangle)
    for poisson in choices.poisson:
        jobs[f"nu {poisson:g}"] = presses(replace(sensor.film, poisson=poisson), choices.triangle)
    return jobs


def find_eq_4(forward_map: ForwardMap, choices: Choices) -> tuple[tuple[float, float], float]:
    """Position (x, y) of eq. 4's press, mm, from the ratios of its charges at 1 N; our charges over the paper's."""
    table = ChargeSpline.of(forward_map, 1.2 * choices.radius, choices.spacing)
    papers = np.array([sum(cubic) for cubic in CUBICS])

    def log_ratio_residuals(at: Array) -> Array:
        charge = table.first_order(at[None], FORCE)[0][0]
        return np.log(charge[1:] / charge[0]) - np.log(papers[1:] / papers[0])

    position = least_squares(log_ratio_residuals, np.array([0.0, -4.0])).x
    factor = table.first_order(position[None], FORCE)[0][0] / papers
    return (float(position[0]), float(position[1])), float(np.mean(factor))
