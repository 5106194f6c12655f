"""Charges of the imperfection modes, compared with differences of direct solves for a film between the grid nodes."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import InputError, SceneError
from isocharge.simulate import press, touch_charge
from isocharge.simulate.forward import film_modes
from isocharge.simulate.forward.film_family import FilmFamily
from isocharge.simulate.forward.film_modes import MODES, FilmModes
from isocharge.simulate.mechanics.stress import stress_rotation
from kept import kept

CONTACTS = np.array([[2.0, 1.0, 0.9], [-0.5, -1.5, 1.1]])
STEP = 0.02


def modes_on_a_small_grid(family, film):
    """Return the modes, solved on fewer grid nodes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(film_modes, "NODE_COUNTS", (3, 3, 3, 1, 1))
        return FilmModes.build(family, film)


@pytest.fixture(scope="module")
def family_and_film(film_family):
    """A family with its modes, and the sensor and probe of one of its films."""
    prior, family = film_family
    modes = kept(modes_on_a_small_grid, family, prior.sensor.film)
    family_with_modes = FilmFamily.from_arrays(replace(family, imperfections=modes).to_arrays())
    return family_with_modes, *prior.film(prior.draw(np.random.default_rng(3), 1)[0])


@pytest.mark.parametrize(
    ("mode", "changes"),
    [
        ("tension_difference", lambda step: {"deviator": (0.1 * step, 0.0)}),
        ("tension_shear", lambda step: {"deviator": (0.0, 0.1 * step)}),
        ("stiffness_x", lambda step: {"young_ratio": np.exp(step)}),
        ("stiffness_xy", lambda step: {"young_ratio": np.exp(step), "axis": 0.25 * np.pi}),
        ("poisson", lambda step: {"poisson": 0.34 + step}),
        ("oval_x", lambda step: {"oval": step}),
        ("oval_xy", lambda step: {"oval": step, "oval_axis": 0.25 * np.pi}),
    ],
    ids=[name for name in MODES if name not in ("d12", "crosstalk")],
)
def test_mechanical_modes_equal_differences_of_direct_solves(family_and_film, mode, changes):
    family, sensor, probe = family_and_film

    def charge(contact, step):
        film = replace(sensor.film, **changes(step))
        return touch_charge(replace(sensor, film=film), press(film, probe, tuple(contact[:2]), contact[2]))

    unit = 0.1 if mode.startswith("tension") else 1.0
    expected = [(charge(contact, STEP) - charge(contact, -STEP)) / (2.0 * STEP * unit) for contact in CONTACTS[:1]]
    jacobian = family.mode_map(sensor, probe, [mode]).mode_jacobian(CONTACTS[:1])[:, :, 0]
    assert np.abs(jacobian - expected).max() < 0.03 * np.abs(expected).max()


def test_d12_and_crosstalk_modes_equal_the_change_of_the_readout(family_and_film):
    """To first order, the mode d12 is a rotation of the piezoelectric axes."""
    family, sensor, probe = family_and_film
    sensor = replace(sensor, piezo=replace(sensor.piezo, d31=20.0, d32=2.0))
    film = family.forward_map(sensor, probe)
    jacobian = family.mode_map(sensor, probe, ["crosstalk", "d12"]).mode_jacobian(CONTACTS)
    d31, d32, double = np.array([20.0, 2.0, 0.0]) @ np.linalg.inv(stress_rotation(0.01))
    turned = replace(sensor, piezo=replace(sensor.piezo, d31=d31, d32=d32, d12=0.5 * double))
    wired = replace(sensor, calibration=replace(sensor.calibration, crosstalk=0.01))
    assert turned.piezo.d12 == pytest.approx(9.0 * np.sin(0.02), rel=1e-3)
    for column, (other, unit) in enumerate(((wired, 0.01), (turned, turned.piezo.d12))):
        change = family.forward_map(other, probe).charges(CONTACTS) - film.charges(CONTACTS)
        expected = change / unit
        np.testing.assert_allclose(jacobian[..., column], expected, atol=0.06 * np.abs(expected).max())


def test_mode_map_computes_only_the_requested_modes(family_and_film):
    family, sensor, probe = family_and_film
    assert family.mode_map(sensor, probe, ["crosstalk"]).fields is None
    assert family.mode_map(sensor, probe).mode_jacobian(CONTACTS).shape == (2, 3, len(MODES))
    with pytest.raises(SceneError, match="got wrinkles"):
        family.mode_map(sensor, probe, ["wrinkles"])
    with pytest.raises(SceneError, match="no modes"):
        replace(family, imperfections=None).mode_map(sensor, probe)


def test_reading_a_family_file_with_other_fields_raises_input_error(family_and_film):
    """The file lacks the fields of the oval clamp, like files of earlier versions."""
    arrays = family_and_film[0].to_arrays()
    for name in ("imperfections.parts", "imperfections.node_size"):
        fields = arrays[name].reshape(*arrays[name].shape[:-1], 7, -1)[..., :5, :]
        arrays[name] = fields.reshape(*fields.shape[:-2], -1)
    with pytest.raises(InputError, match="expected those of the 7 fields of tension, stiffness, poisson, oval"):
        FilmFamily.from_arrays(arrays)
