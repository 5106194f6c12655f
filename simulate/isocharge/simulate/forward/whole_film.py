"""Coarse forward map of nearly the whole film.

The coarse map is used, for example, to find all presses on the film that cause the same charges as a given press. For
such a search, an error of a few percent is acceptable in the charges of presses near the clamp. A forward map that is
accurate up to the clamp would take minutes to build.
"""

import math
from concurrent.futures import Executor
from dataclasses import replace

from isocharge.common.contact_domain import Domain
from isocharge.simulate.forward.family import NodeCount
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.mesh.blocks import Resolution
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.footprint import Probe
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.simulate.solver.load_case import SolveSettings

COARSE_ERROR = 0.05
"""Largest relative error of a charge of the coarse map, dimensionless.

For presses within two thirds of the film radius, the error is below 0.5 %.
"""

COARSE_RESOLUTION = Resolution(order=4, around=8, rings=10, rim=2)
"""Fineness of the mesh of the coarse map."""

COARSE_RIM_GAP = 1.2
"""Smallest gap between the probe and the clamp in the coarse map, in units of the reach of the probe, dimensionless.

The coarse mesh does not resolve a narrower gap.
"""

COARSE_SMALL_PROBE_GAP = 0.042
"""Smallest gap between a very small probe and the clamp in the coarse map, in film radii, dimensionless.

An element of the coarse mesh would be folded in a narrower gap. For a larger probe, the smallest gap is narrower by
0.75 times the reach of the probe.
"""

COARSE_DISTANCES = 10
"""Number of distances at which presses are solved for the coarse map."""


def outermost_distance(film: Film, probe: Probe) -> float:
    """Return the largest distance of a press from the centre (mm) for which the coarse map is valid.

    See `COARSE_RIM_GAP` and `COARSE_SMALL_PROBE_GAP`.
    """
    gap = max(COARSE_RIM_GAP * probe.reach, COARSE_SMALL_PROBE_GAP * film.inner_radius - 0.75 * probe.reach)
    return film.inner_radius - probe.reach - gap


def whole_film_map(
    sensor: Sensor, probe: Probe, force_range: tuple[float, float], *, executor: Executor | None = None
) -> ForwardMap:
    """Build a coarse forward map of nearly the whole film.

    The solves of an axisymmetric film take about 3 s of CPU time. Any other film takes much longer, because it is
    solved in several directions, and meshed completely.

    The error of the interpolation is not computed. The attribute `error` of the map is the constant `COARSE_ERROR`.

    Args:
        sensor: The sensor.
        probe: Probe that presses the film.
        force_range: Smallest and largest force, N.
        executor: Executor that runs the solves; None for this process.

    Raises:
        SceneError: If some presses cannot exist.
        SolveError: If a press has no equilibrium.
    """
    # The domain contains all presses up to the largest distance from the centre at which the map is valid. The largest
    # force results in the largest footprint, which `probe.under` returns.
    settings = SolveSettings(resolution=COARSE_RESOLUTION)
    min_force, max_force = force_range
    domain = Domain(outermost_distance(sensor.film, probe.under(max_force)), force_range)

    # One force for each factor of e would be too few for a taut film, so there are two more.
    n_force = 2 + math.ceil(math.log(max_force / min_force))
    node_count = NodeCount(COARSE_DISTANCES, n_force)  # numbers of distances and forces of the solved presses
    forward_map = ForwardMap.build_unchecked(sensor, probe, domain, node_count, settings, executor=executor)
    return replace(forward_map, error=COARSE_ERROR)
