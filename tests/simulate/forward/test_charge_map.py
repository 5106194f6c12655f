"""Properties of all charge maps: derivatives, domain and electrode names."""

import numpy as np
import pytest

from isocharge.common.errors import SceneError
from isocharge.simulate import ChargeMap, Domain
from isocharge.simulate.forward.charge_map import differences, within
from isocharge.simulate.numerics.disk import sunflower
from solved_charges import relative_error

DOMAIN = Domain(5.0, (0.1, 2.0))


CHECKED = ("forward map", "spline")
"""Maps that refuse contacts outside their domain."""


@pytest.fixture
def charge_map(request) -> ChargeMap:
    if request.param == "forward map":
        return request.getfixturevalue("three_map")
    spline = request.getfixturevalue("near_spline")
    return spline if request.param == "spline" else within(spline, 4.0)


def contacts(domain: Domain, count: int = 60, share: float = 0.97) -> np.ndarray:
    """Evenly over the disk, and over the forces in the logarithm."""
    at = share * sunflower(count)
    unit = np.linspace(-share, share, count)
    return domain.to_contact(np.column_stack([at, unit]))


@pytest.mark.parametrize("charge_map", [*CHECKED, "within"], indirect=True)
def test_maps_implement_the_charge_map_protocol(charge_map):
    """The derivatives agree with finite differences of the charges with another step.

    On the mesh that `press` chooses, the difference is below 2e-4 of the largest derivative. With elements of order 4,
    it would be 5e-3, because the slope of a membrane has kinks between the elements.
    """
    contact = contacts(charge_map.domain, share=0.7)
    charge, slope = charge_map.linearised(contact)
    np.testing.assert_allclose(charge, charge_map.charges(contact), rtol=1e-12)
    assert slope.shape == (*charge.shape, 3) == (60, len(charge_map.electrodes), 3)
    expected = differences(charge_map.charges, contact, (0.02, 0.02, 1e-3))
    for axis in range(3):
        assert relative_error(slope[..., axis], expected[..., axis]) <= 5e-4


@pytest.mark.parametrize("charge_map", CHECKED, indirect=True)
def test_contacts_outside_the_domain_raise_error_with_the_limits(charge_map):
    radius = charge_map.domain.radius
    low, high = charge_map.domain.force_range
    inside = [0.0, 0.0, low]
    limits = rf"at most {radius:g} mm from the centre and {low:g} to {high:g} N"
    for outside in ([1.01 * radius, 0.0, low], [0.0, 0.0, 1.01 * high], [0.0, 0.0, 0.99 * low], [np.nan, 0.0, low]):
        for ask in (charge_map.charges, charge_map.linearised):
            with pytest.raises(SceneError, match=rf"^press 1 at .* outside the .* {limits}"):
                ask(np.array([inside, outside]))
            with pytest.raises(SceneError, match=r"expected contacts \(x, y, F\), shape \(n, 3\), .* got shape \(3,\)"):
                ask(inside)


@pytest.mark.parametrize("rounding", [1.0 - 1e-12, 1.0 + 1e-12])
def test_domain_accepts_contacts_on_its_edge(rounding):
    DOMAIN.check(np.array([[3.0, 4.0, 2.0], [0.0, 0.0, 0.1]]) * rounding, "map")
