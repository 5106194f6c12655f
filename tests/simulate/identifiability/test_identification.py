"""What the charges can tell, in numbers, and whether they tell size and shape."""

import json
from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import SceneError, SolveError
from isocharge.simulate import (
    ChargeFunction,
    ChargeSpline,
    Circle,
    Electrode,
    ForwardMap,
    Resolution,
    SolveSettings,
    Theory,
    load_sensor,
    noise_model,
)
from isocharge.simulate.identifiability.identification import identify, map_to_search, search_radius
from isocharge.simulate.identifiability.probe_discrimination import (
    explain_with_other_probe,
    inner_forces,
    radius_limits,
    size_limit,
    spread_contacts,
)

REFERENCE = noise_model("reference")
MEMBRANE = Theory(stretching=True, bending=False, pretensioned=False)


@pytest.fixture(scope="module")
def film():
    sensor = load_sensor("four-25um-uniaxial")
    return ForwardMap.build(
        sensor, Circle(2e-3), 5e-3, (0.05, 2.0), SolveSettings(theory=MEMBRANE, resolution=Resolution(4, 8, 4))
    )


@pytest.fixture(scope="module")
def identification(film):
    return identify(film, REFERENCE)


def sized(radius: float, tells: float = 0.1) -> ChargeFunction:
    """Charges of which the fourth goes with the probe's radius (m), so much per logarithm."""

    def charge(contact):
        x, y, force = contact.T
        told = 3.0 + tells * np.log(radius / 1e-3)
        columns = [3.0 + 300.0 * x, 3.0 + 300.0 * y, np.full(len(x), 3.0), np.full(len(x), told)]
        return 3e-10 * force[:, None] ** (2.0 / 3.0) * np.stack(columns, axis=1)

    return ChargeFunction(charge, 5e-3, (0.05, 2.0))


def test_numbers_are_ready_for_json(identification):
    numbers = json.loads(json.dumps(identification.to_dict(), allow_nan=False))
    assert numbers["probe"] == "circle:2.0"
    assert numbers["noise"] == {"name": "reference", "white_pC": 1.0, "gain": 0.002}
    assert numbers["working_area"]["radius_mm"] == 5.0
    assert numbers["working_area"]["why"] == "searched"
    assert numbers["working_area"]["fold_radius_mm"] is None
    assert [row["force_N"] for row in numbers["limits_in_working_area"]] == [0.05, 1.0, 2.0]
    assert len(numbers["by_distance"]["distance_mm"]) == len(numbers["by_distance"]["worst_position_mm_at_1_N"])


def test_summaries_are_ordered_and_fall_with_the_force(identification):
    rows = identification.to_dict()["limits_in_working_area"]
    for row in rows:
        assert 0.0 < row["position_median_mm"] <= row["position_rms_mm"] <= row["position_worst_mm"] < 1.0
        assert row["condition_worst"] >= 1.0
    assert rows[0]["position_rms_mm"] > 2.0 * rows[1]["position_rms_mm"] > rows[2]["position_rms_mm"]


def test_an_electrode_at_the_centre_leaves_a_small_area(film):
    """The area is smaller than the distance of the rings of the whole film."""
    places = ((0.0, 0.0), (8.66e-3, 5e-3), (-8.66e-3, 5e-3))
    electrodes = tuple(Electrode.of_square(name, at, 3e-3) for name, at in zip("ABC", places, strict=True))
    sensor = replace(load_sensor("three-25um-biaxial"), electrodes=electrodes)
    numbers = identify(replace(film, sensor=sensor), REFERENCE).to_dict()
    assert 0.0 < numbers["working_area"]["radius_mm"] < 0.5
    assert [row["force_N"] for row in numbers["limits_in_working_area"]] == [0.05, 1.0, 2.0]
    assert all(0.0 < row["position_median_mm"] <= 1.0 for row in numbers["limits_in_working_area"])


def test_where_nothing_is_determined_there_are_no_limits(film):
    assert identify(film, REFERENCE, error=1e-6).to_dict()["limits_in_working_area"] == []


@pytest.mark.parametrize("count", [1, 2])
def test_fewer_than_three_electrodes_are_refused(film, count):
    sensor = replace(film.sensor, electrodes=film.sensor.electrodes[:count])
    with pytest.raises(SceneError, match=f"at least three electrodes, got {count}"):
        identify(replace(film, sensor=sensor), REFERENCE)


