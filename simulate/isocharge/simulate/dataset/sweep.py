"""Sweeps: sampling of many presses, computation of their charges, and creation of a dataset.

The presses are scrambled Sobol points, which cover the domain more evenly than independent random numbers (Owen 1998).
Each probe has its own Sobol sequence. The positions are uniformly distributed over the disk. The logarithms of the
forces are uniformly distributed over the range of forces. If a sweep has several probes, successive presses cycle
through the probes.

A forward map is built for every probe and evaluated for every press. For the presses between the radius of the sweep
and the clamp, a coarse map of the whole film is built, with a round probe. An error of a few percent is acceptable in
the coarse map, because these presses only teach a network which charges belong to no contact in its working area.

A task of the executor computes the charges of one shard, which is one file of the dataset. The files are therefore the
same for every executor. The dataset is written completely or not at all.
"""

import logging
import math
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
import scipy  # loads each of its subpackages on first use

from isocharge.common.arrays import Array, Integers
from isocharge.common.contact_domain import Domain
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import SceneError, SolveError
from isocharge.common.files import StrPath, check_new_output, new_folder
from isocharge.common.progress import report, second_thread
from isocharge.simulate.dataset.shards import (
    MAX_SHARD_BYTES,
    Samples,
    write_files,
)
from isocharge.simulate.execution import in_order
from isocharge.simulate.forward.family import Orientation, check_domain
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.forward.whole_film import outermost_distance, whole_film_map
from isocharge.simulate.numerics.disk import log_spaced_forces
from isocharge.simulate.sensor.film import tidy
from isocharge.simulate.sensor.footprint import Probe
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.simulate.solver.assembly import single_threaded_blas
from isocharge.simulate.solver.load_case import SolveSettings
from isocharge.simulate.solver.stress_limit import yield_force

MAX_SAMPLES = 10_000_000
"""Largest number of presses of a sweep. The files of a dataset with so many presses occupy about 600 MB."""

SAMPLING = "scrambled Sobol, uniform over the disk, log-uniform in force"
"""Description of the sampling in the manifest of a dataset."""

OUTSIDE_PROBE = -1
"""Index of the round probe for the presses outside the disk. This probe is the last of all probes."""


@dataclass(frozen=True)
class SweepPresses:
    """Presses of a sweep, which is a simulation of many presses.

    Attributes:
        probe: Index of the probe of each press, shape (n,); `OUTSIDE_PROBE` for a press outside the disk of the sweep.
        contact: Contact (x, y, F) of each press, shape (n, 3), mm and N.
        rotation: Rotation of the probe in addition to its own orientation, anticlockwise, shape (n,), rad.
    """

    probe: Integers
    contact: Array
    rotation: Array

    def __len__(self) -> int:
        return self.probe.size

    def __getitem__(self, part: slice | Integers) -> "SweepPresses":
        """Return the presses that a slice or an array of indices selects."""
        return SweepPresses(self.probe[part], self.contact[part], self.rotation[part])


