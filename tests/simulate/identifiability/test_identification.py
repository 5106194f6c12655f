"""What the charges of a sensor determine, in numbers."""

import json
from dataclasses import replace

import numpy as np
import pytest
from tests.simulate.conftest import COARSE

from isocharge.common.errors import SceneError, SolveError
from isocharge.simulate import (
    Circle,
    ForwardMap,
    identify,
    load_sensor,
    noise_model,
    parse_probe,
)
from isocharge.simulate.identifiability.identification import Identification, map_to_search
from isocharge.simulate.plots.error_maps import identification_picture
from isocharge.simulate.plots.figure import COLOURS
from kept import kept
from solved_charges import with_squares
from whole_films import part_of

REFERENCE = noise_model("reference")
SENSOR = load_sensor("three-25um-biaxial")


@pytest.fixture(scope="module")
def film():
    return kept(ForwardMap.build, load_sensor("four-25um-uniaxial"), Circle(2.0), 4.0, (0.5, 2.0), COARSE)


@pytest.fixture(scope="module")
def identification(film):
    return Identification.of(film, REFERENCE)


def test_identification_to_dict_can_be_written_as_json(identification):
    turned = replace(identification, probe=parse_probe("rectangle:4.0x2.0@30"))
    numbers = json.loads(json.dumps(turned.to_dict(), allow_nan=False))
    assert numbers["probe"] == "rectangle:4.0x2.0@30"
    assert numbers["noise"] == {"name": "reference", "white_pC": 1.0, "gain": 0.002}
    area = numbers["working_area"]
    assert (area["radius_mm"], area["why"], area["fold_radius_mm"]) == (4.0, "searched", None)
    title = "four-25um-uniaxial, rectangle:4.0x2.0@30, noise reference"
    picture = identification_picture(turned)
    assert picture.get_suptitle() == title
    assert picture.axes[2].lines[0].get_color() == COLOURS[0]


def test_statistics_of_errors_that_equal_the_distance_are_those_of_a_disk(identification):
    """The rms and the median of the distance from the centre are 4 mm divided by the root of two."""
    limits = identification.inner_maps[1]
    distance = np.linalg.norm(limits.rings.position, axis=2)
    numbers = replace(limits, position=distance, relative_force=distance).statistics()
    assert numbers["position_rms_mm"] == pytest.approx(8.0**0.5, rel=1e-4)
    assert (numbers["force_N"], numbers["position_median_mm"]) == pytest.approx((1.0, 8.0**0.5), abs=0.04)


def test_working_area_with_an_electrode_at_the_centre_is_small(film):
    """The area is smaller than the spacing of the rings on the whole film."""
    sensor = with_squares(SENSOR, (0.0, 0.0), (8.66, 5.0), (-8.66, 5.0))
    numbers = Identification.of(part_of(film, sensor, 2.0, (0.5, 2.0)), REFERENCE).to_dict()
    assert 0.0 < numbers["working_area"]["radius_mm"] < 0.5
    assert all(0.0 < row["position_median_mm"] <= 1.0 for row in numbers["limits_in_working_area"])


def test_identify_without_noise_or_electrodes_raises_before_the_film_is_solved():
    with pytest.raises(SceneError, match="at least three electrodes, got 2"):
        identify(replace(SENSOR, electrodes=SENSOR.electrodes[:2]))


def test_search_radius_is_reduced_if_charges_cannot_be_interpolated(monkeypatch):
    asked = []

    def build(_sensor, _probe, radius, *_, **__):
        asked.append(radius)
        if radius > 10.0:
            raise SolveError("interpolates to 0.001 only")
        return "a map"

    monkeypatch.setattr(ForwardMap, "build", build)
    assert map_to_search(SENSOR, Circle(1.0), (0.05, 2.0)) == "a map"
    assert asked == pytest.approx(12.0617 * np.array([1.0, 0.9, 0.81]), rel=1e-4)


def test_probe_without_room_to_move_raises_scene_error():
    with pytest.raises(SceneError, match=r"circle:41\.0: .* less than 40\.5 mm"):
        identify(SENSOR, Circle(41.0))
