"""Everything that is solved for the page, once: forward maps and single presses, on all workers."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from time import process_time
from typing import Any

import numpy as np
from choices import PAPER, Choices
from scipy.optimize import least_squares

from isocharge.common.arrays import Array
from isocharge.common.errors import SolveError
from isocharge.common.progress import report
from isocharge.simulate.contours.charge_curves import Curves, Mapping
from isocharge.simulate.execution.workers import in_order
from isocharge.simulate.forward.charge_spline import ChargeSpline
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.forward.readout import touch_charge
from isocharge.simulate.mechanics.theory import Theory
from isocharge.simulate.mesh.resolution import Resolution
from isocharge.simulate.numerics.disk import lattice
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.probe import Probe
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.simulate.solver.equilibrium import Equilibrium
from isocharge.simulate.solver.press import press
from isocharge.simulate.solver.settings import SolveSettings

FORCE = 1.0
"""Force of the paper's presses, N."""

SLACK = 1.0 + 1e-6
"""Factor on the reach of a scheme, dimensionless: its outermost press then lies inside the forward map."""

MESHES = ((2, 6, 3, 1), (3, 8, 4, 1), (4, 8, 5, 1), (5, 8, 5, 1), (6, 8, 6, 1))

FINEST = (8, 12, 7, 2)
"""Order, around, rings and rim of the mesh that MESHES, whose entries have the same meaning, are compared with."""

CHAIN_ACCURACY = 2e-3
"""Relative error of a charge in the comparison of thicknesses, where some tenths of a percent cannot be seen."""


@dataclass(frozen=True)
class SolveJob:
    """Single presses to solve, the same way each: charges of some sensors.

    Attributes:
        sensors: All with the same film.
        probe: The footprint.
        at: (x, y) of each, mm.
        force: Of each, N; each is started from the one before.
        accuracy: Target for the relative error of a charge.
    """

    sensors: tuple[Sensor, ...]
    probe: Probe
    at: tuple[tuple[float, float], ...]
    force: tuple[float, ...]
    accuracy: float = 1e-3


def solve_presses(job: SolveJob) -> Array:
    """Touch charges, shape (n_sensor, n_press, n_electrode), pC; all sensors have as many electrodes."""
    start: Equilibrium | None = None
    charge = []
    for at, force in zip(job.at, job.force, strict=True):
        start = press(job.sensors[0].film, job.probe, at, force, SolveSettings(accuracy=job.accuracy), start=start)
        charge.append([touch_charge(sensor, start) for sensor in job.sensors])
    return np.moveaxis(np.array(charge), 1, 0)


@dataclass(frozen=True)
class MapJob:
    """A forward map to build at 1 N."""

    sensor: Sensor
    probe: Probe
    radius: float


def build_map(job: MapJob) -> ForwardMap:
    """The forward map of a job."""
    return ForwardMap.build(job.sensor, job.probe, job.radius, (FORCE, FORCE))


@dataclass(frozen=True)
class MeshJob:
    """One press on one mesh."""

    sensor: Sensor
    probe: Probe
    at: tuple[float, float]
    mesh: tuple[int, int, int, int]


def solve_mesh(job: MeshJob) -> tuple[Array, int, float]:
    """Charges, unknowns and CPU seconds; NaN charges where the mesh gives no equilibrium."""
    began, theory = process_time(), Theory(stretching=True, bending=True, pretensioned=False)
    try:
        solved = press(
            job.sensor.film, job.probe, job.at, FORCE, SolveSettings(theory=theory, resolution=Resolution(*job.mesh))
        )
    except SolveError:
        return np.full(len(job.sensor.electrodes), np.nan), 0, process_time() - began
    charge = touch_charge(job.sensor, solved)
    return charge, 3 * solved.mesh.template.n_node, process_time() - began


def run(job: tuple[Callable[[Any], Any], Any]) -> Any:
    """Run a job: a function and its argument, which a worker process can receive."""
    function, argument = job
    return function(argument)


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
        variants: Charges of named variations, see `_variants`.
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
        names, length = sensor.electrode_names, self.choices.length
        return tuple(Curves.of(forward_map, Mapping.lines(sensor, name, length=length), FORCE) for name in names)

    def charges(self, probe: str, sensor: Sensor, at: Array) -> Array:
        """Touch charges of presses of 1 N at (x, y), shape (n, 2), mm; (n, n_electrode), pC."""
        return self.forward_map(probe, sensor).charges(np.column_stack([at, np.full(len(at), FORCE)]))

    @property
    def places(self) -> Array:
        """Presses spread over the working area, shape (n, 2), mm."""
        z = self.choices.radius * lattice(self.choices.presses) * np.exp(0.1j)  # off the lines of symmetry
        return np.stack([z.real, z.imag], axis=1)