@dataclass(frozen=True)
class Sweep:
    """Definition of the presses of a sweep.

    Attributes:
        radius: Largest distance of a press from the centre, mm.
        force_range: Smallest and largest force, N.
        samples: Number of presses, which are divided equally among the probes.
        seed: Seed of the random numbers.
        orientation: "fixed" if the given probes keep their orientations, "random" if the probes are rotated randomly
            over a full turn.
        outside: Number of additional presses between the disk and the clamp; 0 for none.
    """

    radius: float = DEFAULT_RADIUS
    force_range: tuple[float, float] = DEFAULT_FORCE_RANGE
    samples: int = 20_000
    seed: int = 0
    orientation: Orientation = "fixed"
    outside: int = 16_384

    def __post_init__(self) -> None:
        """Check the definition of the sweep.

        The attributes `samples` and `outside` are the numbers of presses inside and outside the disk of the sweep.

        Raises:
            SceneError: If a value is not allowed.
        """
        check_domain(Domain(self.radius, self.force_range))
        for name, smallest in (("samples", 1), ("outside", 0)):
            count = getattr(self, name)
            if not smallest <= count <= MAX_SAMPLES:
                raise SceneError(f"{name}: expected {smallest} to {MAX_SAMPLES} presses, got {count}")
        if self.seed < 0:
            raise SceneError(f"seed: expected 0 or more, got {self.seed}")
        if self.orientation not in get_args(Orientation):
            raise SceneError(f"orientation: expected 'fixed' or 'random', got {self.orientation!r}")

    def contacts(self) -> Array:
        """Return the contacts (x, y, F) of a sweep with one probe, shape (n, 3), mm and N."""
        # The contacts lie between the radii 0 and `radius`. The stream (0,) is that of the first probe.
        contact, _ = self._draw(self.samples, 0.0, self.radius, stream=(0,))
        return contact

    def outside_presses(self, outer_radius: float) -> SweepPresses:
        """Return presses between the disk of the sweep and a larger circle.

        Args:
            outer_radius: Radius of the larger circle, mm.
        """
        # The stream (0, 1) selects random numbers that no probe uses.
        contact, _ = self._draw(self.outside, self.radius, outer_radius, stream=(0, 1))
        return SweepPresses(np.full(self.outside, OUTSIDE_PROBE), contact, np.zeros(self.outside))

    def presses(self, probes: Sequence[Probe]) -> SweepPresses:
        """Return the presses of a sweep with several probes.

        Successive presses cycle through the probes. If the orientation is "random", the rotations are uniformly
        distributed over a full turn. Otherwise, all rotations are zero.

        Args:
            probes: Probes of the sweep.

        Raises:
            SceneError: If there are no probes.
        """
        if not probes:
            raise SceneError("probes: expected at least one, got none")
        probe_of_press = np.arange(self.samples) % len(probes)  # index of the probe of each press
        contact = np.empty((self.samples, 3))  # (x, y, F) of each press, mm and N
        rotation = np.zeros(self.samples)  # of each press, rad
        for index in range(len(probes)):
            rows = np.flatnonzero(probe_of_press == index)
            # The stream (index,) selects the random numbers of this probe, which no other probe uses.
            contact[rows], turn_fraction = self._draw(
                rows.size, inner_radius=0.0, outer_radius=self.radius, stream=(index,)
            )
            if self.orientation == "random":
                rotation[rows] = math.tau * turn_fraction
        return SweepPresses(probe_of_press, contact, rotation)

    def _draw(
        self, count: int, inner_radius: float, outer_radius: float, stream: tuple[int, ...]
    ) -> tuple[Array, Array]:
        """Draw contacts between two circles around the centre of the film, and a rotation for each contact.

        The positions are uniformly distributed over the area between the circles. The logarithms of the forces are
        uniformly distributed over the range of forces.

        Args:
            count: Number of contacts.
            inner_radius: Radius of the inner circle, mm.
            outer_radius: Radius of the outer circle, mm.
            stream: Numbers that are appended to the seed. Different streams give independent random numbers. The stream
                is `(index,)` for the probe with this index, and `(0, 1)` for the presses outside the disk.

        Returns:
            Contacts (x, y, F), shape (count, 3), mm and N. Rotations, shape (count,), in full turns.
        """
        # A Sobol sequence is balanced if the number of points is a power of two. Draw the next larger power of two, and
        # use the first `count` points. If there are more probes than presses, a probe has no presses.
        rng = np.random.default_rng([self.seed, *stream])
        log2_count = math.ceil(math.log2(max(count, 2)))
        points = scipy.stats.qmc.Sobol(4, rng=rng).random_base2(log2_count)[:count]
        distance_fraction, angle_fraction, force_fraction, turn_fraction = points.T

        # The area within a distance is proportional to the square of the distance.
        distance = np.sqrt(inner_radius**2 + (outer_radius**2 - inner_radius**2) * distance_fraction)
        position = distance * np.exp(1j * math.tau * angle_fraction)
        force = log_spaced_forces(force_fraction, self.force_range)
        return np.column_stack([position.real, position.imag, force]), turn_fraction


_log = logging.getLogger(__name__)

SHARD_SIZE = 16384
"""Default number of samples in a shard. Computing the charges of one shard takes about two seconds."""

MIN_RING_WIDTH = 0.02
"""Smallest width of the ring between the radius of a sweep and the clamp, in film radii, dimensionless.

A narrower ring contains no presses.
"""


