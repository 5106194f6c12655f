"""Friction of the presses of a calibration and side forces of contacts, against direct solves and random draws."""

from dataclasses import replace

import numpy as np
import pytest
from tests.benchmarks.measured_films import measured_presses

from isocharge.common.errors import SceneError
from isocharge.simulate import Domain, press, touch_charge
from isocharge.simulate.solver.friction import friction_force
from isocharge.train import calibrate
from isocharge.train.calibration.contact_error import ContactSensitivity, spread_contacts
from isocharge.train.calibration.nuisances import NuisanceEstimate
from isocharge.train.calibration.side_forces import SideForces
from isocharge.train.data.presses import draw_contacts
from kept import kept

DOMAIN = Domain(8.0, (0.05, 2.0))
COEFFICIENT = 0.2
PRETENSION = 1.0


class LinearSideForces:
    """Side forces whose effect on the charges is linear, in place of a map that is solved on a film."""

    electrodes = ("A", "B", "C", "D")

    def __init__(self):
        self.film = self
        self.per_newton = np.random.default_rng(3).normal(size=(4, 2))

    def charges(self, contact):
        return 400.0 * contact[:, 2:] * np.ones(4)

    def jacobian(self, contact):
        return np.broadcast_to(self.per_newton, (len(contact), 4, 2))

    def friction_charges(self, contact, coefficient):
        smooth_distance = np.sqrt((contact[:, :2] ** 2).sum(axis=1, keepdims=True) + 9.0)  # sticks near the centre
        inwards = -coefficient * contact[:, 2:] * contact[:, :2] / smooth_distance
        return np.einsum("ek,nk->ne", self.per_newton, inwards)


def sensitivity_of(contact) -> ContactSensitivity:
    """Return a sensitivity of which only the contacts and the dependence on the charges are used."""
    charge_gain = np.random.default_rng(4).normal(size=(len(contact), 3, 4))
    unused = np.zeros(0)
    return ContactSensitivity(contact, unused, unused, unused, unused, charge_gain)


def solved_charges(sensor, probe, contacts, coefficient):
    """Return the charges of contacts by direct solves, with friction on a vertical stage."""
    rows = []
    for x, y, force in contacts:
        solved = press(sensor.film, probe, (x, y), force)
        if coefficient > 0.0:
            side_force = friction_force(solved, coefficient)
            solved = press(sensor.film, probe, (x, y), force, side_force=side_force, start=solved)
        rows.append(touch_charge(sensor, solved))
    return np.array(rows)


def test_forces_of_spread_contacts_do_not_depend_on_the_direction():
    contact = spread_contacts(DOMAIN, 200)
    assert len(np.unique(contact[:, 2])) == 200
    assert np.hypot(contact[:, 0], contact[:, 1]).max() <= DOMAIN.radius
    sector = np.floor(np.arctan2(contact[:, 1], contact[:, 0]) / (0.25 * np.pi)).astype(int)
    for number in range(-4, 4):
        force = contact[sector == number, 2]
        assert force.min() < 0.1
        assert force.max() > 1.0


def test_side_forces_in_the_covariance_are_those_of_random_contacts():
    """Half of the contacts have the friction of the presses, and all have a side force of random direction."""
    contact = spread_contacts(DOMAIN, 3)
    sensitivity = sensitivity_of(contact)
    side_force_map = LinearSideForces()
    side_forces = SideForces(side_force_map, DOMAIN, NuisanceEstimate(0.2, 0.0), share=0.1)
    covariance = side_forces.contact_covariance(sensitivity)

    rng = np.random.default_rng(5)
    count = 40_000
    answered = 0.5 * side_force_map.friction_charges(contact, 0.2)
    has_friction = rng.random((count, 1, 1)) < 0.5
    angle = rng.uniform(0.0, 2.0 * np.pi, (count, 1))
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=2)
    side_force = 0.1 * contact[:, 2, None] * direction
    charge_error = has_friction * 2.0 * answered - answered + side_force @ side_force_map.per_newton.T
    shift = np.einsum("nie,cne->cni", sensitivity.charge_gain, charge_error)
    expected = np.einsum("cni,cnj->nij", shift, shift) / count
    np.testing.assert_allclose(covariance, expected, atol=0.03 * np.abs(expected).max())


def test_model_answers_for_half_of_the_friction():
    side_forces = SideForces(LinearSideForces(), DOMAIN, NuisanceEstimate(0.2, 0.02), share=0.0)
    contact = np.array([[4.0, 1.0, 0.3], [-2.0, 5.0, 1.0]])
    relative = LinearSideForces().friction_charges(contact, 0.2) / LinearSideForces().charges(contact)
    np.testing.assert_allclose(side_forces.charge_factor(contact), 1.0 + 0.5 * relative, atol=1e-4)


def test_negative_coefficient_of_friction_counts_as_none():
    contact = spread_contacts(DOMAIN, 3)
    side_forces = SideForces(LinearSideForces(), DOMAIN, NuisanceEstimate(-0.01, 0.02), share=0.0)
    np.testing.assert_array_equal(side_forces.charge_factor(contact), np.ones((3, 4)))
    assert not side_forces.contact_covariance(sensitivity_of(contact)).any()


def test_side_force_above_the_limit_is_refused():
    with pytest.raises(
        SceneError, match=r"side force: expected a share of the force from 0 to 0\.5, such as 0\.1, got 2"
    ):
        SideForces(LinearSideForces(), DOMAIN, NuisanceEstimate(0.0, 0.0), share=2.0)


@pytest.mark.parametrize("option", ["--friction", "--side-force"])
def test_side_force_options_without_presses_are_refused(refused, option):
    words = ("train", "calibrate", "--sensor", "four-25um-biaxial", "--next", 3, option, 0.2)
    refused(*words, message=f"{option} 0.2: expected PRESSES.csv")


@pytest.mark.slow
def test_calibration_finds_the_coefficient_of_friction_of_solved_presses(problem):
    """The presses and the contacts are solved one by one with the friction force of the stage."""
    rng = np.random.default_rng(62)
    sensor = replace(problem.sensor, film=replace(problem.sensor.film, pretension=PRETENSION))
    contact = draw_contacts(rng, problem.domain, 20)
    charge = kept(solved_charges, sensor, problem.probe, contact.tolist(), COEFFICIENT)
    read = contact.copy()
    read[:, :2] += 0.1 * rng.standard_normal((20, 2))
    read[:, 2] *= np.exp(0.01 * rng.standard_normal(20))
    presses = measured_presses(problem, read, problem.noise.add(charge, rng))

    result = calibrate(presses, replace(problem, friction=COEFFICIENT))
    friction = result.posterior.nuisances["friction"]
    assert friction.std < 0.05
    assert abs(friction.value - COEFFICIENT) < 3.0 * friction.std
    assert any("The coefficient of friction of the tip is" in sentence for sentence in result.summary)

    network = result.fitted_film(result.posterior.parameters)
    later = draw_contacts(rng, problem.domain, 20)
    for coefficient in (0.0, COEFFICIENT):
        charge = kept(solved_charges, sensor, problem.probe, later.tolist(), coefficient)
        answer, std, _ = network.predict(problem.noise.add(np.repeat(charge, 20, axis=0), rng))
        error = np.abs(answer - np.repeat(later, 20, axis=0))
        assert np.mean(error[:, :2] < 2.0 * std[:, :2]) > 0.85
