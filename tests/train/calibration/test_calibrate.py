"""A calibration: the fit of a film, what it leaves, what is said, and what is refused, by files as people write."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2
from tests.train.calibration.conftest import add_discrepancy, presses_of, rig

from isocharge.common.errors import ModelError, PressError, SceneError
from isocharge.simulate import Circle, Polygon, load_sensor, press, touch_charge
from isocharge.simulate.sensor.sensor_file import sensor_from_dict, sensor_to_dict
from isocharge.simulate.solver.stress_limit import largest_stress
from isocharge.train import CalibrationProblem, calibrate, next_presses
from isocharge.train.calibration import hypotheses
from isocharge.train.calibration.contact_error import ContactSensitivity, information_of
from isocharge.train.calibration.contacts import with_force
from isocharge.train.calibration.diagnosis import OFFSET_STD, PRETENSIONS, find_mistakes, misfit
from isocharge.train.calibration.film_fit import fit_film
from isocharge.train.calibration.press_data import PressData
from isocharge.train.data.presses import draw_contacts

pytestmark = pytest.mark.usefixtures("no_closed_backs")


def data_of(problem, presses) -> PressData:
    return PressData.of(presses, problem.noise, problem.charges.domain)


def fit(problem, presses):
    return fit_film(problem.charges, data_of(problem, presses), problem.before)


@pytest.mark.parametrize(("count", "seed"), [(4, 11), (6, 2)], ids=["inside", "on a bound"])
def test_it_is_the_minimum_of_the_joint_problem(count, seed, problem, monkeypatch):
    """SciPy over parameters and contacts together, with differences for derivatives, finds the same film."""
    monkeypatch.setattr(hypotheses, "hypotheses", lambda: [hypotheses.Hypothesis()])
    charges = problem.charges
    prior = problem.prior
    truth, presses = rig(problem, count, seed=seed)
    data = data_of(problem, presses)
    ours = fit(problem, presses)
    n = len(presses)

    def residual(unknown):
        parameters = unknown[: truth.size] * prior.std
        contact = unknown[truth.size :].reshape(n, 3)
        by_charge = data.weight * (charges.charges(parameters, with_force(contact)) - data.charge)
        by_rig = data.contact_weight * (contact - data.contact)
        return np.concatenate([by_charge.ravel(), by_rig.ravel(), (parameters - prior.mean) / prior.std])

    start = np.concatenate([prior.mean / prior.std, data.contact.ravel()])
    low, high = (
        np.concatenate([bound / prior.std, np.full(3 * n, end)])
        for bound, end in zip(prior.bounds, (-50.0, 50.0), strict=True)
    )
    joint = least_squares(residual, start, bounds=(low, high), x_scale="jac", xtol=1e-9, ftol=1e-9, diff_step=1e-4)
    std = np.sqrt(np.diag(ours.covariance))
    apart = (ours.parameters / prior.std - joint.x[: truth.size]) / std
    assert np.abs(apart).max() < 0.1
    joint_covariance = np.linalg.inv(joint.jac.T @ joint.jac)[: truth.size, : truth.size]
    np.testing.assert_allclose(std, np.sqrt(np.diag(joint_covariance)), rtol=0.05)


def on_a_film(problem, change, count, seed):
    """The film, and the calibration by presses on it whose charges are changed."""
    truth, presses = rig(problem, count, seed)
    return truth, calibrate(presses_of(problem, presses.contact, change(presses.contact, presses.charge_pC)), problem)


def error_of(network, problem, truth, change=lambda _, charge: charge):
    """What not knowing the film costs a network: its answers beside those of one that is told the film, rms in mm.

    To charges with the same noise, which are changed for the first alone.
    """
    at = draw_contacts(np.random.default_rng(8), problem.domain.within(6.0), 400)
    rng = np.random.default_rng(9)
    charge = problem.noise.add(problem.charges.charges(truth, at), rng)
    apart = network.predict(change(at, charge))[0] - problem.films.fold(truth).predict(charge)[0]
    return float(np.sqrt((apart[:, :2] ** 2).sum(axis=1).mean()))


def test_imperfections_of_a_film_are_taken_for_what_they_are(problem):
    """Pretensions of 1.3 to 0.7, a stiffer axis and an oval clamp, as their modes have it."""
    modes = np.zeros(problem.charges.n_coefficient)
    modes[: len(problem.charges.modes)] = [1.2, 0.5, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]

    def imperfect(contact, charge):
        truth, _ = rig(problem, 1, 31)
        return charge * problem.charges.factor(np.concatenate([truth, modes]), problem.charges.into_domain(contact))

    _, result = on_a_film(problem, imperfect, 20, seed=31)
    assert result.posterior.probability("modes") > 0.9
    at = draw_contacts(np.random.default_rng(3), problem.domain.within(6.0), 200)
    charge = imperfect(at, problem.charges.charges(rig(problem, 1, 31)[0], at))
    left = np.log(problem.charges.charges(result.posterior.unknowns, at) / charge)
    imperfection = np.log(imperfect(at, np.ones((200, 4))))
    assert np.sqrt(np.mean(left**2)) < 0.4 * np.sqrt(np.mean(imperfection**2))


def test_what_no_parameter_describes_is_corrected_and_its_error_is_said(problem, film_with_discrepancy):
    truth, result = film_with_discrepancy
    corrected = result.fitted
    plain = problem.films.fold(result.posterior.parameters)
    assert 0.5 < result.error_left.position_mm / error_of(corrected, problem, truth, add_discrepancy) < 2.0
    at = draw_contacts(np.random.default_rng(3), problem.domain.within(6.0), 200)
    charge = add_discrepancy(at, problem.charges.charges(truth, at))
    errors = [np.hypot(*(network.predict(charge)[0] - at)[:, :2].T).mean() for network in (corrected, plain)]
    assert errors[0] < 0.6 * errors[1]
    summary = " ".join(result.summary)
    assert re.search(r"charges of this film differ from those of its parameters by \d", summary)
    assert re.search(r"30 more presses would reduce it to 0\.\d+ mm", summary)


def test_a_turned_stage_is_named(problem):
    """By 8 degrees beside what the electrodes are turned by; that is two degrees or less."""
    truth, presses = rig(problem, 8, seed=43)
    angle = np.copysign(np.deg2rad(8.0), truth[problem.prior.names.index("rotation")])
    cos, sin = np.cos(angle), np.sin(angle)
    turned = presses.contact @ np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    cautions = calibrate(presses_of(problem, turned, presses.charge_pC), problem).cautions
    assert any(
        re.search(r"difference from the sensor file: rotation; .* axes of the stage", message) for message in cautions
    )


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
def test_what_a_session_had_is_taken_off_and_said(problem, change, caution):
    """A bad tare, and an amplifier that drifts: each alone spoils the film else by three times what is said."""
    truth, result = on_a_film(problem, change, 8, seed=42)
    assert any(re.search(caution, sentence) for sentence in result.cautions)
    error = error_of(problem.films.fold(result.posterior.parameters), problem, truth)
    assert error < 2.0 * result.error_left.position_mm < 0.4


def test_a_leak_at_random_is_said_and_widens_the_force(problem):
    """0 to 10 % of the charge of each press: 5 % of it are in all of them, and look like a gain."""
    leak = np.exp(-0.1 * np.random.default_rng(4).random((10, 1)))
    truth, result = on_a_film(problem, lambda _, charge: leak * charge, 10, seed=44)
    assert any(re.search(r"the forces scatter by [2-9](\.\d)? % about", sentence) for sentence in result.cautions)
    at = draw_contacts(np.random.default_rng(8), problem.domain.within(6.0), 200)
    charge = problem.charges.charges(truth, at)
    force = problem.films.fold(result.posterior.parameters).predict(charge)[0][:, 2]
    error = 100.0 * np.sqrt(np.mean((force / at[:, 2] - 1.0) ** 2))
    assert 2.0 < error < 2.5 * result.error_left.force_percent


@pytest.mark.first_cases(1)
def test_errors_are_as_large_as_they_say(layout):
    """Over films, the deviations of the parameters in their own covariance add up to a chi-squared."""
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


@pytest.mark.first_cases(1)
@pytest.mark.parametrize("row", [0, 4])
def test_a_bad_press_is_left_out_and_moves_nothing(problem, row):
    _, presses = rig(problem, 10, seed=21)
    clean = fit(problem, presses)
    presses.charge_pC[row] *= [1.0, 1.3, 1.0, 1.0]
    spoilt = fit(problem, presses)
    assert np.flatnonzero(spoilt.bad).tolist() == [row]
    std = np.sqrt(np.diag(clean.covariance))
    assert np.abs((spoilt.parameters - clean.parameters) / problem.prior.std / std).max() < 1.2


@pytest.mark.first_cases(1)
def test_the_error_left_is_near_the_linearised_limit(layout):
    """Asked: at most 1.25 times the limit at the true film, median over films; none beyond 2.5 times."""
    ratios = []
    for seed in range(3):
        truth, presses = rig(layout, 8, seed=200 + seed)
        result = calibrate(presses, layout)
        at_truth = ContactSensitivity.at(layout, truth)
        information = np.eye(truth.size) + information_of(layout, truth, presses.contact).sum(axis=0)
        limit = at_truth.contact_error(np.linalg.inv(information))
        wrong = at_truth.contact_jacobian @ ((result.posterior.parameters - truth) / layout.prior.std)
        ratios.append(np.sqrt((wrong[:, :2] ** 2).sum(axis=1).mean()) / limit.position_mm)
    assert np.median(ratios) < 1.25
    assert max(ratios) < 2.5


def test_summary_names_identified_and_unidentified_quantities(problem):
    truth, presses = rig(problem, 12, seed=1)
    result = calibrate(presses, problem)
    table = result.quantities
    assert all(table[name].identified for name in ("pretension_MPa", "response_percent", "gain_A_percent"))
    assert not any(table[name].identified for name in ("young_percent", "thickness_percent"))
    _, known, unknown, together = result.summary[:4]
    assert "Young's modulus alone" in unknown.partition("do not determine")[2]
    assert len(known.split(", ")) < 8
    assert not any(table[f"{name}_percent"].identified for name in together.partition(":")[0].split(", "))
    low, high = table["pretension_MPa"].interval_95
    assert low < truth[0] < high


def test_little_said_is_said(problem):
    """One press; presses in one place; presses without any place or force; presses too far out."""
    _, presses = rig(problem, 8, seed=3)
    at = np.tile([2.0, 1.0, 1.0], (8, 1))
    one_place = presses_of(problem, at, problem.charges.charges(problem.prior.mean, at))
    far = presses.contact.copy()
    far[2, :2] = [12.0, 0.0]
    for few, caution in (
        (presses[:1], "only 1 press: a wrong one among so few cannot be recognised"),
        (one_place, "within 0 mm of each other"),
        (replace(presses, contact=np.full((8, 3), np.nan)), "no position is known"),
    ):
        result = calibrate(few, problem)
        assert any(caution in sentence for sentence in result.cautions)
        assert result.error_left.position_mm > 0.2
    result = calibrate(replace(presses, contact=far), problem)
    assert result.presses == presses[[0, 1, 3, 4, 5, 6, 7]]
    assert re.search("line 4.*left out|left out.*line 4", result.cautions[0])


EXPLAINED = {
    "columns": (lambda c, q: (c, q[:, [1, 2, 0, 3]]), "columns are swapped: those named A, B, C, D hold B, C, A, D"),
    "rotated": (lambda c, q: (c @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]]), q), "turned by -?90 degrees"),
    "mirrored": (lambda c, q: (c * [-1.0, 1.0, 1.0], q), "x is mirrored"),
    "grams": (lambda c, q: (c / [1.0, 1.0, 9.80665e-3], q), "forces are in g, not N"),
    "millinewtons": (lambda c, q: (c / [1.0, 1.0, 1e-3], q), "forces are in mN, not N"),
    "centimetres": (lambda c, q: (c / [10.0, 10.0, 1.0], q), "positions are in cm, not mm"),
    "nanocoulombs": (lambda c, q: (c, q / 1e3), "charges are in nC, not pC"),
}
IMPOSSIBLE = {
    "metres": (lambda c, q: (c / [1e3, 1e3, 1.0], q), "written in metres"),
    "micrometres": (lambda c, q: (c * [1e3, 1e3, 1.0], q), "off the film"),
    "dead": (lambda c, q: (c, np.where(np.arange(4) == 2, 0.4, q)), r"electrode 'C' is dead.* 0\.4 pC, 0\.\d+ % of"),
    "negative": (lambda c, q: (c, q * [1.0, -1.0, 1.0, 1.0]), "electrode 'B': 12 of its 12 charges are negative"),
    "missing": (lambda c, q: (c, np.where(np.arange(4) == 3, np.nan, q)), "electrode 'D': no press has a charge"),
    "too strong": (lambda c, q: (c * [1.0, 1.0, 100.0], q), "most of them lie outside"),
    "mixed up": (
        lambda c, q: (c, q[::-1]),
        "no film of 'four-25um-biaxial' explains these 12.*is it this layout and this",
    ),
}


@pytest.mark.parametrize("name", EXPLAINED)
def test_a_mistake_is_found_where_there_is_one(problem, name):
    mistake, reason = EXPLAINED[name]
    _, presses = rig(problem, 12, seed=7)
    assert find_mistakes(presses, problem.charges) == []
    found = find_mistakes(presses_of(problem, *mistake(presses.contact, presses.charge_pC)), problem.charges)
    assert re.search(reason, "; ".join(found))  # turned axes and swapped columns are the same on this layout


def test_a_factor_of_all_charges_alone_is_the_misfit(problem):
    """Three times those of the film with the largest charges."""
    film = np.append(min(PRETENSIONS) * problem.prior.spread.pretension, problem.prior.mean[1:])
    at = draw_contacts(np.random.default_rng(3), problem.domain.within(6.0), 10)
    presses = presses_of(problem, at, 3.0 * problem.charges.charges(film, at))
    assert misfit(presses, problem.charges) == pytest.approx((np.log(3.0) / OFFSET_STD) ** 2)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name == "mixed up" else []) for name in IMPOSSIBLE]
)
def test_presses_that_cannot_be_are_refused_with_the_reason(problem, name):
    mistake, reason = IMPOSSIBLE[name]
    _, presses = rig(problem, 12, seed=7)
    with pytest.raises(PressError, match=reason):
        calibrate(presses_of(problem, *mistake(presses.contact, presses.charge_pC)), problem)


def test_proposed_presses_tell_more_than_random_ones(problem):
    """Of a film that may be imperfect, beyond those of the prior."""
    proposed = next_presses(problem, 8)
    film = problem.expected
    sensitivity = ContactSensitivity.at(problem, film.unknowns)
    nothing = np.eye(len(film.joint))

    def left(at):
        told = information_of(problem, film.unknowns, at).sum(axis=0) @ film.joint
        return sensitivity.contact_error(film.joint @ np.linalg.inv(nothing + told)).position_mm

    expected = [press.position_mm for press in proposed]
    assert expected == sorted(expected, reverse=True)
    assert left(np.array([press.contact for press in proposed])) == pytest.approx(expected[-1], rel=1e-6)
    at_random = [left(draw_contacts(np.random.default_rng(seed), problem.domain, 8)) for seed in range(8)]
    assert expected[-1] < 0.8 * np.median(at_random)


def test_proposed_presses_leave_no_dent(problem):
    """Without a limit the hardest would be 1.65 N."""
    film = problem.sensor.film
    most = {}
    for limit in (45.0, 20.0, np.inf):
        presses = next_presses(replace(problem, stress_limit=limit), 2)
        most[limit] = max(press.force_N for press in presses)
        assert largest_stress(film, problem.probe, most[limit]) <= limit
    assert most[20.0] < most[45.0] < most[np.inf] == pytest.approx(1.65)


@pytest.fixture(scope="module")
def warmed(problem):
    """What an earlier calibration knows of a film, and the film a degree later."""
    truth, presses = rig(problem, 12, seed=31)
    earlier = calibrate(presses, problem).posterior.drifted(problem.prior)
    truth[0] += 0.35
    return replace(problem, earlier=earlier), truth


def test_an_earlier_calibration_is_the_prior_of_the_next(warmed, problem):
    again, truth = warmed
    rng = np.random.default_rng(10)
    at = draw_contacts(rng, problem.domain, 3)
    presses = presses_of(problem, at, problem.noise.add(problem.charges.charges(truth, at), rng))
    assert calibrate(presses, again).error_left.position_mm < 0.7 * calibrate(presses, problem).error_left.position_mm


NOBODY_KNOWS = (np.nan, np.nan, np.nan)


@pytest.mark.parametrize(
    ("count", "known", "within_mpa"),
    [(30, NOBODY_KNOWS, 0.15), (1, (np.nan, np.nan, 0.1), 0.15), (3, (1.0, 2.0, 0.1), 0.1)],
)
def test_a_pretension_is_followed_by_little(warmed, count, known, within_mpa):
    """By ordinary touches of which nothing is known, by a known weight anywhere, by a few presses that are known."""
    problem, truth = warmed
    rng = np.random.default_rng(10)
    at = draw_contacts(rng, problem.domain.within(6.0), count)
    at[:, np.isfinite(known)] = np.array(known)[np.isfinite(known)]
    charge = problem.noise.add(problem.charges.charges(truth, at), rng)
    at[:, np.isnan(known)] = np.nan
    before = problem.earlier
    result = calibrate(presses_of(problem, at, charge), problem)
    std = np.sqrt(result.posterior.covariance[0, 0]) * problem.prior.std[0]
    assert abs(before.parameters[0] - truth[0]) > 0.25
    assert abs(result.posterior.parameters[0] - truth[0]) < min(within_mpa, 3.0 * std)


def test_three_electrodes_follow_no_touches():
    problem = CalibrationProblem.of(load_sensor("three-25um-biaxial"), Circle(1.0))
    _, presses = rig(problem, 5, seed=1)
    with pytest.raises(PressError, match="three charges only determine x, y and the force"):
        calibrate(replace(presses, contact=np.full((5, 3), np.nan)), problem)


def test_a_network_is_chosen_by_layout_and_not_by_name():
    table = sensor_to_dict(load_sensor("four-25um-biaxial"))
    table["name"] = "ours"
    table["film"]["young_GPa"] = 2.7
    table["film"]["pretension_MPa"] = 1.0
    ours = CalibrationProblem.of(sensor_from_dict(table), Circle(1.0))
    described = dict(zip(ours.prior.names, ours.before.parameters, strict=True))
    assert described["young"] == pytest.approx(np.log(2.7 / 3.0))
    assert described["pretension"] == 1.0
    table["electrodes"]["A"] = [12.0, 0.0]
    with pytest.raises(ModelError, match=r"expected the electrodes of .*train fit --films"):
        CalibrationProblem.of(sensor_from_dict(table), Circle(1.0))
    with pytest.raises(SceneError, match="expected a circle"):
        CalibrationProblem.of(load_sensor("four-25um-biaxial"), Polygon.triangle(4.0))


@pytest.mark.slow
def test_electrodes_with_traces_are_read_by_the_network_of_their_pads(problem):
    """On charges of direct solves; a trace collects as much as its pad."""
    outward = [e.with_trace((e.centre, (4.0 * e.centre[0], 4.0 * e.centre[1])), 0.5) for e in problem.sensor.electrodes]
    traced = CalibrationProblem.of(replace(problem.sensor, electrodes=tuple(outward)), problem.probe)
    contact = draw_contacts(np.random.default_rng(3), traced.domain, 40)
    sensor, probe = traced.prior.film(traced.prior.mean)
    charge = [touch_charge(sensor, press(sensor.film, probe, (x, y), force)) for x, y, force in contact[:10]]
    fitted = traced.fitted(
        traced.prior.mean, (contact[10:], np.zeros((30, 3))), lambda at: np.ones((len(at), 4)), release=False
    )
    off = fitted.predict(np.array(charge))[0] - contact[:10]
    assert fitted.sensor.electrodes == sensor.electrodes
    assert np.hypot(off[:, 0], off[:, 1]).mean() < 0.05  # of the pads alone 0.9


@pytest.mark.slow
def test_traces_that_are_not_described_are_found_by_their_charge(problem):
    """Of 0.5 and 0.3 mm, askew, by direct solves of a film that has them."""
    rng = np.random.default_rng(5)
    sensor, probe = problem.prior.film(problem.prior.draw(rng, 1)[0])
    at = draw_contacts(rng, problem.domain, 22)
    a, b, c, d = sensor.electrodes
    a = a.with_trace((a.centre, (38.0, 14.0)), 0.5)
    c = c.with_trace((c.centre, (-40.0, -2.0)), 0.3)
    film = replace(sensor, electrodes=(a, b, c, d))
    charge = np.array([touch_charge(film, press(film.film, probe, (x, y), force)) for x, y, force in at])
    result = calibrate(presses_of(problem, at[:16], problem.noise.add(charge[:16], rng)), problem)
    found = problem.charges.trace_widths(result.posterior.unknowns, result.posterior.joint)
    for (width, std), true in zip(found.values(), (0.5, 0.0, 0.3, 0.0), strict=True):
        assert abs(width - true) < min(3.0 * std, 0.2)
    off = problem.charges.charges(result.posterior.unknowns, at[16:]) / charge[16:] - 1.0
    assert np.sqrt(np.mean(off**2)) < 0.02
    assert re.search(r"traces to the rim of this width would: A 0\.\d+ mm, C 0\.\d+ mm\.", " ".join(result.summary))
