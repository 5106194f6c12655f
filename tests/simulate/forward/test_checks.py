"""What a charge map is asked: presses inside pass, by a hair too; the first one outside is named with its values."""

import numpy as np
import pytest

from isocharge.common.errors import ChargeError, SceneError
from isocharge.simulate.forward.checks import as_charges, check_forces, check_presses, check_radius

FORCES = (0.1, 2.0)


def test_limits_are_inside_also_when_rounded():
    edge = np.array([[3e-3], [4e-3], [2.0]])
    for wiggle in (1.0 - 1e-12, 1.0, 1.0 + 1e-12):
        check_presses(*(wiggle * edge), radius=5e-3, force_range=FORCES, source="map")
        check_forces(np.array(FORCES) * wiggle, FORCES, "map")
        check_radius(5e-3 * wiggle, 5e-3, "map")


@pytest.mark.parametrize("column", [0, 1, 2])
@pytest.mark.parametrize("value", [np.nan, 3.0, -3.0])
def test_the_first_press_outside_is_named(column, value):
    press = np.tile([[1e-3], [2e-3], [1.0]], 4)
    press[column, 2] = value
    x, y, force = press
    with pytest.raises(SceneError, match=r"^press 2 at .* is outside the map: expected at most 5 mm .* 0\.1 to 2 N$"):
        check_presses(x, y, force, radius=5e-3, force_range=FORCES, source="map")


def test_a_single_force_is_not_numbered():
    with pytest.raises(SceneError, match=r"^force: expected 0\.1 to 2 N, which the map covers, got 3 N$"):
        check_forces(3.0, FORCES, "map")
    with pytest.raises(SceneError, match=r"^force of press 1: .* got 3 N$"):
        check_forces(np.array([1.0, 3.0]), FORCES, "map")


def test_charges_come_out_as_float64():
    charge = as_charges(np.ones((2, 3), dtype=np.float32), ("A", "B", "C"))
    assert charge.dtype == np.float64
    with pytest.raises(ChargeError, match=r"shape \(n, 3\) for \('A', 'B', 'C'\), got shape \(3,\)"):
        as_charges(np.ones(3), ("A", "B", "C"))