def run_sweep(
    folder: StrPath,
    sensor: Sensor,
    probes: Sequence[Probe],
    sweep: Sweep,
    settings: SolveSettings = SolveSettings(),
    *,
    executor: Executor | None = None,
    maps: Sequence[ForwardMap] = (),
    shard: int = SHARD_SIZE,
) -> Path:
    """Compute the charges of the presses of a sweep, and write them as a dataset.

    Args:
        folder: Folder that is created. The folder must not exist yet.
        sensor: Sensor whose charges are computed.
        probes: Probes. Successive presses cycle through them.
        sweep: Definition of the presses.
        settings: Accuracy, theory and mesh of the solver.
        executor: Executor that runs the tasks, such as a process pool or the executor of a Dask cluster; None for this
            process. The files do not depend on the executor.
        maps: Forward map of each probe; empty if this function must build the maps.
        shard: Largest number of samples in a shard, which is one file of the dataset.

    Returns:
        Path of the folder.

    Raises:
        SceneError: If a press of the sweep cannot exist, or if `maps` do not belong to the sensor and the probes.
        SolveError: If a press has no equilibrium, or the interpolation error of a forward map is too large.
        OutputExists: If the folder already exists. This error is raised before the computation starts.
        OutputError: If a file cannot be written.
        WorkersLost: If the executor loses its workers.
    """
    folder = Path(folder)
    probes = tuple(probes)
    check_new_output(folder)
    if maps and [(each_map.sensor, each_map.probe) for each_map in maps] != [(sensor, probe) for probe in probes]:
        raise SceneError("maps: expected one forward map of this sensor for each probe, in the order of the probes")

    # SciPy ignores an interrupt while it draws the presses. They are therefore drawn before the folder exists.
    presses = sweep.presses(probes)

    # BLAS is faster with one thread, because the matrices are small. The files are written into a temporary folder,
    # which becomes `folder` at the end of the block.
    progress_title = "solving the film up to the clamp"
    with new_folder(folder) as temporary_folder, single_threaded_blas(), second_thread(progress_title) as side_thread:
        # A second thread builds the map of the whole film for the presses outside the radius. Its solves run on the
        # workers of `executor`, and keep them busy while this thread fits the maps of the probes.
        outside_job = side_thread.submit(outside_map, sensor, probes, sweep, executor=executor)
        probe_maps = maps or solve_maps(sensor, probes, sweep, settings, executor=executor)
        map_of_whole_film = outside_job.result()
        shards = _divide_into_shards(sweep, presses, _shard_size(probes, shard), map_of_whole_film)
        samples = _compute_samples(probe_maps, map_of_whole_film, shards, executor)  # iterator over the shards
        write_files(
            temporary_folder, folder.name, sensor, samples, _manifest_entries(probe_maps, map_of_whole_film, sweep)
        )
    return folder


def solve_maps(
    sensor: Sensor,
    probes: Sequence[Probe],
    sweep: Sweep,
    settings: SolveSettings = SolveSettings(),
    *,
    executor: Executor | None = None,
) -> tuple[ForwardMap, ...]:
    """For each probe of a sweep, build a forward map that covers the radius and the forces of the sweep.

    Args:
        sensor: Sensor whose charges are computed.
        probes: Probes of the sweep.
        sweep: Definition of the presses.
        settings: Accuracy, theory and mesh of the solver.
        executor: Executor that runs the solves; None to run the solves in this process.
    """
    return tuple(
        ForwardMap.build(
            sensor,
            probe,
            sweep.radius,
            sweep.force_range,
            settings,
            orientation=sweep.orientation,
            executor=executor,
        )
        for probe in probes
    )


def outside_map(
    sensor: Sensor, probes: Sequence[Probe], sweep: Sweep, *, executor: Executor | None = None
) -> ForwardMap | None:
    """Build the coarse map of the whole film for the presses outside the radius of a sweep.

    The probe of the map is a disk whose radius is the largest reach of all probes of the sweep. The reach of a probe is
    the distance from the centroid of its footprint to the farthest point of the footprint.

    Args:
        sensor: Sensor whose charges are computed.
        probes: Probes of the sweep.
        sweep: Definition of the presses.
        executor: Executor that runs the solves; None to run the solves in this process.

    Returns:
        The map; None if no presses outside the radius are requested, if the ring between the radius and the clamp is
        too narrow, or if the film cannot be solved up to the clamp. The last case is logged as a warning.
    """
    _, max_force = sweep.force_range
    largest_reach = max(probe.under(max_force).reach for probe in probes)
    disk_probe = Circle(largest_reach)

    # The ring lies between the radius of the sweep and the outermost possible press.
    ring_width = outermost_distance(sensor.film, disk_probe) - sweep.radius
    if sweep.outside == 0 or ring_width < MIN_RING_WIDTH * sensor.film.radius:
        return None
    try:
        return whole_film_map(sensor, disk_probe, sweep.force_range, executor=executor)
    except (SceneError, SolveError) as error:
        _log.warning("presses outside %g mm are not simulated: %s", sweep.radius, error)
        return None


def write_sweep(folder: Path, maps: Sequence[ForwardMap], sweep: Sweep) -> Path:
    """Compute the charges of a sweep with given forward maps in this process, and write them as a dataset.

    Args:
        folder: Folder that is created. The folder must not exist yet.
        maps: Forward map of each probe.
        sweep: Definition of the presses.

    Returns:
        Path of the folder.
    """
    probes = [forward_map.probe for forward_map in maps]
    return run_sweep(folder, maps[0].sensor, probes, sweep, maps=maps, shard=SHARD_SIZE)


