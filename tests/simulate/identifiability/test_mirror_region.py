"""Presses outside the working area that have the charges of a press inside it."""

import re
from dataclasses import replace

import numpy as np
import pytest

from function_map import FunctionMap
from isocharge.common.contact_domain import Domain
from isocharge.simulate import Circle, load_sensor, noise_model
from isocharge.simulate.identifiability.mirror_region import MirrorRegion, has_mirror, mirror_region
from isocharge.simulate.identifiability.nearest_contact import search
from solved_charges import with_film
from whole_films import whole_film_map_solved_once

SENSOR = load_sensor("four-25um-biaxial")
PROBE = Circle(1.0)
NOISE = noise_model("reference")
FORCES = (0.05, 2.0)
CIRCLE = 10.0 * np.exp(2j * np.pi * np.arange(4) / 4)
"""Four electrodes on a circle of 10 mm, as x + iy."""


def inverse_distance_map(electrodes, radius):
    """Return a map whose charges are the force divided by the distance between electrode and press, times a constant.

    Inversion in a circle about the origin divides the distances from all points of the circle by the same factor. If
    all electrodes lie on the circle of 10 mm, a press at the distance r with the force F has therefore exactly the same
    charges as a press at 100 / r with the force 10 F / r.
    """

    def charges(contact):
        z = contact[:, 0] + 1j * contact[:, 1]
        return 1000.0 * contact[:, 2:] / np.abs(z[:, None] - electrodes)

    return FunctionMap(charges, tuple("ABCDE"[: len(electrodes)]), Domain(radius, FORCES))


def region_of(electrodes):
    return MirrorRegion.of(inverse_distance_map(electrodes, 8.0), 8.0, inverse_distance_map(electrodes, 40.0), NOISE)


def test_electrodes_on_one_circle_mirror_the_film_by_inversion():
    region = region_of(CIRCLE)
    distance = 0.5 * (region.edges[1:] + region.edges[:-1])
    is_inside = 100.0 / distance < 7.8
    is_outside = 100.0 / distance > 8.3
    assert is_inside.sum() > 20
    assert (region.share[is_inside] >= 0.8).all()  # the lightest press has an image below 0.05 N far outside
    assert (region.share[is_outside] == 0.0).all()
    share_of_area = (40.0**2 - (100.0 / 8.0) ** 2) / (40.0**2 - 8.0**2)
    assert region.total_share == pytest.approx(share_of_area, abs=0.08)
    assert f"{100.0 * region.total_share:.2g} % have the charges of a press in the working area" in region.summary


def test_an_electrode_at_another_radius_removes_the_mirror_region():
    region = region_of(np.append(CIRCLE, 0.0))
    assert region.total_share == 0.0
    assert "differ from those of every press in the working area" in region.summary


def test_a_press_at_20_mm_on_the_film_has_the_charges_of_one_at_5_mm(three_map):
    """The mirror image in the circle of 10 mm is at R^2 / r = 5 mm. On the film, it is at 5.2 mm, with 0.24 N."""
    inside = replace(three_map, sensor=SENSOR)
    coarse = whole_film_map_solved_once(SENSOR, PROBE, FORCES)
    charge = coarse.charges(np.array([[20.0, 0.0, 0.5], [0.0, -20.0, 0.5], [10.2, 0.0, 0.5]]))
    contact, _ = search(inside, charge[:1], NOISE.sigma(charge[:1]), candidates=512)
    assert (np.abs(contact - [5.2, 0.0, 0.24]) < [0.15, 0.15, 0.01]).all()
    assert has_mirror(inside, charge, NOISE).tolist() == [True, True, False]


def test_a_film_without_a_working_area_has_no_mirror_region():
    charges = inverse_distance_map(CIRCLE, 8.0)
    assert mirror_region(SENSOR, PROBE, charges, 0.0, NOISE) is None
    assert mirror_region(SENSOR, PROBE, charges, 43.5, NOISE) is None


def test_a_slack_film_that_wrinkles_has_no_mirror_region_and_logs_a_warning(caplog, monkeypatch):
    monkeypatch.setattr("isocharge.simulate.solver.newton.MAX_ITERATIONS", 6)  # no number of steps suffices
    slack = with_film(SENSOR, pretension=-2.0)
    assert mirror_region(slack, PROBE, inverse_distance_map(CIRCLE, 8.0), 8.0, NOISE) is None
    assert re.search("the mirror region outside 8 mm is not computed: no equilibrium at .* wrinkles", caplog.text)
