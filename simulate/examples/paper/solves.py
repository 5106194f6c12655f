"""All solves for the page: forward maps and single presses, which are distributed over the workers."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from time import process_time
from typing import Any

import numpy as np
from choices import CUBICS, FIG_8_DEG, Choices
from mapping import Curves, Mapping
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
from isocharge.simulate.execution import in_order
from isocharge.simulate.forward.charge_map import within
from isocharge.simulate.numerics.disk import sunflower

FORCE = 1.0
"""Force of the paper's presses, N."""

SLACK = 1.0 + 1e-6
"""Factor by which a forward map extends beyond the outermost press of a scheme, because of rounding, dimensionless."""

MESHES = ((2, 6, 3, 1), (3, 8, 4, 1), (4, 8, 5, 1), (5, 8, 5, 1), (6, 8, 6, 1))

FINEST = (8, 12, 7, 2)
"""Mesh with which `MESHES` are compared: order, number of elements around the circle, rings and thin rings. The entries
of `MESHES` have the same meaning."""

CHAIN_ACCURACY = 2e-3
"""Relative error of a charge in the comparison of thicknesses. An error of a few tenths of a percent is not visible in
the figure."""

TAUT = 0.5
"""Pretension of a film for which the contours assume no pretension, MPa."""

UNSUSPECTED = 24
"""Number of presses with each probe or film that differs from the assumption of the contours."""

Places = Sequence[tuple[float, float]]

Job = Callable[[], Any]


def call(job: Job) -> Any:
    """Call a job. Worker processes can import this function."""
    return job()


def run_all(jobs: Sequence[Job], title: str, executor: Executor | None) -> list[Any]:
    """Run jobs, and return their results in the order of the jobs.

    Args:
        jobs: The jobs.
        title: Title of the progress bar.
        executor: Executor that runs the jobs; this process if None.
    """
    return list(track(in_order(executor, call, jobs), title, len(jobs)))


def solve_presses(
    sensor: Sensor, probe: Probe, places: Places, forces: Sequence[float], accuracy: float = 1e-3
) -> Array:
    """Compute the touch charges of presses, each of which is solved from the equilibrium of the previous press.

    Args:
        sensor: The sensor.
        probe: The probe.
        places: Positions (x, y) of the presses, mm.
        forces: Forces of the presses, N.
        accuracy: Relative error of the charges.

    Returns:
        Charges, shape (n_press, n_electrode), pC.
    """
    start: Equilibrium | None = None
    charge = []
    for at, force in zip(places, forces, strict=True):
        start = press(sensor.film, probe, at, force, SolveSettings(accuracy=accuracy), start=start)
        charge.append(touch_charge(sensor, start))
    return np.array(charge)


def solve_mesh(
    sensor: Sensor, probe: Probe, at: tuple[float, float], mesh: tuple[int, int, int, int]
) -> tuple[Array, int, float]:
    """Solve one press on one mesh, and return the charges (pC), the number of unknowns and the CPU time (s)."""
    began = process_time()
    theory = Theory(bending=True)
    solved = press(sensor.film, probe, at, FORCE, SolveSettings(theory=theory, resolution=Resolution(*mesh)))
    return touch_charge(sensor, solved), 3 * solved.mesh.template.n_node, process_time() - began


