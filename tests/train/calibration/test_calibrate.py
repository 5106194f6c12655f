"""Tests of a calibration: the fit of a film, its remaining errors, its sentences, and presses that are refused."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2
from tests.benchmarks.measured_films import measured_presses
from tests.train.calibration.conftest import add_discrepancy, rig

from isocharge.common.contact_errors import position_error
from isocharge.common.errors import ModelError, PressError, SceneError
from isocharge.common.statistics import rms
from isocharge.simulate import Circle, Polygon, load_sensor, press, touch_charge
from isocharge.simulate.sensor.sensor_file import sensor_from_dict, sensor_to_dict
from isocharge.simulate.solver.stress_limit import largest_stress
from isocharge.train import CalibrationProblem, calibrate, next_presses
from isocharge.train.calibration import hypotheses
from isocharge.train.calibration.contact_error import ContactSensitivity, fisher_information
from isocharge.train.calibration.contacts import from_log_contact
from isocharge.train.calibration.film_fit import fit_film
from isocharge.train.calibration.press_data import PressData
from isocharge.train.data.presses import draw_contacts
from isocharge.train.films.films_model import AddedCovariance

PRETENSION = 0
"""Index of the pretension among the parameters of a film."""

pytestmark = pytest.mark.usefixtures("no_closed_backs")


def press_data(problem, presses) -> PressData:
    """Return presses in the form of the least-squares fit."""
    return PressData.from_presses(presses, problem.noise, problem.charges.domain)


def fit(problem, presses):
    """Return the estimate of the film from presses."""
    return fit_film(problem.charges, press_data(problem, presses), problem.before)


@pytest.mark.first_cases(1)
@pytest.mark.parametrize(("count", "seed"), [(4, 11), (6, 2)], ids=["inside", "on a bound"])
def test_fit_is_the_minimum_over_parameters_and_contacts(count, seed, problem, monkeypatch):
    """SciPy minimises over parameters and contacts together, with finite differences, and finds the same film."""
    monkeypatch.setattr(hypotheses, "hypotheses", lambda: [hypotheses.Hypothesis()])
    charges = problem.charges
    prior = problem.prior
    n_parameter = len(prior.names)
    _, presses = rig(problem, count, seed=seed)
    data = press_data(problem, presses)
    posterior = fit(problem, presses)

    def residual(unknowns):
        """Return the residuals of charges, rig and prior.

        Args:
            unknowns: Parameters in units of their standard deviations, and then the contacts (x, y, ln F).
        """
        scaled_parameters, flat_contact = np.split(unknowns, [n_parameter])
        parameters = scaled_parameters * prior.std
        contact = flat_contact.reshape(-1, 3)
        charge_residual = data.weight * (charges.charges(parameters, from_log_contact(contact)) - data.charge)
        rig_residual = data.contact_weight * (contact - data.contact)
        prior_residual = (parameters - prior.mean) / prior.std
        return np.concatenate([charge_residual.ravel(), rig_residual.ravel(), prior_residual])

    lower, upper = prior.bounds
    contact_bound = np.full(data.contact.size, 50.0)
    bounds = (
        np.concatenate([lower / prior.std, -contact_bound]),
        np.concatenate([upper / prior.std, contact_bound]),
    )
    start = np.concatenate([prior.mean / prior.std, data.contact.ravel()])
    solution = least_squares(residual, start, bounds=bounds, x_scale="jac", xtol=1e-9, ftol=1e-9, diff_step=1e-4)
    std = np.sqrt(np.diag(posterior.covariance))
    expected_parameters = solution.x[:n_parameter]
    assert (np.abs(posterior.parameters / prior.std - expected_parameters) < 0.1 * std).all()
    expected_covariance = np.linalg.inv(solution.jac.T @ solution.jac)
    expected_std = np.sqrt(np.diag(expected_covariance))[:n_parameter]
    np.testing.assert_allclose(std, expected_std, rtol=0.05)


def test_estimate_of_a_film_without_imperfections_has_no_coefficients_of_modes_and_traces(problem):
    """Otherwise, the modes would be computed for every network of the calibrated film, which is slow."""
    _, presses = rig(problem, 20, seed=41)
    posterior = fit(problem, presses)
    layout = problem.charges.layout
    assert not posterior.unknowns[layout.imperfections].any()
    assert (np.diag(posterior.joint)[layout.modes] > 0.0).all()  # the modes remain uncertain


def calibrate_changed(problem, change, count, seed):
    """Draw a film, and calibrate it by presses with changed charges.

    Args:
        problem: The films.
        change: Function from contacts and charges to the changed charges.
        count: Number of presses.
        seed: Seed of film and presses.

    Returns:
        The true parameters, and the calibration.
    """
    truth, presses = rig(problem, count, seed)
    changed_charge = change(presses.contact, presses.charge_pC)
    return truth, calibrate(measured_presses(problem, presses.contact, changed_charge), problem)


def unchanged(contact, charge):
    """Return the charges."""
    del contact
    return charge


def position_error_by_film_mm(network, problem, truth, change=unchanged):
    """Compute the position error of a network that is caused by its wrong film, as a root mean square.

    The contacts are compared with those of the network of the true film, for charges with the same noise.

    Args:
        network: The network.
        problem: The films.
        truth: Parameters of the true film.
        change: Function from contacts and charges to the charges that the network gets.
    """
    contact = draw_contacts(np.random.default_rng(8), problem.domain.within(6.0), 400)
    charge = problem.noise.add(problem.charges.charges(truth, contact), np.random.default_rng(9))
    given_contact, _, _ = network.predict(change(contact, charge))
    expected_contact, _, _ = problem.films.fold(truth).predict(charge)
    return rms(position_error(given_contact, expected_contact))


def test_imperfections_of_a_film_are_estimated(problem):
    """The film has an uneven pretension, a stiffer axis and an oval clamp, which are described by modes."""
    seed = 31
    truth, _ = rig(problem, 1, seed)
    coefficients = np.zeros(problem.charges.n_coefficient)
    coefficients[: len(problem.charges.modes)] = [1.2, 0.5, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    unknowns = np.concatenate([truth, coefficients])

    def imperfect(contact, charge):
        return charge * problem.charges.factor(unknowns, problem.charges.into_domain(contact))

    _, result = calibrate_changed(problem, imperfect, 20, seed)
    assert result.posterior.probability("modes") > 0.9
    contact = draw_contacts(np.random.default_rng(3), problem.domain.within(6.0), 200)
    true_charge = imperfect(contact, problem.charges.charges(truth, contact))
    remaining_log_error = np.log(problem.charges.charges(result.posterior.unknowns, contact) / true_charge)
    imperfection = np.log(imperfect(contact, np.ones((200, 4))))
    assert rms(remaining_log_error) < 0.4 * rms(imperfection)


def test_errors_that_no_parameter_describes_are_corrected_and_reported(problem, film_with_discrepancy):
    truth, result = film_with_discrepancy
    error_mm = position_error_by_film_mm(result.fitted, problem, truth, add_discrepancy)
    assert 0.5 < result.film_error.position_mm / error_mm < 2.0

    contact = draw_contacts(np.random.default_rng(3), problem.domain.within(6.0), 200)
    charge = add_discrepancy(contact, problem.charges.charges(truth, contact))
    corrected_contact, _, _ = result.fitted.predict(charge)
    uncorrected_contact, _, _ = problem.films.fold(result.posterior.parameters).predict(charge)
    corrected_error_mm = position_error(corrected_contact, contact).mean()
    assert corrected_error_mm < 0.6 * position_error(uncorrected_contact, contact).mean()

    summary = " ".join(result.summary)
    assert re.search(r"charges of this film differ from those of its parameters by \d", summary)
    assert re.search(r"30 more presses would reduce it to 0\.\d+ mm", summary)


def test_rotated_stage_is_named(problem):
    """The stage is rotated by 8 degrees, in addition to the rotation of the electrodes by up to 2 degrees."""
    truth, presses = rig(problem, 8, seed=43)
    angle = np.copysign(np.deg2rad(8.0), truth[problem.prior.index("rotation")])
    cos, sin = np.cos(angle), np.sin(angle)
    rotated = presses.contact @ np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    cautions = calibrate(measured_presses(problem, rotated, presses.charge_pC), problem).cautions
    assert any(
        re.search(r"difference from the sensor file: rotation; .* axes of the stage", message) for message in cautions
    )


@pytest.mark.first_cases(1)
@pytest.mark.parametrize(
    ("change", "caution"),
    [
        (lambda _, charge: charge + 30.0, r"the charges are (29|30|31) \+- \S+ pC too large"),
        (
            lambda _, charge: charge * np.linspace(1.0, 1.2, len(charge))[:, None],
            r"the charges are (1[6-9]|20) \+- \S+ % larger at the end",
        ),
    ],
    ids=["offset", "drift"],
)
def test_offset_or_drift_of_the_charges_is_subtracted_and_reported(problem, change, caution):
    """The offset comes from a wrong tare, and the drift from an amplifier.

    Without the subtraction, the errors would be three times as large as reported.
    """
    truth, result = calibrate_changed(problem, change, 8, seed=42)
    assert any(re.search(caution, sentence) for sentence in result.cautions)
    network = problem.films.fold(result.posterior.parameters)
    assert position_error_by_film_mm(network, problem, truth) < 2.0 * result.film_error.position_mm < 0.4


def test_random_leak_of_the_charges_is_reported_and_increases_the_force_error(problem):
    """Each press loses 0 to 10 % of its charges. The mean loss of 5 % cannot be distinguished from wrong gains."""
    remaining = np.exp(-0.1 * np.random.default_rng(4).random((10, 1)))
    truth, result = calibrate_changed(problem, lambda _, charge: remaining * charge, 10, seed=44)
    assert any(re.search(r"the forces scatter by [2-9](\.\d)? % about", sentence) for sentence in result.cautions)
    contact = draw_contacts(np.random.default_rng(8), problem.domain.within(6.0), 200)
    charge = problem.charges.charges(truth, contact)
    estimated_contact, _, _ = problem.films.fold(result.posterior.parameters).predict(charge)
    error_percent = 100.0 * rms(estimated_contact[:, 2] / contact[:, 2] - 1.0)
    assert 2.0 < error_percent < 2.5 * result.film_error.force_percent


@pytest.mark.slow  # in `make test`, the covariance is compared with that of SciPy's fit
def test_parameters_deviate_as_their_covariance_states(layout):
    """The squared Mahalanobis distances of the true films add up to a value of a chi-squared distribution."""
    total = 0.0
    count = 0
    for seed in range(3):
        truth, presses = rig(layout, 8, seed=100 + seed)
        posterior = fit(layout, presses)
        assert not posterior.bad.any()
        deviation = (posterior.parameters - truth) / layout.prior.std
        total += float(deviation @ np.linalg.solve(posterior.covariance, deviation))
        count += truth.size
    assert chi2.ppf(0.001, count) < total < chi2.ppf(0.999, count)


@pytest.mark.slow  # in `make test`, wrong presses are found by the tests of cross-validation and of sessions
@pytest.mark.parametrize("row", [0, 4])
def test_bad_press_is_left_out_and_hardly_changes_the_film(problem, row):
    _, presses = rig(problem, 10, seed=21)
    expected = fit(problem, presses)
    presses.charge_pC[row] *= [1.0, 1.3, 1.0, 1.0]
    posterior = fit(problem, presses)
    assert np.flatnonzero(posterior.bad).tolist() == [row]
    std = np.sqrt(np.diag(expected.covariance))
    change = (posterior.parameters - expected.parameters) / problem.prior.std
    assert np.abs(change / std).max() < 1.2


@pytest.mark.slow  # in `make test`, errors are compared with a new film by the tests of sessions and of held-out errors
def test_error_by_the_film_is_near_the_linearised_limit(layout):
    """The ratio to the limit at the true film is at most 1.25 in the median, and at most 2.5 for each film."""
    ratios = []
    for seed in range(3):
        truth, presses = rig(layout, 8, seed=200 + seed)
        result = calibrate(presses, layout)
        sensitivity = ContactSensitivity.for_film(layout, truth)
        information = np.eye(truth.size) + fisher_information(layout, truth, presses.contact).sum(axis=0)
        limit = sensitivity.contact_error(np.linalg.inv(information))
        deviation = (result.posterior.parameters - truth) / layout.prior.std
        contact_error = sensitivity.contact_jacobian @ deviation
        position_error_mm = rms(np.hypot(contact_error[:, 0], contact_error[:, 1]))
        ratios.append(position_error_mm / limit.position_mm)
    assert np.median(ratios) < 1.25
    assert max(ratios) < 2.5


def test_summary_names_identified_and_unidentified_quantities(problem):
    truth, presses = rig(problem, 12, seed=1)
    result = calibrate(presses, problem)
    table = result.quantities
    assert all(table[name].identified for name in ("pretension_MPa", "response_percent", "gain_A_percent"))
    assert not any(table[name].identified for name in ("young_percent", "thickness_percent"))
    _, identified, unidentified, combination = result.summary[:4]
    assert "Young's modulus alone" in unidentified.partition("do not determine")[2]
    assert len(identified.split(", ")) < 8
    single_parameters = combination.partition(":")[0].split(", ")
    assert not any(table[f"{name}_percent"].identified for name in single_parameters)
    low, high = table["pretension_MPa"].interval_95
    assert low < truth[PRETENSION] < high


def single_press(problem, presses):
    """Return the first press."""
    del problem
    return presses[:1]


def at_one_place(problem, presses):
    """Return presses of 1 N at one place."""
    contact = np.tile([2.0, 1.0, 1.0], (len(presses), 1))
    return measured_presses(problem, contact, problem.charges.charges(problem.prior.mean, contact))


def without_contacts(problem, presses):
    """Return the presses without their positions and forces."""
    del problem
    return replace(presses, contact=np.full((len(presses), 3), np.nan))


@pytest.mark.parametrize(
    ("change", "caution"),
    [
        (single_press, "only 1 press: a wrong one among so few cannot be recognised"),
        (at_one_place, "within 0 mm of each other"),
        (without_contacts, "no position is known"),
    ],
)
def test_presses_with_little_information_are_named(problem, change, caution):
    _, presses = rig(problem, 8, seed=3)
    result = calibrate(change(problem, presses), problem)
    assert any(caution in sentence for sentence in result.cautions)
    assert result.film_error.position_mm > 0.2


def test_press_far_from_the_centre_is_left_out_and_named(problem):
    _, presses = rig(problem, 8, seed=3)
    contact = presses.contact.copy()
    contact[2, :2] = [12.0, 0.0]
    result = calibrate(replace(presses, contact=contact), problem)
    assert result.presses == presses[[0, 1, 3, 4, 5, 6, 7]]
    assert re.search("line 4.*left out|left out.*line 4", result.cautions[0])


def test_proposed_presses_reduce_the_error_more_than_random_presses(problem):
    proposed = next_presses(problem, 8)
    film = problem.expected
    sensitivity = ContactSensitivity.for_film(problem, film.unknowns)

    def remaining_error_mm(contact):
        """Return the position error after presses at contacts (x, y, F), by the information of all presses."""
        information = fisher_information(problem, film.unknowns, contact).sum(axis=0)
        covariance = film.joint @ np.linalg.inv(np.eye(len(film.joint)) + information @ film.joint)
        return sensitivity.contact_error(covariance).position_mm

    stated_errors_mm = [press.position_mm for press in proposed]
    assert stated_errors_mm == sorted(stated_errors_mm, reverse=True)
    contact = np.array([press.contact for press in proposed])
    assert remaining_error_mm(contact) == pytest.approx(stated_errors_mm[-1], rel=1e-6)
    random_contacts = [draw_contacts(np.random.default_rng(seed), problem.domain, 8) for seed in range(8)]
    random_errors_mm = [remaining_error_mm(contact) for contact in random_contacts]
    assert stated_errors_mm[-1] < 0.8 * np.median(random_errors_mm)


def test_proposed_forces_stay_below_the_stress_limit(problem):
    largest_force_N = {}
    for limit_MPa in (45.0, 20.0, np.inf):
        presses = next_presses(replace(problem, stress_limit=limit_MPa), 2)
        largest_force_N[limit_MPa] = max(press.force_N for press in presses)
        assert largest_stress(problem.sensor.film, problem.probe, largest_force_N[limit_MPa]) <= limit_MPa
    assert largest_force_N[20.0] < largest_force_N[45.0] < largest_force_N[np.inf]
    assert largest_force_N[np.inf] == pytest.approx(1.65)


@pytest.fixture(scope="module")
def drifted(problem):
    """The problem with an earlier calibration, and the true film after a change of its pretension by 0.35 MPa."""
    truth, presses = rig(problem, 12, seed=31)
    earlier = calibrate(presses, problem).posterior.drifted(problem.prior)
    truth[PRETENSION] += 0.35
    return replace(problem, earlier=earlier), truth


@pytest.mark.slow  # in `make test`, few presses after an earlier calibration are tested below
def test_earlier_calibration_reduces_the_error_of_the_next(drifted, problem):
    with_earlier, truth = drifted
    rng = np.random.default_rng(10)
    contact = draw_contacts(rng, problem.domain, 3)
    presses = measured_presses(problem, contact, problem.noise.add(problem.charges.charges(truth, contact), rng))
    error_mm = calibrate(presses, problem).film_error.position_mm
    assert calibrate(presses, with_earlier).film_error.position_mm < 0.7 * error_mm


def test_quantities_are_compared_with_the_earlier_calibration(drifted):
    """Compared with the sensor file, one press would identify eleven quantities, which were already known."""
    with_earlier, truth = drifted
    contact = np.array([[2.0, 1.0, 0.8]])
    result = calibrate(
        measured_presses(with_earlier, contact, with_earlier.charges.charges(truth, contact)), with_earlier
    )
    pretension = result.quantities["pretension_MPa"]
    index = with_earlier.prior.index("pretension")
    earlier_std = np.sqrt(with_earlier.earlier.covariance[index, index]) * with_earlier.prior.std[index]
    assert pretension.before_std == pytest.approx(earlier_std)
    assert sum(quantity.identified for quantity in result.quantities.values()) < 4


UNKNOWN = np.nan


@pytest.mark.parametrize(
    ("count", "x_mm", "y_mm", "force_N", "tolerance_MPa"),
    [
        (30, UNKNOWN, UNKNOWN, UNKNOWN, 0.15),
        (1, UNKNOWN, UNKNOWN, 0.1, 0.15),
        (3, 1.0, 2.0, 0.1, 0.1),
    ],
    ids=["unknown touches", "a weight at an unknown place", "known presses"],
)
def test_changed_pretension_is_estimated_from_few_presses(drifted, count, x_mm, y_mm, force_N, tolerance_MPa):
    problem, truth = drifted
    rng = np.random.default_rng(10)
    stated = np.array([x_mm, y_mm, force_N])
    is_known = np.isfinite(stated)
    contact = draw_contacts(rng, problem.domain.within(6.0), count)
    contact[:, is_known] = stated[is_known]
    charge = problem.noise.add(problem.charges.charges(truth, contact), rng)
    contact[:, ~is_known] = UNKNOWN
    posterior = calibrate(measured_presses(problem, contact, charge), problem).posterior
    std_MPa = np.sqrt(posterior.covariance[PRETENSION, PRETENSION]) * problem.prior.std[PRETENSION]
    assert abs(problem.earlier.parameters[PRETENSION] - truth[PRETENSION]) > 0.25
    assert abs(posterior.parameters[PRETENSION] - truth[PRETENSION]) < min(tolerance_MPa, 3.0 * std_MPa)


def test_touches_of_unknown_contact_are_refused_with_three_electrodes():
    problem = CalibrationProblem.of(load_sensor("three-25um-biaxial"), Circle(1.0))
    _, presses = rig(problem, 5, seed=1)
    with pytest.raises(PressError, match="three charges only determine x, y and the force"):
        calibrate(replace(presses, contact=np.full((5, 3), np.nan)), problem)


def test_network_is_chosen_by_the_layout_and_not_by_the_name():
    table = sensor_to_dict(load_sensor("four-25um-biaxial"))
    table["name"] = "ours"
    table["film"]["young_GPa"] = 2.7
    table["film"]["pretension_MPa"] = 1.0
    problem = CalibrationProblem.of(sensor_from_dict(table), Circle(1.0))
    described = dict(zip(problem.prior.names, problem.before.parameters, strict=True))
    assert described["young"] == pytest.approx(np.log(2.7 / 3.0))
    assert described["pretension"] == 1.0
    table["electrodes"]["A"] = [12.0, 0.0]
    with pytest.raises(ModelError, match=r"expected the electrodes of .*train fit --films"):
        CalibrationProblem.of(sensor_from_dict(table), Circle(1.0))


def test_probe_that_is_not_a_circle_is_refused():
    with pytest.raises(SceneError, match="expected a circle"):
        CalibrationProblem.of(load_sensor("four-25um-biaxial"), Polygon.triangle(4.0))


def solved_charges(sensor, probe, contact):
    """Solve each press (x, y, F), mm and N, and return the charges, shape (n, n_electrode), pC."""
    return np.array([touch_charge(sensor, press(sensor.film, probe, (x, y), force)) for x, y, force in contact])


@pytest.mark.slow
def test_network_of_the_pads_is_adapted_to_traces(problem):
    """A trace collects as much charge as its pad. Without the adaptation, the mean error would be 0.9 mm."""
    traced_electrodes = []
    for electrode in problem.sensor.electrodes:
        x, y = electrode.centre
        traced_electrodes.append(electrode.with_trace((electrode.centre, (4.0 * x, 4.0 * y)), 0.5))
    traced = CalibrationProblem.of(replace(problem.sensor, electrodes=tuple(traced_electrodes)), problem.probe)
    contact = draw_contacts(np.random.default_rng(3), traced.domain, 40)
    pressed, others = np.split(contact, [10])
    sensor, probe = traced.prior.film(traced.prior.mean)
    no_added_covariance = AddedCovariance(others, np.zeros((30, 3, 3)))
    fitted = traced.fitted(traced.prior.mean, no_added_covariance, lambda at: np.ones((len(at), 4)), release=False)
    estimated, _, _ = fitted.predict(solved_charges(sensor, probe, pressed))
    assert fitted.sensor.electrodes == sensor.electrodes
    assert position_error(estimated, pressed).mean() < 0.05


@pytest.mark.slow
def test_traces_that_are_not_described_are_estimated(problem):
    """The film has traces of 0.5 and 0.3 mm on the electrodes A and C, and its presses are solved directly."""
    rng = np.random.default_rng(5)
    sensor, probe = problem.prior.film(problem.prior.draw(rng, 1)[0])
    contact = draw_contacts(rng, problem.domain, 22)
    a, b, c, d = sensor.electrodes
    traced_a = a.with_trace((a.centre, (38.0, 14.0)), 0.5)
    traced_c = c.with_trace((c.centre, (-40.0, -2.0)), 0.3)
    charge = solved_charges(replace(sensor, electrodes=(traced_a, b, traced_c, d)), probe, contact)
    calibrated, test = np.split(np.arange(22), [16])
    noisy_charge = problem.noise.add(charge[calibrated], rng)
    result = calibrate(measured_presses(problem, contact[calibrated], noisy_charge), problem)
    widths = problem.charges.trace_widths(result.posterior.unknowns, result.posterior.joint)
    for (width, std), true_width in zip(widths.values(), (0.5, 0.0, 0.3, 0.0), strict=True):
        assert abs(width - true_width) < min(3.0 * std, 0.2)
    estimated_charge = problem.charges.charges(result.posterior.unknowns, contact[test])
    assert rms(estimated_charge / charge[test] - 1.0) < 0.02
    assert re.search(r"traces to the rim of this width: A 0\.\d+ mm, C 0\.\d+ mm\.", " ".join(result.summary))
