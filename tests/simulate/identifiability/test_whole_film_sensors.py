"""Built-in sensors for almost the whole film, compared with direct solves."""

import numpy as np
import pytest

from isocharge.simulate import Circle, SolveSettings, load_sensor, noise_model, press, touch_charge
from isocharge.simulate.forward.whole_film import COARSE_RESOLUTION
from isocharge.simulate.identifiability.cramer_rao import cramer_rao

STEP = 0.05
"""Step of the finite differences with respect to x and y, mm."""

LOG_FORCE_STEP = 0.05
"""Step of the finite differences with respect to ln F, dimensionless."""

SETTINGS = SolveSettings(resolution=COARSE_RESOLUTION)
"""Settings of the direct solves. Their error of a few percent is small in relation to the variation of the limits."""


def position_limit(sensor, x: float, y: float, force: float) -> float:
    """Compute the Cramer-Rao limit of the position, mm, from finite differences of direct solves."""
    start = press(sensor.film, Circle(1.0), (x, y), force, SETTINGS)

    def charge(dx: float = 0.0, dy: float = 0.0, log_force: float = 0.0) -> np.ndarray:
        moved = press(sensor.film, Circle(1.0), (x + dx, y + dy), force * np.exp(log_force), SETTINGS, start=start)
        return touch_charge(sensor, moved)

    by_x = (charge(dx=STEP) - charge(dx=-STEP)) / (2.0 * STEP)
    by_y = (charge(dy=STEP) - charge(dy=-STEP)) / (2.0 * STEP)
    by_log_force = (charge(log_force=LOG_FORCE_STEP) - charge(log_force=-LOG_FORCE_STEP)) / (2.0 * LOG_FORCE_STEP)
    jacobian = np.stack([by_x, by_y, by_log_force], axis=1)
    return float(cramer_rao(charge()[None], jacobian[None], noise_model("reference")).position[0])


@pytest.mark.first_cases(1)
@pytest.mark.parametrize(
    ("name", "radius", "expected"),
    [
        ("eight-25um-biaxial-36mm", 36.0, {0.0: 0.095, 20.0: 0.09, 35.0: 0.053}),
        ("six-25um-biaxial-30mm", 30.0, {0.0: 0.108, 19.0: 0.15, 29.0: 0.098}),
    ],
)
def test_limits_of_the_sensors_for_the_whole_film_stay_small_up_to_their_radius(name, radius, expected):
    """The expected values are means over each ring from the forward map; the limit varies along the ring."""
    sensor = load_sensor(name)
    assert sensor.film.pretension == 0.8
    for distance, limit in expected.items():
        assert distance < radius
        found = position_limit(sensor, distance * np.cos(1.0), distance * np.sin(1.0), 1.0)
        assert found == pytest.approx(limit, rel=0.6)
        assert found < 0.25