def test_the_search_goes_over_the_electrodes_but_not_to_the_rim():
    sensor = load_sensor("three-25um-biaxial")
    assert search_radius(sensor, Circle(1e-3)) == pytest.approx(np.hypot(10.160254e-3, 6.5e-3))
    small = replace(sensor, film=replace(sensor.film, radius=14e-3))
    assert search_radius(small, Circle(1e-3)) == pytest.approx(9.5e-3)


def test_where_charges_are_too_rough_it_looks_less_far(monkeypatch):
    asked = []

    def build(_sensor, _probe, radius, *_, **__):
        asked.append(radius)
        if radius > 0.01:
            raise SolveError("interpolates to 0.001 only")
        return "a map"

    monkeypatch.setattr(ForwardMap, "build", build)
    assert map_to_search(load_sensor("three-25um-biaxial"), Circle(1e-3), (0.05, 2.0)) == "a map"
    assert asked == pytest.approx(12.0617e-3 * np.array([1.0, 0.9, 0.81]), rel=1e-4)
    monkeypatch.setattr(ForwardMap, "build", lambda *_, **__: build(None, None, 1.0))
    with pytest.raises(SolveError):
        map_to_search(load_sensor("three-25um-biaxial"), Circle(1e-3), (0.05, 2.0))


def test_the_size_is_told_as_well_as_its_charge():
    """The fourth charge alone tells the radius, the third the force: their errors over the slope, by hand."""
    contact = np.array([[0.0, 0.0, 1.0]])
    white = replace(REFERENCE, gain=0.0)
    limit = size_limit(sized(0.9e-3), sized(1e-3), sized(1.1e-3), white, contact)
    slope = 3e-11 * (np.log(1.1) - np.log(0.9)) / 0.2
    assert limit[0] == pytest.approx(np.sqrt(2.0) * 1e-12 / slope, rel=1e-4)


def test_what_no_charge_tells_is_not_told():
    limit = size_limit(*(sized(r, tells=0.0) for r in (0.9e-3, 1e-3, 1.1e-3)), REFERENCE, np.array([[0.0, 0.0, 1.0]]))
    assert limit[0] > 100.0


def test_taken_for_another_probe():
    contact = spread_contacts(3e-3, 1.0, 50)
    same, other = (explain_with_other_probe(sized(radius), sized(1e-3), REFERENCE, contact) for radius in (1e-3, 4e-3))
    assert same.sigmas == pytest.approx(0.0, abs=1e-3)
    assert same.shift == pytest.approx(0.0, abs=1e-8)
    assert (other.sigmas > 10.0).all()
    assert other.to_dict()["told_apart_share"] == 1.0
    assert same.to_dict()["told_apart_share"] == 0.0


def test_uniaxial_charges_tell_the_size_and_biaxial_ones_do_not(film):
    """Under a probe of 2 mm at 1 N; the maps are the same but for what the electrodes make of the stress."""
    sizes = [
        ForwardMap.build(
            film.sensor, Circle(r), 4e-3, (0.8, 1.2), SolveSettings(theory=MEMBRANE, resolution=film.resolution)
        )
        for r in (1.8e-3, 2e-3, 2.2e-3)
    ]
    limits = {}
    for name in ("four-25um-uniaxial", "four-25um-biaxial"):
        models = [ChargeSpline.of(replace(made, sensor=load_sensor(name)), spacing=2.5e-4) for made in sizes]
        limits[name] = size_limit(*models, REFERENCE, spread_contacts(4e-3, 1.0, 200))
    assert limits["four-25um-uniaxial"].max() < 0.2
    assert limits["four-25um-biaxial"].min() > 1.0


def test_size_needs_a_circle_and_four_charges(film, identification):
    three = replace(film, sensor=load_sensor("three-25um-biaxial"))
    with pytest.raises(SceneError, match="at least four charges for x, y, F and the radius, got 3"):
        radius_limits(three, identification.charges, REFERENCE, [1.0], 4e-3)


def test_forces_keep_off_the_ends():
    assert inner_forces((0.05, 2.0)) == pytest.approx([0.065, 1.0, 2.0 / 1.3])
    assert inner_forces((1.0, 1.1)) == pytest.approx([np.sqrt(1.1)])
