"""Maps and yield forces that the tests solve once, because a map takes several seconds, and parts of maps."""

from dataclasses import replace

from isocharge.common.defaults import DEFAULT_FORCE_RANGE
from isocharge.simulate import Domain, ForwardMap, load_sensor
from isocharge.simulate.forward.whole_film import whole_film_map
from isocharge.simulate.solver.stress_limit import yield_force
from kept import kept

BUILD = ForwardMap.build  # also if a test replaces the method


def whole_film_map_solved_once(sensor, probe, force_range, **_executor):
    """Return the coarse map of a film, which is solved once for all layouts of electrodes.

    The solution does not depend on the electrodes. If it contains the default forces, it is used for a part of them.
    """
    layout = replace(load_sensor("three-25um-biaxial"), film=sensor.film)
    low, high = DEFAULT_FORCE_RANGE
    is_part = low <= force_range[0] and force_range[1] <= high
    solved = kept(whole_film_map, layout, probe, DEFAULT_FORCE_RANGE if is_part else force_range)
    return part_of(solved, sensor, solved.domain.radius, force_range)


def yield_force_solved_once(film, probes, force_range):
    """Return the smallest force at which a film yields."""
    return kept(yield_force, film, tuple(probes), force_range)


def part_of(solved, sensor, radius, force_range):
    """Return the forward map of a sensor on the film of a solved map, for a part of its presses."""
    return replace(solved, sensor=sensor, family=replace(solved.family, domain=Domain(radius, force_range)))


def build_from_default_map(sensor, probe, radius, force_range, *_, **__):
    """Return `ForwardMap.build` of the built-in film without solves, for a part of the default presses."""
    return part_of(kept(BUILD, load_sensor("three-25um-biaxial"), probe), sensor, radius, force_range)