def solve_all(choices: Choices, executor: Executor | None) -> Solves:
    """Solve everything."""
    sensor = choices.sensor("three")
    first = _map_jobs(choices)
    variants = _variants(choices)
    meshes = [(solve_mesh, MeshJob(sensor, choices.triangle, choices.shown, mesh)) for mesh in (*MESHES, FINEST)]
    chains = len(choices.thickness) * len(choices.pretension)
    jobs = _Jobs(executor, len(first) + len(variants) + len(meshes) + chains)
    results = jobs.run(
        [*((build_map, job) for job in first.values()), *((solve_presses, j) for j in variants.values()), *meshes]
    )
    maps = dict(zip(first, results, strict=False))
    varied = dict(zip(variants, results[len(first) :], strict=False))
    eq_4 = find_eq_4(replace(maps["triangle"], sensor=sensor), choices)
    chain_results = jobs.run([(solve_presses, job) for job in _chain_jobs(choices, eq_4[0])])
    charges = np.array(chain_results)[:, 0].reshape(
        len(choices.thickness), len(choices.pretension), len(choices.force), -1
    )
    shown = press(sensor.film, choices.triangle, choices.shown, FORCE)
    return Solves(choices, maps, eq_4, charges, tuple(results[len(first) + len(variants) :]), varied, shown)


class _Jobs:
    """Runs jobs and counts those that are done."""

    def __init__(self, executor: Executor | None, total: int) -> None:
        self._executor, self._done, self._total = executor, 0, total

    def run(self, jobs: Sequence[tuple[Callable[[Any], Any], Any]]) -> list[Any]:
        results = []
        for result in in_order(self._executor, run, jobs):
            results.append(result)
            self._done += 1
            report("solving", self._done, self._total)
        return results


def _map_jobs(choices: Choices) -> dict[str, MapJob]:
    sensor = choices.sensor("three")
    layouts = (sensor, choices.sensor("four"))
    lines = [Mapping.lines(s, name, length=choices.length) for s in layouts for name in s.electrode_names]
    reach = SLACK * max(mapping.radius for mapping in lines)
    ends = (np.deg2rad(PAPER.fig_8_deg[0]), np.deg2rad(PAPER.fig_8_deg[1]))
    printed = SLACK * Mapping.lines(choices.as_printed(), "B", ends, length=choices.printed_length).radius
    return {
        "rectangle": MapJob(sensor, choices.rectangle, max(reach, printed)),
        "triangle": MapJob(sensor, choices.triangle, reach),
        "circle": MapJob(sensor, choices.circle, reach),
    }


def _chain_jobs(choices: Choices, at: tuple[float, float]) -> list[SolveJob]:
    """Charge against force of every film, at the place of eq. 4."""
    sensor, count = choices.sensor("three"), len(choices.force)
    return [
        SolveJob((replace(sensor, film=film),), choices.triangle, (at,) * count, choices.force, CHAIN_ACCURACY)
        for film in (
            replace(sensor.film, thickness=thickness, pretension=pretension)
            for thickness in choices.thickness
            for pretension in choices.pretension
        )
    ]


TAUT = 0.5
"""Pretension of the film that the contours assume to be slack, MPa."""

UNSUSPECTED = 24
"""Number of presses with each probe or film that the contours do not assume."""


def sample(choices: Choices) -> tuple[tuple[float, float], ...]:
    """Positions (x, y) of the presses of the variations, mm."""
    places = 0.9 * choices.radius * lattice(min(UNSUSPECTED, choices.presses)) * np.exp(0.1j)
    return tuple((float(z.real), float(z.imag)) for z in places)


def _variants(choices: Choices) -> dict[str, SolveJob]:
    """Presses with another probe or film than our choice, by name; at the same places, 1 N, paper's readout."""
    sensor, at = choices.sensor("three"), sample(choices)

    def presses(film: Film, probe: Probe) -> SolveJob:
        return SolveJob((replace(sensor, film=film),), probe, at, (FORCE,) * len(at))

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
    papers = np.array([sum(cubic) for cubic in PAPER.cubics])

    def log_ratio_misfit(at: Array) -> Array:
        charge = table.first_order(at[None], FORCE)[0][0]
        misfit: Array = np.log(charge[1:] / charge[0]) - np.log(papers[1:] / papers[0])
        return misfit

    position = least_squares(log_ratio_misfit, np.array([0.0, -4.0])).x
    factor = table.first_order(position[None], FORCE)[0][0] / papers
    return (float(position[0]), float(position[1])), float(np.mean(factor))
