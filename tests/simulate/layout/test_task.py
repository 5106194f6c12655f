"""What is refused before the search begins, and maps of what matters."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import InputError, IsochargeError, SensorError
from isocharge.simulate import Calibration, DesignTask, Electrode, Polygon
from isocharge.simulate.layout.design import design
from isocharge.simulate.layout.goal import Goal
from isocharge.simulate.layout.placing import Zone


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"electrodes": 1}, "expected 3 to 8, got 1; one electrode gives one number"),
        ({"electrodes": 2}, "expected 3 to 8, got 2; two electrodes give two numbers"),
        ({"electrodes": 0}, "expected 3 to 8, got 0"),
        ({"electrodes": 9}, "expected 3 to 8, got 9"),
        ({"side": (40e-3, 40e-3)}, "4 new squares of 40 mm do not fit"),
        ({"zones": (Zone((0.0, 0.0), 44.5e-3),)}, "do not fit .* 1 keep-out zones"),
        ({"radius": 44.5e-3}, "leave the film of radius 45 mm"),
        ({"radius": -1e-3}, "radius: expected a positive number"),
        ({"forces": (1e4,)}, "beyond small strains"),
        ({"probes": (Polygon.rectangle(4e-3, 2e-3),)}, "round probes"),
        ({"keep": ("A", "A")}, "expected different names"),
        ({"keep": ("A", "B", "C", "D")}, "nothing to place"),
        ({"keep": ("A",), "zones": (Zone((10e-3, 0.0), 2e-3),)}, "electrode 'A' lies in a keep-out zone"),
        ({"gap": -1e-3}, "gap: expected a length from 0 mm"),
        ({"side": (3e-3, 2e-3)}, "side: expected 0 < MIN <= MAX"),
        ({"pretensions": (-1.0,)}, "pretension: expected a number from 0 MPa"),
        ({"symmetry": "3-fold", "electrodes": 5}, "expected a multiple of 3"),
        ({"forces": ()}, "at least one probe and one force"),
    ],
)
def test_impossible_tasks(sensor, changes, message):
    task = replace(DesignTask(sensor, 4, 8e-3), **changes)
    with pytest.raises(IsochargeError, match=message) as error:
        task.check()
    assert isinstance(error.value, InputError)


def test_an_electrode_near_the_rim_stays_whatever_zones_there_are(sensor):
    outer = replace(sensor, electrodes=(Electrode.of_square("A", (42e-3, 0.0), 3e-3), *sensor.electrodes[1:]))
    for zones in ((), (Zone((-20e-3, 0.0), 2e-3),)):
        DesignTask(outer, 4, 8e-3, keep=("A",), rim=3e-3, zones=zones).check()


def test_a_long_electrode_beside_a_zone_stays(sensor):
    strip = Electrode("A", ((9e-3, -1e-3), (21e-3, -1e-3), (21e-3, 1e-3), (9e-3, 1e-3)))
    beside = replace(sensor, electrodes=(strip, *sensor.electrodes[1:]))
    DesignTask(beside, 4, 8e-3, keep=("A",), zones=(Zone((15e-3, 5e-3), 3.5e-3),)).check()
    with pytest.raises(InputError, match="electrode 'A' lies in a keep-out zone"):
        DesignTask(beside, 4, 8e-3, keep=("A",), zones=(Zone((15e-3, 4e-3), 3.5e-3),)).check()


@pytest.mark.parametrize("changes", [{"keep": ("A",), "side": (2e-3, 2e-3)}, {"side": (2e-3, 4e-3)}])
def test_several_sides_with_the_edge_readout_are_refused_before_the_search(sensor, changes):
    task = DesignTask(replace(sensor, readout="edge"), 4, 8e-3, **changes)
    with pytest.raises(InputError, match=r"side: with the readout 'edge' all squares have one side.*got 2, (3|4) mm"):
        task.check()


def test_numbers_of_a_task_are_without_round_off(sensor):
    numbers = DesignTask(sensor, 4, 1e-3 * 8.2, side=(1e-3 * 2.3, 1e-3 * 4.1), zones=(Zone((0.0, 1.1e-3), 3e-3),))
    written = numbers.to_dict()
    assert written["radius_mm"] == 8.2
    assert written["side_mm"] == [2.3, 4.1]
    assert written["keep_out_mm"] == [[0.0, 1.1, 3.0]]
    assert DesignTask(sensor, 4, 8e-3).to_dict()["side_mm"] == [3.0, 3.0]


def test_a_zone_is_refused_in_millimetres():
    with pytest.raises(InputError, match=r"radius above 0 in mm, got \(0, 1.5\) and -3 mm"):
        Zone((0.0, 1.5e-3), -3e-3)


def test_electrodes_that_do_not_exist_or_are_calibrated(sensor):
    with pytest.raises(SensorError, match="no electrode 'Q'"):
        DesignTask(sensor, 4, 8e-3, keep=("Q",)).check()
    calibrated = replace(sensor, calibration=Calibration(rotation=0.1))
    with pytest.raises(InputError, match="is calibrated"):
        DesignTask(calibrated, 4, 8e-3, keep=("A",)).check()


def test_new_electrodes_have_free_names(sensor):
    task = DesignTask(sensor, 4, 8e-3, keep=("B", "D"))
    task.check()
    assert task.names == ("A", "C")
    made = task.layout(np.array([[20e-3, 0.0], [-20e-3, 0.0]]), np.array([3e-3, 3e-3]), "mine")
    assert made.electrode_names == ("A", "B", "C", "D")
    assert made.electrodes[1] == sensor.electrodes[1]


def test_a_map_of_what_matters(tmp_path):
    path = tmp_path / "map.csv"
    path.write_text("x_mm,y_mm,weight\n0,0,1\n10,0,0\n0,10,0\n")
    goal = Goal.of(str(path))
    assert goal.kind == "rms"
    assert goal.weigh(np.array([[0.0, 0.0], [5e-3, 0.0], [20e-3, 0.0]])) == pytest.approx([1.0, 0.5, 0.0])
    assert Goal.of("worst").weigh(np.zeros((2, 2))) == pytest.approx([1.0, 1.0])
    with pytest.raises(InputError, match="no place within the radius"):
        goal.weigh(np.array([[20e-3, 0.0]]))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y,w\n1,2,3\n", "expected the columns x_mm, y_mm, weight"),
        ("x_mm,y_mm,weight\n1,2\n", "row 2: expected three numbers"),
        ("x_mm,y_mm,weight\n1,2,-1\n", "row 2: expected finite numbers and a weight from 0"),
        ("x_mm,y_mm,weight\n1,2,nan\n", "row 2: expected finite"),
        ("x_mm,y_mm,weight\n\n1,2,3\n\n1,2,-1\n", "row 5: expected finite"),
        ("x_mm,y_mm,weight\n", "at least one place"),
        ("", "got nothing"),
    ],
)
def test_maps_that_cannot_be_read(tmp_path, text, message):
    path = tmp_path / "map.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        Goal.of(str(path))


def test_a_map_whose_file_is_called_worst_is_a_map(tmp_path):
    path = tmp_path / "worst"
    path.write_text("x_mm,y_mm,weight\n0,0,1\n")
    assert Goal.of(str(path)).kind == "rms"


def test_a_map_without_weight_within_the_radius_is_refused_before_anything_is_solved(sensor, tmp_path):
    path = tmp_path / "map.csv"
    path.write_text("x_mm,y_mm,weight\n0,0,0\n")

    def solve(*_):
        pytest.fail("solved before the map was looked at")

    with pytest.raises(InputError, match="no place within the radius has a weight"):
        design(sensor, 3, 4e-3, goal=str(path), map_jobs=solve)


def test_a_goal_that_is_none():
    with pytest.raises(InputError, match="expected 'worst', 'rms' or a CSV file"):
        Goal.of("best")
