"""Forward maps and working areas that commands solve, with a progress bar."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from isocharge.cli.shared.options import radius_mm_of
from isocharge.cli.shared.terminal import progress, progress_rows, say
from isocharge.common.errors import InputError

if TYPE_CHECKING:
    from isocharge.simulate import ForwardMap, Probe, Sensor

SLACK = 1.0 + 1e-6
"""Factor on the radius that a map is asked for: rounding may put the outermost presses just outside it."""


def solve_forward_map(sensor: "Sensor", probe: "Probe", radius: float, force: tuple[float, float]) -> "ForwardMap":
    """The forward map of one probe for presses within a radius (m) and a range of forces (N)."""
    from isocharge.simulate import ForwardMap

    with progress(f"solving the film under {probe.notation}") as advance:
        return ForwardMap.build(sensor, probe, radius, force, progress=advance)


def solve_map_to_search(sensor: "Sensor", probe: "Probe", force: tuple[float, float]) -> "ForwardMap":
    """The forward map of one probe over all of the film where a working area is looked for."""
    from isocharge.simulate.identifiability.identification import map_to_search

    with progress_rows((f"solving the film under {probe.notation}", "solves")) as (advance,):
        return map_to_search(sensor, probe, force, advance)


def sweep_radius(text: str, sensor: "Sensor", probes: "Sequence[Probe]", force: tuple[float, float]) -> float:
    """The radius of a sweep, m, from `--radius`: a number of mm, or `auto`."""
    return _working_radius(sensor, probes, force) if text == "auto" else 1e-3 * radius_mm_of(text)


def _working_radius(sensor: "Sensor", probes: "Sequence[Probe]", force: tuple[float, float]) -> float:
    """Radius of the disk that is in the working area of every probe under `reference` noise, m."""
    from isocharge.simulate import noise_model, working_area

    areas = []
    for probe in probes:
        areas.append(working_area(solve_map_to_search(sensor, probe, force), noise_model("reference")))
        say(f"{probe.notation}: {areas[-1].words}")
    radius = min(area.radius for area in areas)
    if radius == 0.0:
        raise InputError(
            "--radius auto: the charges determine the contact nowhere well enough; see 'isocharge simulate identify', "
            "or give a radius in mm"
        )
    return radius
