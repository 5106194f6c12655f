"""Charges of the films of a prior: their derivatives, and the effect of an uneven tension."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.simulate import press, touch_charge
from isocharge.simulate.forward.film_modes import MODES
from isocharge.simulate.sensor.film_prior import SHARED
from isocharge.train.calibration.problem import COEFFICIENT_DRIFT_STD
from isocharge.train.data.presses import draw_contacts

STEP = 0.01
"""Step of the central differences, in standard deviations of a parameter."""


def test_derivatives_with_respect_to_parameters_and_contacts_equal_differences(layout):
    """Each derivative is compared with central differences of the charges of films that are built from parameters."""
    charges = layout.charges
    rng = np.random.default_rng(3)
    parameters = layout.prior.draw(rng, 1)[0]
    contact = draw_contacts(rng, layout.domain.within(7.0), 6)
    contact_derivative = charges.contact_slopes(parameters, contact)
    parameter_derivative = charges.unknown_slopes(parameters, contact, contact_derivative)
    largest_charge = np.abs(charges.charges(parameters, contact)).max(axis=1)[:, None]

    for index, std in enumerate(layout.prior.std):
        step = np.zeros_like(parameters)
        step[index] = STEP * std
        charge_above = charges.charges(parameters + step, contact)
        charge_below = charges.charges(parameters - step, contact)
        difference = (charge_above - charge_below) / (2.0 * STEP)
        np.testing.assert_allclose(
            parameter_derivative[:, :, index] / largest_charge, difference / largest_charge, atol=1e-3
        )

    expected = charges.forward_map(parameters).derivatives(contact)
    scale = largest_charge[:, :, None]
    np.testing.assert_allclose(contact_derivative / scale, expected / scale, atol=2e-3)


@pytest.mark.parametrize(
    ("names", "coefficients"),
    [(("pretension", "young", "thickness"), [1.5, -1.0, 1.5]), (SHARED, [0.0] * len(MODES) + [0.2, 0.9, -0.1] * 4)],
    ids=["modes", "traces"],
)
def test_derivatives_include_the_effect_of_parameters_on_modes_and_traces(problem, names, coefficients):
    charges = problem.charges
    rng = np.random.default_rng(4)
    contact = draw_contacts(rng, problem.domain.within(7.0), 6)
    unknowns = np.zeros(charges.layout.film_count)
    given = np.append(problem.before.parameters, coefficients)
    unknowns[: given.size] = given
    charge = charges.charges(unknowns, contact)
    derivative = charges.unknown_slopes(unknowns, contact, charges.contact_slopes(unknowns, contact))

    for index, name in enumerate(names):
        step = np.zeros_like(unknowns)
        step[index] = STEP * charges.prior.std[index]
        charge_above = charges.charges(unknowns + step, contact)
        charge_below = charges.charges(unknowns - step, contact)
        difference = (charge_above - charge_below) / (2.0 * STEP)
        np.testing.assert_allclose(derivative[:, :, index] / charge, difference / charge, atol=1e-3, err_msg=name)


@pytest.mark.parametrize("kind", ["modes", "traces"])
def test_derivatives_hold_for_coefficients_as_small_as_the_drift_since_an_earlier_calibration(problem, kind):
    """A calibration that is continued (`--from`) changes the coefficients by about `COEFFICIENT_DRIFT_STD`."""
    charges = problem.charges
    contact = draw_contacts(np.random.default_rng(6), problem.domain.within(7.0), 6)
    unknowns = np.zeros(charges.layout.film_count)
    unknowns[charges.layout.parameters] = problem.before.parameters
    charge = charges.charges(unknowns, contact)
    derivative = charges.unknown_slopes(unknowns, contact, charges.contact_slopes(unknowns, contact))

    small_coefficient = 0.25 * COEFFICIENT_DRIFT_STD
    first = getattr(charges.layout, kind).start
    for index in range(first, first + 3):
        step = np.zeros_like(unknowns)
        step[index] = small_coefficient
        charge_above = charges.charges(unknowns + step, contact)
        charge_below = charges.charges(unknowns - step, contact)
        difference = (charge_above - charge_below) / (2.0 * small_coefficient)
        assert np.abs(difference / charge).max() > 0.005
        np.testing.assert_allclose(derivative[:, :, index] / charge, difference / charge, atol=1e-4)


@pytest.mark.parametrize(("pretension", "force"), [(0.8, 0.2), (1.6, 0.1)])
def test_uneven_tension_changes_all_charges_to_second_order_like_a_lower_tension(problem, pretension, force):
    """The second difference of ln Q, averaged over the electrodes, is compared with that of direct solves."""
    charges = problem.charges
    parameters = np.append(pretension, problem.prior.mean[1:])
    sensor, probe = problem.prior.film(parameters)
    position = (2.0, 1.0)
    shear = 0.4 * pretension

    def solved_log_charge(film_shear: float) -> float:
        film = replace(sensor.film, deviator=(0.0, film_shear))
        charge = touch_charge(replace(sensor, film=film), press(film, probe, position, force))
        return float(np.log(charge).mean())

    def expanded_log_charge(film_shear: float) -> float:
        coefficients = np.zeros(charges.n_coefficient)
        coefficients[charges.modes.index("tension_shear")] = film_shear / MODES["tension_shear"].std
        unknowns = np.concatenate([parameters, coefficients])
        return float(np.log(charges.charges(unknowns, np.array([[*position, force]]))).mean())

    def second_difference(log_charge) -> float:
        return 0.5 * (log_charge(shear) + log_charge(-shear)) - log_charge(0.0)

    expected = second_difference(solved_log_charge)
    assert expected > 0.005
    assert second_difference(expanded_log_charge) == pytest.approx(expected, rel=0.15)
