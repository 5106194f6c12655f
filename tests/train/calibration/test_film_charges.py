"""Charges of the films of a prior: their derivatives, and the effect of an uneven tension."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.simulate import press, touch_charge
from isocharge.simulate.forward.film_modes import MODES
from isocharge.simulate.sensor.film_prior import SHARED
from isocharge.train.data.presses import draw_contacts


def test_derivatives_are_those_of_the_charges(layout):
    """Every column against central differences of the forward map of a film built from its parameters."""
    charges = layout.charges
    rng = np.random.default_rng(3)
    parameters = layout.prior.draw(rng, 1)[0]
    at = draw_contacts(rng, layout.domain.within(7.0), 6)
    by_contact = charges.by_contact(parameters, at)
    by_parameter = charges.by_parameter(parameters, at, by_contact)
    size = np.abs(charges.charges(parameters, at)).max(axis=1)[:, None]
    for number, std in enumerate(layout.prior.std):
        step = np.zeros_like(parameters)
        step[number] = 0.01 * std
        change = charges.charges(parameters + step, at) - charges.charges(parameters - step, at)
        np.testing.assert_allclose(by_parameter[:, :, number] / size, change / 0.02 / size, atol=1e-3)
    by_map = charges.forward_map(parameters).derivatives(at)
    np.testing.assert_allclose(by_contact / size[:, :, None], by_map / size[:, :, None], atol=2e-3)


@pytest.mark.parametrize(
    ("names", "besides"),
    [(("pretension", "young", "thickness"), [1.5, -1.0, 1.5]), (SHARED, [0.0] * len(MODES) + [0.2, 0.9, -0.1] * 4)],
    ids=["modes", "traces"],
)
def test_derivatives_contain_what_a_parameter_does_to_the_rest(problem, names, besides):
    charges = problem.charges
    rng = np.random.default_rng(4)
    film = problem.before.parameters
    at = draw_contacts(rng, problem.domain.within(7.0), 6)
    unknowns = np.pad(np.append(film, besides), (0, charges.n_coefficient - len(besides)))
    size = charges.charges(unknowns, at)
    found = charges.by_parameter(unknowns, at, charges.by_contact(unknowns, at))
    for number, name in enumerate(names):
        change = np.pad(0.01 * np.diag(charges.prior.std)[number], (0, charges.n_coefficient))
        expected = (charges.charges(unknowns + change, at) - charges.charges(unknowns - change, at)) / 0.02
        np.testing.assert_allclose(found[:, :, number] / size, expected / size, atol=1e-3, err_msg=name)


@pytest.mark.parametrize(("pretension", "force"), [(0.8, 0.2), (1.6, 0.1)])
def test_an_uneven_tension_acts_as_a_lower_one(problem, pretension, force):
    """To second order on all charges alike: against full solves, where first order gives nothing."""
    charges = problem.charges
    at = np.array([[2.0, 1.0, force]])
    parameters = np.append(pretension, problem.prior.mean[1:])
    solved = []
    known = []
    sensor, probe = problem.prior.film(parameters)
    for share in (0.0, 0.4, -0.4):
        uneven = replace(sensor, film=replace(sensor.film, deviator=(0.0, share * pretension)))
        modes = np.zeros(charges.n_coefficient)
        modes[charges.modes.index("tension_shear")] = share * pretension / MODES["tension_shear"].std
        solved.append(np.log(touch_charge(uneven, press(uneven.film, probe, (2.0, 1.0), force))).mean())
        known.append(np.log(charges.charges(np.concatenate([parameters, modes]), at)).mean())
    second = [0.5 * (values[1] + values[2]) - values[0] for values in (solved, known)]
    assert second[0] > 0.005
    assert second[1] == pytest.approx(second[0], rel=0.15)
