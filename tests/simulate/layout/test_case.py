"""Design cases: distance rules, and errors that are raised before the film is solved."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import InputError
from isocharge.simulate import Calibration, Electrode, Finger, NoiseModel
from isocharge.simulate.layout.case import DesignCase, Nuisances
from isocharge.simulate.layout.design import _solve_forward_map, design
from solved_charges import with_film


def test_clearances_are_distances_from_rim_kept_electrodes_and_other_squares(sensor):
    """The new squares have a side of 2 mm. A is kept at (10, 0) and has a side of 3 mm."""
    case = DesignCase(sensor, 4, 8.0, keep=("A",), side=2.0)
    places = np.array([[14.0, 1.0], [-7.0, 43.0], [-7.0, 40.0]])
    from_rim = 44.0 - np.hypot([15.0, 8.0, 8.0], [2.0, 44.0, 41.0])
    from_kept = [4.0 - 2.5 - 0.5, 40.0, 37.0]
    assert case.new_count == len(places)
    assert case.clearance(places) == pytest.approx(np.minimum(from_rim, from_kept))
    assert case.pair_clearance(places[1:2], places)[0] == pytest.approx([42.0 - 2.5, -2.5, 3.0 - 2.5])
    traced = sensor.electrodes[0].with_trace(((10.0, 0.0), (30.0, 0.0)), 0.5)
    case_of_trace = replace(case, sensor=replace(sensor, electrodes=(traced, *sensor.electrodes[1:])))
    assert case_of_trace.clearance(np.array([[20.0, 3.0], [14.0, -9.0]])) == pytest.approx([3.0 - 1.75, 9.0 - 3.0])
    assert case.all_clearances(places) == pytest.approx([*case.clearance(places), 39.5, 36.5, 0.5])


def test_new_squares_are_named_anticlockwise_with_unused_letters(sensor):
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
        ({"radius": 44.5}, "leave the film of radius 45 mm"),
        ({"force": 1e4}, "beyond small strains"),
        ({"keep": ("A", "A")}, "expected different names"),
        ({"keep": ("Q",)}, "no electrode 'Q'"),
        ({"side": 3000.0}, "side: expected 0.02 to 62.2254 mm, got 3000 mm"),
        ({"probe": Finger(3.0)}, "expected circle:RADIUS, .* got finger:3.0"),
        ({"noise": NoiseModel("mine", 0.0, 1e-3)}, "expected white noise above 0"),
        ({"goal": "best"}, "goal: expected worst or rms, got 'best'"),
        ({"sensor": {"calibration": Calibration(rotation=0.1)}, "keep": ("A",)}, "is calibrated"),
        ({"sensor": {"readout": "edge"}, "keep": ("A",), "side": 2.0}, "all squares have one side"),
    ],
)
def test_impossible_design_case_raises_input_error(sensor, changes, message):
    with pytest.raises(InputError, match=message):
        DesignCase(
            **{"electrodes": 4, "radius": 8.0, **changes, "sensor": replace(sensor, **changes.get("sensor", {}))}
        )


def test_new_squares_have_the_side_of_pads_with_traces(sensor):
    pad = Electrode.of_square("A", (10.0, 0.0), 5.0).with_trace(((10.0, 0.0), (30.0, 0.0)), 0.5)
    traced = replace(sensor, electrodes=(pad, *sensor.electrodes[1:]))
    assert DesignCase(traced, 5, 8.0, keep=("A",)).square_side == pytest.approx(5.0)


def test_negative_nuisance_raises_input_error():
    with pytest.raises(InputError, match="pretension: expected at least 0, got -1"):
        Nuisances(pretension=-1.0)


def test_squares_that_do_not_fit_raise_input_error_before_the_film_is_solved(sensor):
    wall = replace(sensor, electrodes=(Electrode.of_square("A", (0.0, 0.0), 60.0),))
    for case in (DesignCase(sensor, 8, 8.0, side=30.0), DesignCase(wall, 4, 8.0, keep=("A",), side=20.0)):
        with pytest.raises(InputError, match="found no layout"):
            design(case)


def test_folds_of_a_film_that_the_default_forces_stretch_too_far_cannot_be_searched(sensor):
    """A force of 0.2 N is possible on this soft film, but 2 N stretch it beyond small strains."""
    soft = with_film(sensor, young=100.0, radius=20.0)
    with pytest.raises(InputError, match="force 2 N stretches a film"):
        _solve_forward_map(DesignCase(soft, 4, 6.0, force=0.2), None)
