"""Largest stress under a press, and the largest force within a stress limit."""

import re
from dataclasses import replace

import pytest

from isocharge.common.errors import SceneError
from isocharge.simulate import Circle, load_sensor, press
from isocharge.simulate.solver.stress_limit import force_within_stress, largest_stress, stress_caution, yield_force

FILM = load_sensor("four-25um-biaxial").film
TIP = Circle(1.0)


def test_stress_of_a_slack_membrane_grows_with_the_force_to_two_thirds():
    """All stresses of a membrane are proportional to F^(2/3) (Foeppl 1907). Bending is negligible at 0.3 um."""
    thin = replace(FILM, thickness=3e-4, pretension=0.0)
    assert largest_stress(thin, TIP, 0.008) / largest_stress(thin, TIP, 0.001) == pytest.approx(4.0, rel=0.03)


def test_repr_of_an_equilibrium_contains_the_largest_stress():
    hard, soft = (repr(press(FILM, TIP, (3.0, -2.0), force)) for force in (1.0, 0.5))
    assert re.fullmatch(
        r"Equilibrium\(1 N under circle:1.0 at \(3, -2\) mm: converged, deflection 2\.8\d* mm, "
        r"stress up to 4[89]\.?\d* MPa, beyond 45 MPa: PVDF yields\)",
        hard,
    )
    assert re.search(r"stress up to 3[23]\.?\d* MPa\)$", soft)


def test_force_within_stress_reaches_the_stress_limit():
    force = force_within_stress(FILM, TIP, 45.0, (0.05, 2.0))
    assert largest_stress(FILM, TIP, force) == pytest.approx(45.0, rel=2e-3)
    assert force_within_stress(FILM, TIP, 80.0, (0.05, 2.0)) == 2.0
    with pytest.raises(
        SceneError, match=r"stress limit: expected more than 8\.\d+ MPa, which 0\.05 N under circle:1\.0"
    ):
        force_within_stress(FILM, TIP, 5.0, (0.05, 2.0))


@pytest.mark.parametrize(
    ("changes", "radius", "force_range"),
    [({"pretension": 30.0}, 1.0, (1e-3, 20.0)), ({"radius": 1.0, "thickness": 5e-4}, 0.02, (1e-6, 1e-3))],
)
def test_yield_force_of_a_taut_film_lies_in_the_range_and_that_of_a_small_film_is_not_rounded_to_zero(
    changes, radius, force_range
):
    """With 30 MPa, the stress hardly grows at first, so a secant through the ends of the range leads far beyond it."""
    film = replace(FILM, **changes)
    probe = Circle(radius)
    force = yield_force(film, [probe], force_range)
    assert largest_stress(film, probe, force) == pytest.approx(45.0, rel=2e-3)


def test_yield_force_of_a_single_force_that_stresses_the_film_too_much():
    assert yield_force(FILM, [TIP], (15.0, 15.0)) == 15.0
    assert yield_force(FILM, [TIP], (0.05, 0.05)) is None


def test_probe_of_1_mm_exceeds_the_yield_stress_of_pvdf():
    largest = largest_stress(FILM, TIP, 1.0)
    assert largest == pytest.approx(48.8, rel=3e-3)
    assert f"1 N under circle:1.0 stress the film to {largest:.3g} MPa at the centre" in stress_caution(FILM, TIP, 1.0)
    assert not stress_caution(FILM, TIP, 0.4)