@dataclass(frozen=True)
class Solves:
    """Results of all solves for the page.

    Attributes:
        choices: Values that the paper does not state.
        maps: Forward maps at 1 N by probe ("triangle", "rectangle", "circle"). All layouts, piezoelectric coefficients
            and readouts share them, because they contain the stress of the film.
        eq_4: Position (x, y) of eq. 4's press, mm, and the ratio of our charges to the paper's at this position.
        chains: Charges of the films of `choices`, shape (n_thickness, n_pretension, n_force, 3), pC.
        meshes: Charges, number of unknowns and CPU time on each of `MESHES` and on `FINEST`.
        variants: Charges with other probes and films than our choice, by name, for the presses of `sample`, shape
            (n, 3), pC.
        shown: Equilibrium of one press by the triangle, whose mesh and stress are shown.
    """

    choices: Choices
    maps: dict[str, ForwardMap]
    eq_4: tuple[tuple[float, float], float]
    chains: Array
    meshes: tuple[tuple[Array, int, float], ...]
    variants: dict[str, Array]
    shown: Equilibrium

    def forward_map(self, probe: str, sensor: Sensor) -> ForwardMap:
        """Return the forward map of a probe ("triangle", "rectangle" or "circle") for a sensor with the same film."""
        return replace(self.maps[probe], sensor=sensor)

    def scheme(self, probe: str, sensor: Sensor) -> tuple[Curves, ...]:
        """Return the charge curves along the lines from every electrode; see `forward_map` for the arguments."""
        forward_map = self.forward_map(probe, sensor)
        lines = (Mapping.lines(sensor, name, self.choices.length) for name in sensor.electrode_names)
        return tuple(Curves.of(forward_map, mapping, FORCE) for mapping in lines)

    def charges(self, probe: str, sensor: Sensor, at: Array) -> Array:
        """Return the touch charges of presses of 1 N, shape (n, n_electrode), pC.

        Args:
            probe: Name of the probe; see `forward_map`.
            sensor: The sensor.
            at: Positions (x, y) of the presses, shape (n, 2), mm.
        """
        return self.forward_map(probe, sensor).charges(np.column_stack([at, np.full(len(at), FORCE)]))

    @property
    def places(self) -> Array:
        """Positions of presses that are distributed over the working area, shape (n, 2), mm."""
        return spread(self.choices.radius, self.choices.presses)

    def changes(self, name: str) -> Array:
        """Return the relative changes of the charges by a variation, for the presses of `sample`, shape (n, 3)."""
        charge = self.charges("triangle", self.choices.sensor("three"), sample(self.choices))
        return self.variants[name] / charge - 1.0


def spread(radius: float, most: int) -> Array:
    """Return positions that are distributed evenly over a disk, shape (n, 2), mm.

    Args:
        radius: Largest distance from the centre, mm.
        most: Number of positions.
    """
    return radius * sunflower(most)


def sample(choices: Choices) -> Array:
    """Return the positions of the presses for which the variations are solved, shape (n, 2), mm."""
    return spread(0.9 * choices.radius, min(UNSUSPECTED, choices.presses))


def solve_all(choices: Choices, executor: Executor | None) -> Solves:
    """Solve all maps and presses.

    Args:
        choices: Values that the paper does not state.
        executor: Executor that runs the solves; this process if None.
    """
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
    """Return the jobs that solve the forward map of each probe, up to the outermost press of the mapping schemes."""
    sensor = choices.sensor("three")
    lines = [
        Mapping.lines(layout, name, choices.length)
        for layout in (sensor, choices.sensor("four"))
        for name in layout.electrode_names
    ]
    reach = max(mapping.radius for mapping in lines)
    printed = Mapping.lines(choices.as_printed(), "B", choices.printed_length, FIG_8_DEG).radius
    return {
        name: partial(ForwardMap.build, sensor, probe, SLACK * radius, (FORCE, FORCE))
        for name, probe, radius in (
            ("rectangle", choices.rectangle, max(reach, printed)),
            ("triangle", choices.triangle, reach),
            ("circle", choices.circle, reach),
        )
    }


def _variant_jobs(choices: Choices) -> dict[str, Job]:
    """Return the jobs that solve presses of 1 N with another probe or film than our choice, by name."""
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
    """Find the position of the press of eq. 4 from the ratios of its charges at 1 N.

    Args:
        forward_map: Forward map of the triangular probe.
        choices: Values that the paper does not state.

    Returns:
        Position (x, y), mm, and the mean ratio of our charges at this position to those of the paper.
    """
    spline = within(ChargeSpline.of(forward_map, choices.spacing), 1.2 * choices.radius)
    paper_charge = np.array([sum(cubic) for cubic in CUBICS])  # the cubics at 1 N

    def charge_at(position: Array) -> Array:
        """Return our charges of a press of 1 N, shape (3,), pC."""
        return spline.charges(np.array([[*position, FORCE]]))[0]

    def log_ratio_residuals(position: Array) -> Array:
        """Return the differences of the logarithms of B / A and C / A between our charges and the paper's."""
        charge = charge_at(position)
        return np.log(charge[1:] / charge[0]) - np.log(paper_charge[1:] / paper_charge[0])

    position = least_squares(log_ratio_residuals, np.array([0.0, -4.0])).x
    charge_ratio = charge_at(position) / paper_charge
    return (float(position[0]), float(position[1])), float(np.mean(charge_ratio))
