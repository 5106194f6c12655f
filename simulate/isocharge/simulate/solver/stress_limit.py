"""Largest stress under a probe, and the force at which the film reaches a limit such as the yield stress.

The largest principal stress occurs under the probe, at the surface of the film. For presses within 0.7 film radii of
the centre, the largest stress hardly depends on the position of the press. The largest stress is therefore computed for
a press at the centre. For presses closer to the rim, the largest stress increases. At 0.8 film radii, the largest
stress is 1.4 times the stress at the centre. At 0.93 film radii, the largest stress is 3.7 times the stress at the
centre. In a membrane, the stress is proportional to F^(2/3), where F is the force. Under a small probe, the stress
increases slightly more slowly with the force.
"""

import math
from collections.abc import Sequence
from functools import lru_cache

import scipy  # scipy.optimize is imported when it is used

from isocharge.common.defaults import DEFAULT_STRESS_LIMIT
from isocharge.common.errors import SceneError, SolveError
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.footprint import Probe
from isocharge.simulate.solver.equilibrium import principal_stress
from isocharge.simulate.solver.press import press


@lru_cache(maxsize=256)
def largest_stress(film: Film, probe: Probe, force: float) -> float:
    """Compute the largest principal stress under a press at the centre of the film, including the pretension.

    Args:
        film: The film.
        probe: The probe.
        force: Force, N.

    Returns:
        Stress, MPa, tension positive.

    Raises:
        SceneError: If the press cannot exist.
        SolveError: If no equilibrium is reached.
    """
    _, largest = principal_stress(press(film, probe, (0.0, 0.0), force))
    return largest


def stress_caution(film: Film, probe: Probe, force: float) -> str:
    """Return a warning if a press at the centre stresses the film to more than `DEFAULT_STRESS_LIMIT`.

    Otherwise, return an empty string. Near the clamp, the stress can exceed the limit without a warning.

    Args:
        film: The film.
        probe: The probe.
        force: Force, N.

    Raises:
        SceneError: If the press cannot exist.
        SolveError: If no equilibrium is reached.
    """
    stress = largest_stress(film, probe, force)
    if stress <= DEFAULT_STRESS_LIMIT:
        return ""
    return (
        f"{force:.3g} N under {probe.notation} stress the film to {stress:.3g} MPa at the centre, the "
        f"limit is {DEFAULT_STRESS_LIMIT:.3g} MPa; PVDF yields at 45 to 55 MPa, and a dent stays"
    )


def force_within_stress(film: Film, probe: Probe, limit: float, force_range: tuple[float, float]) -> float:
    """Compute the largest force of a range with which a press at the centre does not stress the film beyond a limit.

    The equation ln(stress / limit) = 0 is solved for the logarithm of the force by Brent's method, which does not leave
    the range. The relative error of the force is below 0.1 %.

    Args:
        film: The film.
        probe: The probe.
        limit: Largest allowed stress, MPa.
        force_range: Smallest and largest force, N.

    Returns:
        Force, N. If the stress does not exceed the limit at any force of the range, the largest force is returned.

    Raises:
        SceneError: If the stress exceeds the limit even at the smallest force, or if a press cannot exist.
        SolveError: If no equilibrium is reached.
    """
    min_force, max_force = force_range
    stress_at_min_force = largest_stress(film, probe, min_force)
    if stress_at_min_force > limit:
        raise SceneError(
            f"stress limit: expected more than {stress_at_min_force:.3g} MPa, which {min_force:.3g} N under "
            f"{probe.notation} make at its centre, got {limit:.3g} MPa"
        )
    if largest_stress(film, probe, max_force) <= limit:
        return max_force

    log_force = scipy.optimize.brentq(
        lambda log_force: math.log(largest_stress(film, probe, math.exp(log_force)) / limit),
        math.log(min_force),
        math.log(max_force),
        xtol=1e-3,
    )
    return math.exp(log_force)


def yield_force(film: Film, probes: Sequence[Probe], force_range: tuple[float, float]) -> float | None:
    """Compute the smallest force with which any of several probes makes the film yield at the centre.

    The film yields if its stress exceeds `DEFAULT_STRESS_LIMIT`. Near the clamp, the film yields with a smaller force.

    Args:
        film: The film.
        probes: The probes. A probe under which the stress cannot be computed is ignored.
        force_range: Smallest and largest force, N.

    Returns:
        Force, N, rounded to four digits; None if the film does not yield within the range of forces.
    """
    min_force, max_force = force_range
    yield_forces = []
    for probe in probes:
        try:
            probe_force = force_within_stress(film, probe, DEFAULT_STRESS_LIMIT, force_range)
        except SceneError:  # raised if the film yields already at the smallest force
            yield_forces.append(min_force)
        except SolveError:
            continue
        else:
            if probe_force < max_force:
                yield_forces.append(probe_force)
    return float(f"{min(yield_forces):.4g}") if yield_forces else None
