"""The stress of a film under its hardest press, and the force that keeps it below a limit.

The largest principal stress lies under the probe, at the surface of the film, and hardly depends on where on the film
that is up to 0.7 of its radius: one press at the centre tells it. Nearer the rim it is larger, 1.4 times at 0.8 and 3.7
times at 0.93 of the radius. Under a tip it grows a little slower than F^(2/3), as in a membrane.
"""

from functools import lru_cache

import numpy as np
import scipy  # loads a part when it is used

from isocharge.common.defaults import DEFAULT_STRESS_LIMIT
from isocharge.common.errors import SceneError
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.probe import Probe
from isocharge.simulate.solver.equilibrium import principal_stress
from isocharge.simulate.solver.press import press


@lru_cache(maxsize=256)
def largest_stress(film: Film, probe: Probe, force: float) -> float:
    """Largest principal stress under a press (N) at the centre, pretension included, MPa, tension positive.

    Raises:
        SceneError: If the press cannot exist.
        SolveError: If no equilibrium is reached.
    """
    return principal_stress(press(film, probe, (0.0, 0.0), force))[1]


def stress_caution(film: Film, probe: Probe, force: float, limit: float = DEFAULT_STRESS_LIMIT) -> str:
    """A sentence if a press (N) stresses a film beyond a limit (MPa), else nothing; raises as `largest_stress`."""
    stress = largest_stress(film, probe, force)
    if stress <= limit:
        return ""
    return (
        f"{force:.3g} N under {probe.notation} stress the film to {stress:.3g} MPa, the limit is {limit:.3g} MPa; PVDF "
        "yields at 45 to 55 MPa, and a dent stays"
    )


def force_within_stress(film: Film, probe: Probe, limit: float, force_range: tuple[float, float]) -> float:
    """Largest force of a range whose press stays within a stress, N, to 0.1 %.

    Args:
        film: What is pressed.
        probe: What presses.
        limit: MPa.
        force_range: N.

    Raises:
        SceneError: If even the smallest force exceeds the limit, or a press cannot exist.
        SolveError: If no equilibrium is reached.
    """
    low, high = force_range
    if (least := largest_stress(film, probe, low)) > limit:
        raise SceneError(
            f"stress limit: expected more than {least:.3g} MPa, which {low:.3g} N under {probe.notation} make in this "
            f"film, got {limit:.3g} MPa"
        )
    if largest_stress(film, probe, high) <= limit:
        return high

    def beyond(log_force: float) -> float:  # nearly straight: the stress grows like a power of the force
        return float(np.log(largest_stress(film, probe, float(np.exp(log_force))) / limit))

    # secants: a last step of 1 % is exact to 0.01 %
    found = scipy.optimize.newton(beyond, np.log(low), x1=np.log(high), tol=0.01)
    return float(np.exp(found))
