"""Rules of what can be made, and symmetric layouts."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from isocharge.common.errors import InputError
from isocharge.simulate import Electrode
from isocharge.simulate.layout.placing import Parameters, Rules, Zone, axial_choices

STAY = (Electrode.of_square("Z", (10e-3, 0.0), 2e-3),)
RULES = Rules(45e-3, 0.5e-3, 1e-3, (Zone((0.0, 0.0), 3e-3),), STAY)


def test_every_rule_is_a_distance():
    """Two squares of 2 mm: one 5 mm above the zone's centre, one 4 mm right of the first, 6 mm left of the other."""
    values, _ = RULES.violations(np.array([[0.0, 5e-3], [4e-3, 5e-3]]), np.full(2, 2e-3))
    rim = [np.hypot(1.0, 6.0) - 44.0, np.hypot(5.0, 6.0) - 44.0]
    zone = [3.0 - 4.0, 3.0 - np.hypot(3.0, 4.0)]
    gaps = [0.5 - 2.0, 0.5 - np.hypot(8.0, 3.0), 0.5 - np.hypot(4.0, 3.0)]
    assert 1e3 * values == pytest.approx([*rim, *zone, *gaps])


@given(st.lists(st.floats(-20.0, 20.0), min_size=6, max_size=6), st.integers(0, 10**6))
def test_derivatives_of_the_rules(places, seed):
    rng = np.random.default_rng(seed)
    centres, sides = 1e-3 * np.array(places).reshape(3, 2), rng.uniform(1e-3, 4e-3, 3)
    centres += 1e-4 * rng.standard_normal(centres.shape)
    values, slopes = RULES.violations(centres, sides)
    step = 1e-9 * rng.standard_normal((3, 3))
    ahead, behind = (
        RULES.violations(centres + sign * step[:, :2], sides + sign * step[:, 2])[0] for sign in (1.0, -1.0)
    )
    change = np.einsum("red,ed->r", slopes, step)
    corners = np.abs(ahead + behind - 2.0 * values) > 1e-12  # a corner of the function lies between
    assert change[~corners] == pytest.approx(0.5 * (ahead - behind)[~corners], abs=1e-12)


@pytest.mark.parametrize(
    ("count", "symmetry", "axial"), [(4, "mirror", 0), (5, "mirror", 1), (4, "3-fold", 1), (6, "3-fold", 0)]
)
def test_symmetric_layouts_are_their_own_images(count, symmetry, axial):
    parameters = Parameters.of(count, (3e-3, 3e-3), symmetry, axial)
    assert axial in axial_choices(count, symmetry)
    centres, sides = parameters.layout(np.random.default_rng(1).normal(size=parameters.free))
    z = centres @ [1.0, 1j]
    image = np.conj(z) if symmetry == "mirror" else z * np.exp(2j * np.pi / 3.0)
    assert np.abs(image[:, None] - z).min(axis=1) == pytest.approx(np.zeros(count), abs=1e-12)
    assert sides == pytest.approx(np.full(count, 3e-3))


@pytest.mark.parametrize(("count", "symmetry"), [(5, "3-fold"), (4, "1-fold"), (4, "spiral"), (4, "x-fold")])
def test_impossible_symmetries_are_refused(count, symmetry):
    with pytest.raises(InputError, match="symmetry"):
        axial_choices(count, symmetry)


def test_a_zone_has_a_size():
    with pytest.raises(InputError, match="keep-out zone"):
        Zone((0.0, 0.0), 0.0)