def _manifest_entries(maps: Sequence[ForwardMap], whole_film: ForwardMap | None, sweep: Sweep) -> dict[str, Any]:
    """Return the entries of the manifest that describe the presses and the solver of a sweep.

    Args:
        maps: Forward map of each probe.
        whole_film: Map of the presses outside the radius of the sweep; None if no press is outside.
        sweep: Definition of the presses.
    """
    outside: dict[str, Any] = {"samples": 0}
    if whole_film is not None:
        outside = {
            "samples": sweep.outside,
            "probe": whole_film.probe.notation,
            "radius_mm": [tidy(sweep.radius), tidy(whole_film.domain.radius)],
            "force_N": list(sweep.force_range),
            "solves": whole_film.solves,
            "interpolation_error": whole_film.error,
        }
    return {
        "probes": list(dict.fromkeys(forward_map.probe.notation for forward_map in maps)),
        "ranges": {
            "radius_mm": tidy(sweep.radius),
            "force_N": list(sweep.force_range),
            "orientation": sweep.orientation,
        },
        "sampling": SAMPLING,
        "seed": sweep.seed,
        "noise": "clean",
        "solver": {
            "theory": maps[0].theory.name,
            "mesh": {forward_map.probe.notation: forward_map.resolution.description for forward_map in maps},
            "solves": sum(forward_map.solves for forward_map in maps),
            "interpolation_error": max(forward_map.error for forward_map in maps),
        },
        "outside": outside,
        "yield_force_N": yield_force(
            maps[0].sensor.film, [forward_map.probe for forward_map in maps], sweep.force_range
        ),
    }


def _divide_into_shards(
    sweep: Sweep, presses: SweepPresses, size: int, whole_film: ForwardMap | None
) -> list[SweepPresses]:
    """Add the presses outside the radius of a sweep to the other presses, and divide all presses into shards.

    Args:
        sweep: Definition of the presses.
        presses: Presses within the radius of the sweep.
        size: Number of presses in a shard. The last shard may have fewer.
        whole_film: Map of the presses outside the radius, which get their own shards; None if no press is outside.
    """
    parts = [presses]
    if whole_film is not None:
        parts.append(sweep.outside_presses(whole_film.domain.radius))
    return [part[start : start + size] for part in parts for start in range(0, len(part), size)]


def _shard_size(probes: Sequence[Probe], largest: int) -> int:
    """Return the number of samples in a shard: `largest`, or fewer if the file would become too large.

    A sample contains the notation of its probe, which is long for a polygon with many corners. The notations may
    fill at most half of the largest allowed file.

    Args:
        probes: Probes of the sweep.
        largest: Largest number of samples.
    """
    bytes_per_notation = 4 * max(len(probe.notation) for probe in probes)  # a character needs four bytes
    return min(largest, MAX_SHARD_BYTES // (2 * bytes_per_notation))


def _compute_samples(
    maps: Sequence[ForwardMap],
    whole_film: ForwardMap | None,
    shards: Sequence[SweepPresses],
    executor: Executor | None,
) -> Iterator[Samples]:
    """Yield the computed samples of each shard in the order of the shards, and report the number of finished presses.

    Args:
        maps: Forward map of each probe.
        whole_film: Map of the presses outside the radius of the sweep; None if no press is outside.
        shards: Presses of each shard.
        executor: Executor that computes the charges; None to compute the charges in this process.
    """
    # The map of the whole film comes last, because the index `OUTSIDE_PROBE` is -1.
    all_maps = list(maps) if whole_film is None else [*maps, whole_film]
    n_press = sum(map(len, shards))
    finished_presses = 0
    report("pressing", finished_presses, n_press)
    for samples in in_order(executor, partial(_samples_of_shard, all_maps), shards):
        finished_presses += len(samples)
        report("pressing", finished_presses, n_press)
        yield samples


def _samples_of_shard(maps: Sequence[ForwardMap], presses: SweepPresses) -> Samples:
    """Compute the charges of the presses in a shard, and return all columns of the shard.

    Args:
        maps: Forward map of each probe, and of the whole film if presses lie outside the radius of the sweep.
        presses: Presses of the shard.
    """
    # The index of a probe is also the index of its map. Presses outside the radius have the index `OUTSIDE_PROBE`,
    # which is -1 and selects the last map.
    charge = np.empty((len(presses), len(maps[0].electrodes)))
    for index in np.unique(presses.probe).tolist():
        rows = np.flatnonzero(presses.probe == index)
        charge[rows] = maps[index].charges(presses.contact[rows], presses.rotation[rows])

    probe_notations = np.array([forward_map.probe.notation for forward_map in maps])
    probe_angles = np.array([forward_map.probe.angle for forward_map in maps])
    x, y, force = presses.contact.T
    rotation_deg = np.rad2deg(probe_angles[presses.probe] + presses.rotation)  # own orientation + additional rotation
    return Samples(
        x_mm=x,
        y_mm=y,
        force_N=force,
        probe=probe_notations[presses.probe],
        orientation_deg=np.mod(np.round(rotation_deg, 9), 360.0),  # rounded, so that 359.999... degrees become 0
        charge_pC=charge,
        outside=presses.probe == OUTSIDE_PROBE,
    )
