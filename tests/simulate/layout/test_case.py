"""What can be asked: rules against distances by hand, goals, and what is refused before anything is solved."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import InputError
from isocharge.simulate import Calibration, Electrode, NoiseModel
from isocharge.simulate.layout.case import DesignCase, Nuisances, WeightMap, read_goal
from isocharge.simulate.layout.design import design


def test_rules_are_distances(sensor):
    """Squares of 2 mm: A stays at (10, 0) with a side of 3 mm."""
    case = DesignCase(sensor, 4, 8.0, keep=("A",), side=2.0)
    places = np.array([[14.0, 1.0], [-7.0, 43.0], [-7.0, 40.0]])
    by_rim, by_stay = 44.0 - np.hypot([15.0, 8.0, 8.0], [2.0, 44.0, 41.0]), [4.0 - 2.5 - 0.5, 40.0, 37.0]
    assert case.room(places) == pytest.approx(np.minimum(by_rim, by_stay))
    assert case.apart(places[1:2], places)[0] == pytest.approx([42.0 - 2.5, -2.5, 3.0 - 2.5])
    traced = sensor.electrodes[0].with_trace(((10.0, 0.0), (30.0, 0.0)), 0.5)
    case_of_trace = replace(case, sensor=replace(sensor, electrodes=(traced, *sensor.electrodes[1:])))
    assert case_of_trace.room(np.array([[20.0, 3.0], [14.0, -9.0]])) == pytest.approx([3.0 - 1.75, 9.0 - 3.0])
    assert case.spare(places) == pytest.approx([*case.room(places), 39.5, 36.5, 0.5])


def test_new_squares_are_named_anticlockwise_by_free_letters(sensor):
    case = DesignCase(replace(sensor, calibration=Calibration(rotation=0.1)), 4, 8.0)
    made = case.layout(np.array([[0.0, -5.0], [9.0, 1.0], [-9.0, 1.0], [0.0, 5.0]]))
    assert [e.centre for e in made.electrodes] == [(9.0, 1.0), (0.0, 5.0), (-9.0, 1.0), (0.0, -5.0)]
    assert made.calibration == Calibration()
    kept = DesignCase(sensor, 4, 8.0, keep=("B", "D")).layout(np.array([[-20.0, 0.0], [20.0, 0.0]]))
    assert (kept.electrode_names, kept.electrodes[1]) == (("A", "B", "C", "D"), sensor.electrodes[1])
    assert kept.electrodes[0].centre == pytest.approx((20.0, 0.0))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"electrodes": 2}, "expected 3 to 8, got 2; .* three unknowns"),
        ({"electrodes": 9}, "expected 3 to 8"),
        ({"radius": 44.5}, "leave the film of radius 45 mm"),
        ({"radius": -1.0}, "radius: expected a positive number"),
        ({"force": 1e4}, "beyond small strains"),
        ({"keep": ("A", "A")}, "expected different names"),
        ({"keep": ("A", "B", "C", "D")}, "nothing to place"),
        ({"keep": ("Q",)}, "no electrode 'Q'"),
        ({"gap": -1.0}, "gap: expected a length from 0 mm"),
        ({"side": 0.0}, "side: expected a length"),
        ({"noise": NoiseModel("mine", 0.0, 1e-3)}, "expected white noise above 0"),
        ({"goal": WeightMap("map.csv", np.array([[20.0, 0.0, 0.0]]))}, "no place within the radius"),
        ({"sensor": {"calibration": Calibration(rotation=0.1)}, "keep": ("A",)}, "is calibrated"),
        ({"sensor": {"readout": "edge"}, "keep": ("A",), "side": 2.0}, "all squares have one side"),
    ],
)
def test_impossible_cases(sensor, changes, message):
    with pytest.raises(InputError, match=message):
        DesignCase(
            **{"electrodes": 4, "radius": 8.0, **changes, "sensor": replace(sensor, **changes.get("sensor", {}))}
        )


def test_an_impossible_nuisance():
    with pytest.raises(InputError, match="pretension: expected a number from 0"):
        Nuisances(pretension=-1.0)


def test_squares_that_do_not_fit_are_refused_before_anything_is_solved(sensor):
    wall = replace(sensor, electrodes=(Electrode.of_square("A", (0.0, 0.0), 60.0),))
    for case in (DesignCase(sensor, 8, 8.0, side=30.0), DesignCase(wall, 4, 8.0, keep=("A",), side=20.0)):
        with pytest.raises(InputError, match="do not fit"):
            design(case)


def test_a_map_of_what_matters(tmp_path):
    path = tmp_path / "map.csv"
    path.write_text("\ufeffx_mm, y_mm, weight\n0,0,1\n10,0,0\n0,10,0\n")
    goal = read_goal(str(path))
    assert goal.weigh(np.array([[0.0, 0.0], [5.0, 0.0], [20.0, 0.0]])) == pytest.approx([1.0, 0.5, 0.0])
    assert goal.name == "map.csv"
    line = WeightMap("line", np.array([[1.0, 0.0, 2.0], [1.0, 10.0, 3.0]]))
    assert line.weigh(np.array([[5.0, 4.0], [1.0, 6.0]])).tolist() == [2.0, 3.0]  # nothing lies between them


@pytest.mark.parametrize(
    "text",
    ["x,y,w\n1,2,3\n", "x_mm,y_mm,weight\n1,2\n", "x_mm,y_mm,weight\n1,2,-1\n", "x_mm,y_mm,weight\n1,nan,1\n", ""],
)
def test_maps_that_cannot_be_read(tmp_path, text):
    path = tmp_path / "map.csv"
    path.write_text(text)
    for goal in (str(path), "best"):
        with pytest.raises(InputError, match=rf"goal '{goal}': expected 'worst', 'rms' or a CSV file x_mm,y_mm,weight"):
            read_goal(goal)
