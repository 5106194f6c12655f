"""Charges of squares against presses that are solved one by one, and their derivatives against differences."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import InputError, SceneError
from isocharge.simulate import Circle, Electrode, Polygon, SolveSettings, load_sensor, press, touch_charge
from isocharge.simulate.layout.scene import DesignScene, Nuisances
from isocharge.simulate.layout.stress_table import settings_for

SIDE = 3e-3
CENTRES = np.array([[2e-3, 1e-3], [-7e-3, 4e-3], [0.5e-3, -12e-3]])
PRESSES = np.array([[0.7e-3, 0.2e-3], [-1.3e-3, 3.1e-3]])


def pressed_one_by_one(name, readout, at, force=1.0, radius=1e-3, pretension=0.0):
    """Touch charges of the three squares, from one solve."""
    sensor = load_sensor(name)
    squares = tuple(
        Electrode.of_square(label, (float(x), float(y)), SIDE) for label, (x, y) in zip("ABC", CENTRES, strict=True)
    )
    film = replace(sensor.film, pretension=pretension)
    sensor = replace(sensor, electrodes=squares, readout=readout, film=film)
    theory_and_mesh = settings_for(DesignScene(film, Circle(radius), force, 4e-3), SolveSettings(theory=FULL))
    return touch_charge(sensor, press(film, Circle(radius), tuple(map(float, at)), force, theory_and_mesh))


FULL = press(load_sensor("four-25um-biaxial").film, Circle(1e-3), (0.0, 0.0), 1.0).theory


@pytest.mark.first_cases(1)
@pytest.mark.parametrize(
    ("fixture", "name", "readout"),
    [
        ("charges", "four-25um-biaxial", "area"),
        ("uniaxial", "four-25um-uniaxial", "area"),
        ("edge", "four-25um-uniaxial", "edge"),
    ],
)
def test_rows_are_the_charges_of_presses_and_their_derivatives(request, fixture, name, readout):
    rows = request.getfixturevalue(fixture).under(PRESSES).layout(CENTRES, np.full(3, SIDE))
    for at, row in zip(PRESSES, rows, strict=True):
        step, grown = 5e-5, 0.05

        def charge(x=0.0, y=0.0, **changes):
            return pressed_one_by_one(name, readout, at + np.array([x, y]), **changes)  # noqa: B023

        expected = {
            0: (charge(), 1e-3),
            1: ((charge(x=step) - charge(x=-step)) / (2 * step), 0.05),
            2: ((charge(y=step) - charge(y=-step)) / (2 * step), 0.05),
            3: ((charge(force=np.exp(grown)) - charge(force=np.exp(-grown))) / (2 * grown), 1e-3),
            4: ((charge(radius=1.3e-3) - charge(radius=0.7e-3)) / 0.6e-3, 0.02),
            6: ((charge(pretension=1e5) - charge()) / 1e5, 1e-3),
        }
        for column, (values, tolerance) in expected.items():
            assert row[:, column] == pytest.approx(values, abs=tolerance * np.abs(values).max()), column


def test_the_profile_moves_the_load_outwards(charges):
    """To first order a punch acts like a larger probe: R^2 / 6 more second moment is 0.155 R more radius."""
    rows = charges.under(PRESSES).layout(CENTRES[1:], np.full(2, SIDE))
    assert rows[..., 5] == pytest.approx((np.sqrt(4.0 / 3.0) - 1.0) * 1e-3 * rows[..., 4], rel=0.25)


@pytest.mark.parametrize("fixture", ["charges", "uniaxial", "edge"])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_derivatives_by_the_square(request, fixture, axis):
    pressed, sides, step = request.getfixturevalue(fixture).under(PRESSES), np.full(3, SIDE), 4e-5
    moved, grown = step * np.eye(3)[axis, :2], step * float(axis == 2)
    ahead = pressed.layout(CENTRES + moved, sides + grown)
    change = (ahead - pressed.layout(CENTRES - moved, sides - grown)) / (2 * step)
    gradient = pressed.layout_gradient(CENTRES, sides)[..., axis]
    for column, tolerance in ((0, 0.03), (3, 0.03), (6, 0.03)):
        scale = np.abs(change[..., column]).max()
        assert gradient[..., column] == pytest.approx(change[..., column], abs=tolerance * scale), column


def test_an_electrode_of_any_shape_has_the_row_of_its_square(charges):
    square = Electrode.of_square("A", (2e-3, 1e-3), SIDE)
    pressed = charges.under(PRESSES)
    assert pressed.electrode(replace(square, square=False)) == pytest.approx(
        pressed.layout(CENTRES[:1], np.array([SIDE]))[:, 0], rel=0.02, abs=1e-13
    )


def test_impossible_scenes_are_refused(sensor):
    with pytest.raises(SceneError, match=r"round probes, got rectangle:4\.0x2\.0"):
        DesignScene.of(sensor.film, Polygon.rectangle(4e-3, 2e-3), 1.0, 4e-3)
    with pytest.raises(SceneError, match="leave the film of radius 45 mm"):
        DesignScene.of(sensor.film, Circle(1e-3), 1.0, 46e-3)
    with pytest.raises(InputError, match="nuisance gain: expected a number from 0"):
        Nuisances(gain=-1.0)
