"""What is divided out is exact: single solves of scaled films say so."""

import numpy as np
import pytest

from isocharge.simulate import press, touch_charge
from isocharge.train.films.conditional_network import FilmScaling

AT, FORCE = (3.0, -4.0), 0.3


def solved(prior, parameters, at, force):
    """Charges of one solve, pC."""
    sensor, probe = prior.film(parameters)
    return touch_charge(sensor, press(sensor.film, probe, at, force))


def changed(prior, **values):
    parameters = prior.mean.copy()
    for name, value in values.items():
        parameters[prior.names.index(name.replace("gain_", "gain "))] = value
    return parameters


@pytest.mark.parametrize(
    "film",
    [
        {"gain_B": 0.1},
        {"d31": 0.3, "d32": 0.3},
        {"young": 0.4, "pretension": 1.5 * np.exp(0.4)},
        {"rotation": 0.2},
        {"rotation": -0.1, "young": -0.2, "pretension": 1.5 * np.exp(-0.2), "d31": 0.1, "d32": 0.1, "gain_A": 0.05},
    ],
)
def test_charges_scale_and_places_rotate_exactly(films, film):
    """The film's charge is the mean film's at the place and force that it stands for, times the exact factors."""
    prior, scaling = films.prior, FilmScaling(films.prior, films.domain)
    parameters = changed(prior, **film)
    unit = scaling.domain.to_unit(np.array([[*AT, FORCE]]))
    x, y, force = scaling.domain.to_contact(scaling.to_film(parameters, unit))[0]
    factor = np.exp(scaling.log_charge_scale(parameters) - scaling.log_charge_scale(prior.mean))
    expected = factor * solved(prior, prior.mean, AT, FORCE)
    np.testing.assert_allclose(solved(prior, parameters, (x, y), force), expected, rtol=2e-4)


def test_thickness_scales_the_force_but_for_bending(films):
    """A twentieth thicker, the force a twentieth larger: what is left is the bending, some parts in a thousand."""
    prior, scaling = films.prior, films.scaling
    parameters = changed(prior, thickness=0.05)
    unit = scaling.domain.to_unit(np.array([[*AT, FORCE]]))
    force = scaling.domain.to_contact(scaling.to_film(parameters, unit))[0, 2]
    assert force == pytest.approx(FORCE * np.exp(0.05))
    np.testing.assert_allclose(solved(prior, parameters, AT, force), solved(prior, prior.mean, AT, FORCE), rtol=2e-3)


def test_the_electrodes_carry_the_place_along(films):
    """The frame in which the network works is the electrodes': they stand where `place` puts them."""
    prior, scaling = films.prior, films.scaling
    parameters = changed(prior, shift_x=0.4, shift_y=-0.2, rotation=0.1)
    sensor, _ = prior.film(parameters)
    centres = np.array([electrode.centre for electrode in prior.sensor.electrodes])
    units = np.column_stack([centres / scaling.domain.radius, np.zeros(len(centres))])
    moved = scaling.to_film(parameters, units)[:, :2] * scaling.domain.radius
    np.testing.assert_allclose(moved, sensor.calibration.place(centres), atol=1e-9)


def test_the_context_leaves_out_what_is_exact_but_for_its_scales(films):
    """Doubled coefficients and halved gains: nothing changes; the scales that noise and domain see are all there is."""
    prior, scaling = films.prior, films.scaling
    gains = {f"gain_{name}": -0.1 for name in prior.sensor.electrode_names}
    same = scaling.context(changed(prior, d31=0.1, d32=0.1, **gains)) - scaling.context(prior.mean)
    np.testing.assert_allclose(same, 0.0, atol=1e-12)
    louder = scaling.context(changed(prior, d31=0.1, d32=0.1)) - scaling.context(prior.mean)
    assert np.count_nonzero(np.abs(louder) > 1e-12) == 1


def test_the_context_is_standardised(films):
    context = films.scaling.context(films.prior.draw(np.random.default_rng(8), 4000))
    np.testing.assert_allclose(context.mean(axis=0), 0.0, atol=0.1)
    np.testing.assert_allclose(context.std(axis=0), 1.0, atol=0.1)
